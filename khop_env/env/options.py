"""What `reset(options=...)` takes, checked."""

from __future__ import annotations

import warnings
from collections.abc import Mapping
from typing import Any

import numpy as np

from khop_env.observers import FloatArray
from khop_env.physics import Fleet, did_you_mean

RESET_OPTIONS = ("initial_state",)


def initial_states(fleet: Fleet, options: Mapping[str, Any] | None) -> FloatArray | None:
    """Initial states from `options`; others are drawn.

        reset(options={"initial_state": {"cart_0": [0.0, 0.0, 1.0, 0.0]}})
        reset(options={"initial_state": x0})      # (n,) the whole fleet's, or (copies, n)

    Unknown options are ignored with a warning, as PettingZoo's own tests ask for.

    Raises:
        ValueError: for an unknown agent, or states of a wrong length or not finite.
    """
    options = options or {}
    for name in options:
        if name not in RESET_OPTIONS:
            warnings.warn(
                f"reset() ignores the option {name!r}; {did_you_mean(str(name), RESET_OPTIONS)}",
                UserWarning,
                stacklevel=3,
            )
    given = options.get("initial_state")
    if given is None:
        return None
    if not isinstance(given, Mapping):
        whole = np.asarray(given, dtype=float)
        if not np.isfinite(whole).all():
            raise ValueError("option initial_state: states must be finite; {agent: states} gives some of them")
        return whole
    x0 = np.full(fleet.n, np.nan)
    for agent, states in given.items():
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
