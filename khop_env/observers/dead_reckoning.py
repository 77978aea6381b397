"""Dead reckoning: where an agent would be now, had it only drifted since it was last heard of."""

from __future__ import annotations

import functools
from collections.abc import Callable
from typing import NamedTuple

import numpy as np

from khop_env.observers.layout import FloatArray, IntArray
from khop_env.physics import AgentModel, Growth

LONGEST_STEP = 1.0 / 32.0  # s, for models that don't say
_MOST_STEPS = 100_000


class Prediction(NamedTuple):
    """A predicted state.

    Attributes:
        state: (n, B).
        error: (n, B) of the integration: the distance to what steps of twice the length give. It is 0 where f = 0,
            a proven bound for carts, and elsewhere an estimate: about 15 times the error, but too small where two
            orders happen to cancel, as measured by at most 2e-7 of a certified radius.
    """

    state: FloatArray
    error: FloatArray


def predict(
    model: AgentModel, x: FloatArray, age: FloatArray, t: FloatArray | float = 0.0, growth: Growth | None = None
) -> Prediction:
    """Solve p' = f(p) from p = `x` at time `t`, for `age` seconds, by Runge-Kutta steps of order 4.

    Every column has its own number of steps, so that its result doesn't depend on the others.

    Args:
        model: of the agent.
        x: (n, B) states at the beginning.
        age: (B,) in s.
        t: (B,) time of the beginning, in s.
        growth: the model's; gives the longest step, and how the drift goes on outside its region. None for the model's
            drift as it is, in steps of 1/32 s.

    Raises:
        ValueError: for an age that is negative, not finite, or takes more than 100 000 steps.
    """
    age = np.asarray(age, np.float64)
    longest = LONGEST_STEP if growth is None else growth.step
    if not ((age >= 0.0) & (age <= _MOST_STEPS * min(longest, 1e9))).all():
        raise ValueError(
            f"ages must be from 0 to {_MOST_STEPS * min(longest, 1e9):g} s for {model.__class__.__name__}, whose drift "
            f"takes steps of {longest:g} s; got {age.tolist()}"
        )
    start = np.broadcast_to(np.asarray(t, np.float64), age.shape)
    steps = np.maximum(1, np.ceil(age / longest - 1e-9)).astype(np.int64)
    drift = extended_drift(model, growth)
    coarse = integrated(drift, x.T, start, age, steps)
    fine = integrated(drift, x.T, start, age, 2 * steps)
    return Prediction(fine.T, np.abs(fine - coarse).T)


def extended_drift(model: AgentModel, growth: Growth | None) -> Callable[[FloatArray, FloatArray], FloatArray]:
    """The drift (t, x) of predictions: the model's, and outside the region of its `growth` what that says."""
    if growth is None or not np.isfinite(growth.region).any():
        return model.drift
    return functools.partial(_extended, model, growth)  # a closure couldn't be pickled


def _extended(model: AgentModel, growth: Growth, t: FloatArray, x: FloatArray) -> FloatArray:
    inside = np.minimum(np.maximum(x, -growth.region), growth.region)
    return growth.extended(model.drift(t, inside), x, inside)


def integrated(
    drift: Callable[[FloatArray, FloatArray], FloatArray],
    x: FloatArray,
    start: FloatArray,
    age: FloatArray,
    steps: IntArray,
) -> FloatArray:
    """States (B, n) after `age`, which may be negative, in `steps` equal steps of each row."""
    x = np.ascontiguousarray(x, np.float64)
    for k in range(int(steps.max(initial=0))):
        h = np.where(k < steps, age / steps, 0.0)  # rows that are there already stay
        t, dt = start + np.minimum(k, steps) * (age / steps), h[:, None]
        k1 = drift(t, x)
        k2 = drift(t + 0.5 * h, x + 0.5 * dt * k1)
        k3 = drift(t + 0.5 * h, x + 0.5 * dt * k2)
        k4 = drift(t + h, x + dt * k3)
        x = x + dt / 6.0 * (k1 + 2.0 * (k2 + k3) + k4)
    return x
