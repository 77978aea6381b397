"""Bounds on estimation errors that a scenario declares: checks of a user's own, and sizes."""

from __future__ import annotations

import math

import numpy as np

from khop_env.observers import DesignError, Exponential, PerformanceFunction

_SAMPLED_TIMES = np.concatenate([np.linspace(0.0, 10.0, 1001), np.geomspace(10.0, 1000.0, 1001)])  # s


def check_bound(bound: PerformanceFunction, name: str) -> None:
    """Sample a user's performance function: positive and finite, and not below the infimum that it declares.

    Args:
        bound: the function.
        name: "delta" or "theta", for error messages.

    Raises:
        DesignError: if it isn't; the message has the time and the value.
    """
    values = np.broadcast_to(np.asarray(bound(_SAMPLED_TIMES), dtype=float), _SAMPLED_TIMES.shape)
    floor = float(bound.infimum())
    if not 0.0 < floor < math.inf:
        raise DesignError(f"{name}: {bound!r}.infimum() must be positive and finite; got {floor!r}")
    wrong = np.flatnonzero(~(np.isfinite(values) & (values >= floor * (1.0 - 1e-9))))
    if wrong.size:
        t, value = _SAMPLED_TIMES[wrong[0]], values[wrong[0]]
        raise DesignError(
            f"{name}: {bound!r} is {value:.6g} at t = {t:.4g} s, but its infimum() says that it is never below "
            f"{floor:.6g}; return a lower bound on all its values, which have to be finite and positive (Definition 1)"
        )


def widened(bound: PerformanceFunction, initial: float) -> Exponential:
    """The same bound with another start.

    Args:
        bound: an `Exponential`.
        initial: at t = 0; its final value if that is larger.

    Raises:
        ValueError: if it isn't an `Exponential`.
    """
    if type(bound) is not Exponential:
        raise ValueError(f"only Exponential bounds can be sized; got {bound!r}")
    return Exponential(max(float(initial), bound.final), bound.final, bound.rate)
