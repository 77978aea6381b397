"""How agents that have to brake come to rest: the numbers of docs/theory/safety.md, "Agents that have to brake".

Along each axis of the world an agent is held near an anchor, which moves without a disturbance: p' = v, v' = -damping v
+ u in the simulator's own steps, with inputs held over a period.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from khop_env.observers import FloatArray, IntArray

MOST_KNOTS = 2000
POLES = np.linspace(0.0, 0.9, 19)  # of the error's feedback, per period
_PERIODS = 400  # over which errors are summed: the slowest pole leaves 1e-16 of them


class AxisMap(NamedTuple):
    """An axis after a period: position p + forward v + push u, velocity keep v + gain u.

    Attributes:
        keep: share of the velocity that is left.
        forward: in s.
        push: in s^2.
        gain: in s.
        damping: in 1/s.
        step: of the simulator, in s.
        steps: in a period.
    """

    keep: float
    forward: float
    push: float
    gain: float
    damping: float
    step: float
    steps: int


class Tracking(NamedTuple):
    """A feedback, input = the anchor's + gains . error, and what it keeps.

    Attributes:
        gains: (2,) of the errors of position and velocity, in 1/s^2 and 1/s.
        error: (2,) their largest values at the beginning of a period.
        within: largest error of the position at any time, in m.
        budget: largest |gains . observed error|, in m/s^2.
    """

    gains: FloatArray
    error: FloatArray
    within: float
    budget: float


class Brake(NamedTuple):
    """The stopping distance as a function of the speed, which is linear between `knots`.

    Attributes:
        knots: (L,) speeds from which it takes 0, 1, 2, ... periods to stop, in m/s.
        distance: (L,) until then, in m.
        first: (C,) the last knot that is at most a multiple c of knots[1].
    """

    knots: FloatArray
    distance: FloatArray
    first: IntArray


def axis_map(damping: float, period: float, steps: int) -> AxisMap:
    """The map of a held input in Euler steps.

    Raises:
        ValueError: if a step isn't shorter than 1 / damping.
    """
    step = period / steps
    if step * damping >= 1.0:
        raise ValueError(f"steps of {step:g} s are too long for a damping of {damping:g} 1/s: choose a smaller dt")
    state, effect, _ = held(damping, step, steps)
    return AxisMap(float(state[1, 1]), float(state[0, 1]), float(effect[0]), float(effect[1]), damping, step, steps)


def held(damping: float, step: float, count: int) -> tuple[FloatArray, FloatArray, FloatArray]:
    """After `count` steps: the state's map (2, 2), a held input's effect (2,), and a bound's (2, 2) on disturbances."""
    once = np.array([[1.0, step], [0.0, 1.0 - step * damping]])
    state, effect, pushed = np.eye(2), np.zeros(2), np.zeros((2, 2))
    for _ in range(count):
        pushed = once @ pushed + step * np.eye(2)
        effect = once @ effect + np.array([0.0, step])
        state = once @ state
    return state, effect, pushed


def track(axis: AxisMap, pushed: FloatArray, rounding: FloatArray, limit: float) -> Tracking:
    """The feedback, of those with two equal poles, that takes least of the input and of the distance.

    Args:
        axis: the map.
        pushed: (2,) bounds of what disturbs position and velocity, per second, with the rounding of inputs.
        rounding: (2,) of the observed position and velocity.
        limit: of the input, in m/s^2.
    """
    found = [_kept(axis, _gains(axis, float(pole)), pushed, rounding) for pole in POLES]
    return min(found, key=lambda tracking: tracking.budget / limit + tracking.within / 0.1)


def brake_table(axis: AxisMap, strength: float, fastest: float) -> Brake:
    """Stopping distances of inputs up to `strength`, in m/s^2, from speeds up to `fastest` or `MOST_KNOTS` periods."""
    knots, distance = [0.0], [0.0]
    while knots[-1] <= fastest and len(knots) < MOST_KNOTS:
        speed = (knots[-1] + axis.gain * strength) / axis.keep
        distance.append(distance[-1] + axis.forward * speed - axis.push * strength)
        knots.append(speed)
    cells = knots[1] * np.arange(int(knots[-1] / knots[1]) + 2)
    first = np.searchsorted(knots, cells, side="right") - 1
    return Brake(np.array(knots), np.array(distance), np.minimum(first, len(knots) - 2).astype(np.int64))


def _gains(axis: AxisMap, pole: float) -> FloatArray:
    """(2,) by comparing coefficients: the trace is 2 pole, the determinant pole^2."""
    a, alpha, beta, b = axis.keep, axis.forward, axis.push, axis.gain
    left = np.array([[beta, b], [a * beta - alpha * b, b]])
    found: FloatArray = np.linalg.solve(left, np.array([2.0 * pole - 1.0 - a, pole**2 - a]))
    return found


def _kept(axis: AxisMap, gains: FloatArray, pushed: FloatArray, rounding: FloatArray) -> Tracking:
    state, effect, disturbed = held(axis.damping, axis.step, axis.steps)
    feedback = np.outer(effect, gains)
    reach = disturbed @ pushed + np.abs(feedback) @ rounding  # of one period
    error, start, power, budget = np.zeros(2), np.zeros(2), np.eye(2), 0.0
    for _ in range(_PERIODS):
        start = np.maximum(start, np.abs(power) @ rounding)  # an anchor begins where it is observed
        error += np.abs(power) @ reach
        budget += float(np.abs(gains @ power) @ reach)
        power = (state + feedback) @ power
    error = 1.001 * (error + start)
    budget = 1.001 * (budget + float(np.abs(gains) @ (rounding + start)))
    within = float(error[0])
    for count in range(1, axis.steps):
        state, effect, disturbed = held(axis.damping, axis.step, count)
        feedback = np.outer(effect, gains)
        after = np.abs(state + feedback) @ error + disturbed @ pushed + np.abs(feedback) @ rounding
        within = max(within, float(after[0]))
    return Tracking(gains, error, within, budget)
