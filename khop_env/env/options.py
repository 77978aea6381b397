"""Checks of the arguments of `reset`."""

from __future__ import annotations

import copy
import reprlib
import warnings
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from khop_env.observers import FloatArray, IntArray
from khop_env.physics import Fleet, did_you_mean
from khop_env.simulation import InitialSet

RESET_OPTIONS = ("initial_state",)


def seeds(seed: int | Sequence[int | None] | None, env_ids: IntArray) -> list[int | None]:
    """A seed, or None, for each of the environments that are reset.

    Args:
        seed: environment b gets seed + b; or one seed per environment that is reset.
        env_ids: (R,) their indices.

    Raises:
        ValueError: for a seed that isn't a non-negative integer, or not R of them.
    """
    values = list(seed) if isinstance(seed, Iterable) else [seed]
    for value in values:
        if value is not None and not (isinstance(value, int | np.integer) and value >= 0):
            raise ValueError(f"a seed must be a non-negative integer, or None; got {value!r}")
    if not isinstance(seed, Iterable):
        return [None if seed is None else int(seed) + b for b in env_ids.tolist()]
    if len(values) != len(env_ids):
        raise ValueError(f"expected one seed or {len(env_ids)}, one per environment that is reset; got {len(values)}")
    return values


def completed(states: ArrayLike, initial: InitialSet, generators: Sequence[np.random.Generator]) -> FloatArray:
    """Initial states in which nan is replaced by what the generators, which stay as they are, would draw."""
    x0 = np.asarray(states, dtype=float)
    if not np.isnan(x0).any() or x0.shape[-1:] != initial.center.shape:
        return x0
    drawn = np.array([initial.draw(copy.deepcopy(rng)) for rng in generators])
    return np.where(np.isnan(x0), drawn, x0)


def reset_options(options: Mapping[str, Any] | None) -> Mapping[str, Any]:
    """The options, none by default.

    Raises:
        ValueError: if they aren't a mapping.
    """
    if options is not None and not isinstance(options, Mapping):
        raise ValueError(
            f"options are a dictionary, as {{'initial_state': ...}}; got {reprlib.repr(options)} "
            f"({type(options).__name__})"
        )
    return options or {}


def initial_states(fleet: Fleet, options: Mapping[str, Any] | None) -> FloatArray | None:
    """Initial states from `options`; nan where they are drawn.

        reset(options={"initial_state": {"cart_0": [0.0, 0.0, 1.0, 0.0]}})
        reset(options={"initial_state": x0})      # (n,) of the whole fleet, or (num_envs, n)

    Unknown options are ignored with a warning, as PettingZoo's own tests require.

    Raises:
        ValueError: for options that aren't a mapping, an unknown agent, or states of a wrong length or not finite.
    """
    options = reset_options(options)
    for name in options:
        if name not in RESET_OPTIONS:
            warnings.warn(
                f"reset() ignores the option {name!r}; {did_you_mean(str(name), RESET_OPTIONS)}",
                UserWarning,
                stacklevel=3,
            )
    value = options.get("initial_state")
    if value is None:
        return None
    if not isinstance(value, Mapping):
        whole = np.asarray(value, dtype=float)
        if not np.isfinite(whole).all():
            raise ValueError(
                "option initial_state: states must be finite; to set some agents only, give {agent: states}"
            )
        return whole
    x0 = np.full(fleet.n, np.nan)
    for agent, states in value.items():
        try:
            i = fleet.agent(agent)
        except ValueError as error:
            raise ValueError(f"option initial_state: {error}") from None
        expected, values = list(fleet.models[i].states), np.asarray(states, dtype=float)
        if values.shape != (len(expected),) or not np.isfinite(values).all():
            raise ValueError(
                f"option initial_state: {agent!r} has the states {', '.join(expected)}, which must be finite; got "
                f"{values}"
            )
        x0[fleet.state_slice(i)] = values
    return x0
