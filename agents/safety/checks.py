"""Checks of what a safety filter is given while it acts."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.policy import EnvDescription, Observations
from khop_env.env.layout import Float32Array

_ROUNDED = 1.0 - 1e-6  # a radius observed as a float32


def is_number(value: object) -> bool:
    """Whether a value is a number, and not True or False."""
    return isinstance(value, int | float | np.floating | np.integer) and not isinstance(value, bool)


def checked(observations: Observations, env: EnvDescription, radius: float | None) -> dict[str, Float32Array]:
    """Observations as arrays.

    Args:
        observations: (..., D_i) by agent.
        env: the environment that they should be of.
        radius: in m, which no observed radius may exceed; None for no such limit.

    Raises:
        ValueError: if an agent is missing, or has other columns, another batch than the first one, or a larger radius.
    """
    first = env.agents[0]
    if not isinstance(observations, Mapping):
        raise ValueError(
            f"observations must be a dict with an array for each agent, e.g. for {first!r}; the safety filter got "
            f"{type(observations).__name__}"
        )
    found: dict[str, Float32Array] = {}
    for agent, layout in env.layouts.items():
        if agent not in observations:
            raise ValueError(f"the safety filter got no observation of {agent!r}")
        found[agent] = seen = _array(agent, observations[agent])
        if seen.shape[-1:] != (len(layout),):
            raise ValueError(
                f"the safety filter reads the {len(layout)} columns of {agent!r} in the environment that it was reset "
                f"for; it got {seen.shape[-1] if seen.ndim else 'a single number'}"
            )
        if seen.shape[:-1] != found[first].shape[:-1]:
            raise ValueError(
                f"observations must be of one batch: those of {first!r} have shape {found[first].shape}, and those of "
                f"{agent!r} {seen.shape}"
            )
        if radius is not None and "radius" in layout.names:
            largest = float(seen[..., layout.index("radius")].max(initial=0.0))
            if largest * _ROUNDED > radius:
                raise ValueError(
                    f"with radius={radius:g} agents would touch: {agent!r} observes a radius of {largest:.6g} m; leave "
                    "radius out, or give that or more"
                )
    return found


def require_state(state: Mapping[str, NDArray[Any]], own: Mapping[str, NDArray[Any]]) -> None:
    """Refuse what a filter can't continue from.

    Args:
        state: by name.
        own: the filter's own state; arrays have a batch as their first axis, or none. The batch of `state` may differ
            where it or that of `own` is 0.

    Raises:
        ValueError: if names, types or shapes differ, saying which.
    """
    if not isinstance(state, Mapping):
        raise ValueError(
            f"the state of a safety filter is a dict of {', '.join(own)}, from get_state(); got {type(state).__name__}"
        )
    if set(state) != set(own):
        raise ValueError(
            f"the state of this safety filter has {', '.join(own)}; got {', '.join(map(str, state)) or 'nothing'}: "
            "take one from get_state() of such a filter"
        )
    sizes = {len(state[name]) for name, array in own.items() if array.ndim and np.ndim(state[name])}
    for name, array in own.items():
        value, size = state[name], array.shape[1:]
        is_array = isinstance(value, np.ndarray) and value.dtype == array.dtype and value.ndim == array.ndim
        if not is_array or value.shape[1:] != size:
            got = f"{value.dtype} of shape {value.shape}" if isinstance(value, np.ndarray) else repr(value)
            shape = f"(batch, {', '.join(map(str, size))})" if array.ndim else "()"
            raise ValueError(
                f"{name!r} in the state of this safety filter is {array.dtype} of shape {shape}; got {got}, which is "
                "of another team, environment or kind of filter"
            )
    batch = next(len(array) for array in own.values() if array.ndim)
    if len(sizes) != 1 or (0 not in (batch, *sizes) and batch not in sizes):
        raise ValueError(
            f"the state is of a batch of {' and '.join(map(str, sorted(sizes)))}, and this safety filter plays {batch}"
        )


def _array(agent: str, values: object) -> Float32Array:
    try:
        found: Float32Array = np.asarray(values)
        if found.dtype.kind in "fiu":
            return found
    except ValueError:  # rows of different lengths
        pass
    raise ValueError(f"the observation of {agent!r} isn't numbers: {values!r}")
