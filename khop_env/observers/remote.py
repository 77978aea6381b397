"""What a robot knows of another one: its freshest state, a prediction from it, and the certified box around that.

On top of `Certificate` it takes account of clocks that differ and of numbers that were rounded on their way
(docs/theory/certificates.md, "Clocks").
"""

from __future__ import annotations

import functools
import math
from typing import NamedTuple

import numpy as np

from khop_env.observers.boxes import Box
from khop_env.observers.certificate import Certificate
from khop_env.observers.dead_reckoning import LONGEST_STEP, extended_drift, integrated
from khop_env.observers.layout import FloatArray
from khop_env.observers.radius import RadiusTable, exponential
from khop_env.physics import AgentModel, Growth

_MOST_INTERVALS = 100_000


class Estimate(NamedTuple):
    """A node's estimate of a target.

    Attributes:
        estimate: (n_i,) of its state.
        bound: (n_i,) certified bound on each component's error; inf where nothing is certified.
        age: time since the target measured what the node knows of it, in s; inf while nothing has arrived.
        hops: links over which that has come; 0 while nothing has arrived.
        since: time since it arrived, in s; inf while nothing has arrived.
    """

    estimate: FloatArray
    bound: FloatArray
    age: float
    hops: int
    since: float


class Received(NamedTuple):
    """A state of an agent that has come in a message, predicted for now.

    Attributes:
        state: (n,); at first the centre of the initial set.
        stamp: when it was measured, in s; -inf while nothing has arrived.
        hops: links that it has come over; 0 while nothing has arrived.
        merging: when it was merged: messages that are merged at the same stage of a round are merged at once.
        sender: whose message it was.
        arrived: when it was merged, in s.
    """

    state: FloatArray
    stamp: float = -math.inf
    hops: int = 0
    merging: tuple[int, bool] = (0, False)
    sender: int = -1
    arrived: float = -math.inf

    def replaces(self, other: Received) -> bool:
        """Whether it is fresher: of those merged at once the lowest sender's wins a tie, else what was there before."""
        tie = self.stamp == other.stamp and self.merging == other.merging and self.sender <= other.sender
        return self.stamp > other.stamp or tie


class RemoteAgent:
    """The freshest state of one agent, its prediction and its box.

    Args:
        model: of the agent.
        step: usual interval between two updates, in s: one step of the prediction.
        disturbance: (n,) bound on |w|.
        noise: (n,) measurement noise of what the agent sends.
        center: (n,) of its initial set.
        radius: (n,) of its initial set, inf where nothing is known.
        skew: bound on the difference of any two clocks, in s.
        rounding: (n,) largest error of a number's rounding, made once on every link that the state has come.
        sampled: whether the agent follows x+ = x + step (f + g + w), in place of the differential equation.

    Attributes:
        freshest: what is known of it.
        reason: why nothing is certified of it; "" if every component has a bound.

    Raises:
        ValueError: for a sampled system with too long a step.
    """

    def __init__(
        self,
        model: AgentModel,
        *,
        step: float,
        disturbance: FloatArray,
        noise: FloatArray,
        center: FloatArray,
        radius: FloatArray,
        skew: float,
        rounding: FloatArray,
        sampled: bool,
    ) -> None:
        self._step, self._skew = step, skew
        self.freshest = Received(center)
        region = model.operating_region(np.abs(center) + radius, disturbance)
        self._known = _certificate(model, *(_frozen(values) for values in (disturbance, noise, region)))
        self._initial = _certificate(model, *(_frozen(values) for values in (disturbance, radius, region)))
        self._bounded = bool(np.isfinite(region).any())
        growth = self._growth = self._known.growth
        # in a sampled system, radii after 0, 1, ... steps: of the initial set, and of what has arrived
        self._in_steps = [[radius], [noise]] if sampled else None
        if sampled and step > self._known.longest_step * (1.0 + 1e-9):
            raise ValueError(
                f"sampled systems with {type(model).__name__} need steps of at most "
                f"{self._known.longest_step:.4g} s, or nothing is certain of them; got {step:g}"
            )
        self._drift, self.reason = extended_drift(model, growth), self._known.reason
        self._rounding = None
        if growth is None:
            return
        matrix, n = growth.matrix, model.n
        # Distances grow by this at most, and never shrink: errors may be made at any time.
        rising = np.where(np.eye(n, dtype=bool), np.maximum(matrix, 0.0), matrix)
        if rounding.any():
            self._rounding = RadiusTable(Growth(rising), np.zeros(n), rounding)
        if skew > 0.0:
            rate = self._known.rate
            augmented = np.zeros((n + 1, n + 1))
            augmented[:n, :n], augmented[:n, n] = rising, np.where(np.isfinite(rate), rate, 0.0)
            self._over_window = exponential(augmented, 2.0 * skew)[:n]
            self._over_quarter = exponential(rising, 0.25 * skew)

    def moved(self, state: FloatArray, t: float, dt: float) -> FloatArray:
        """The state (n,) that is predicted for `dt` s after time `t`, a step of `step` s after the other.

        Steps are explicit Euler's for a sampled system, else Runge-Kutta's of order 4.

        Raises:
            ValueError: if that takes more than 100 000 intervals.
        """
        if dt == 0.0:
            return state
        intervals = intervals_of(dt, self._step)
        if self._in_steps is not None:
            h = dt / intervals
            for k in range(intervals):
                state = state + h * self._rate(state, t + k * h)
            return state
        longest = LONGEST_STEP if self._growth is None else self._growth.step
        parts = max(1, math.ceil(abs(dt) / intervals / longest - 1e-9))
        age, steps = np.array([dt]), np.array([intervals * parts])
        return integrated(self._drift, state[None], np.array([t]), age, steps)[0]

    def estimate(self, t: float, dt: float, proposal: FloatArray | None) -> Estimate:
        """An estimate within the certified box.

        Args:
            t: now, in s.
            dt: time since what is known was predicted, in s.
            proposal: (n,) is clipped into the box; None for its centre.
        """
        known = self.freshest
        state = self.moved(known.state, t - dt, dt)
        box = self._box(state, t)
        if proposal is None:
            proposal = state  # the centre, without a finite region; so it is where nothing is certain
            if self._bounded:
                low, high = box
                with np.errstate(invalid="ignore"):
                    proposal = np.where(np.isfinite(self._known.region), 0.5 * (low + high), state)
        estimate = box.clip(proposal)
        # an empty box proves that some assumption doesn't hold: then nothing is certain
        bound = np.full(len(state), math.inf) if box.empty() else box.far_face(estimate)
        return Estimate(estimate, bound, t - known.stamp, known.hops, t - known.arrived)

    def _box(self, state: FloatArray, t: float) -> Box:
        """Where the agent is for certain, if `state` is what is predicted for now, `t`."""
        hops = self.freshest.hops
        age = t - self.freshest.stamp if hops else t
        certificate = self._known if hops else self._initial
        if self._in_steps is not None:
            radius = self._sampled_radius(self._in_steps[hops > 0], age)
        elif self._skew > 0.0:
            radius = self._with_skew(certificate, state, t, age)
        else:
            radius = certificate.radius(np.array(age))
        if self._rounding is not None:
            radius = radius + hops * self._rounding.at(np.array(age + self._skew))
        box = Box.around(state, radius)
        return box.intersect(Box(-certificate.region, certificate.region)) if self._bounded else box

    def _sampled_radius(self, kept: list[FloatArray], age: float) -> FloatArray:
        """The radius of r+ = r + h (min(Lambda r, spread) + g_bar + w_bar); `kept` are those after 0, 1, ... steps."""
        steps = intervals_of(age, self._step) if age > 0.0 else 0
        on_grid = abs(age - steps * self._step) <= 1e-9 * self._step
        radii, h = (kept, self._step) if on_grid else (kept[:1], age / steps)
        while len(radii) <= steps:
            radii.append(self._widened(radii[-1], h))
        return radii[steps] * (1.0 + 1e-9)

    def _widened(self, radius: FloatArray, h: float) -> FloatArray:
        growth = self._growth
        if growth is None:
            return np.full(len(radius), math.inf)
        with np.errstate(invalid="ignore"):
            apart = np.where(growth.matrix == 0.0, 0.0, growth.matrix * radius).sum(axis=1)
        return radius + h * (np.fmin(apart, growth.spread) + self._known.rate)

    def _with_skew(self, certificate: Certificate, state: FloatArray, t: float, age: float) -> FloatArray:
        """The radius where the true age is within the skew of `age`: its largest value, and the prediction's motion."""
        growth, skew = certificate.growth, self._skew
        late = certificate.radius(np.array(age + skew))
        if growth is None:
            return late
        with np.errstate(invalid="ignore"):
            falls = not (growth.matrix @ certificate.start + certificate.rate >= 0.0).all()
        if falls:  # r' keeps its sign where it is of one sign; else r is bounded from the window's beginning on
            early = np.append(certificate.radius(np.array(max(0.0, age - skew))), 1.0)
            with np.errstate(invalid="ignore"):
                late = np.where(self._over_window == 0.0, 0.0, self._over_window * early).sum(axis=1)
        # Speeds v = f(p) along the prediction obey |v|' <= Lambda |v|, which bounds those between two points.
        back = 0.25 * min(age, skew)
        rates = [self._rate(state, t)]
        for quarter in (-back, 0.25 * skew):
            p, now = state, t
            for _ in range(4):
                p, now = self.moved(p, now, quarter), now + quarter
                rates.append(self._rate(p, now))
        return late + skew * (np.abs(rates) @ self._over_quarter.T).max(axis=0)

    def _rate(self, state: FloatArray, t: float) -> FloatArray:
        return self._drift(np.array([t]), state[None])[0]


def intervals_of(dt: float, step: float) -> int:
    """Number of steps, at least 1, in which `dt` s are gone.

    Raises:
        ValueError: for more than 100 000.
    """
    intervals = max(1, round(abs(dt) / step))
    if intervals > _MOST_INTERVALS:
        raise ValueError(
            f"{dt:g} s at once are more than {_MOST_INTERVALS} steps of {step:g} s; times are in seconds since the "
            "fleet started, the same for all its agents"
        )
    return intervals


def _frozen(values: FloatArray) -> bytes:
    return np.asarray(values, np.float64).tobytes()


@functools.lru_cache(maxsize=512)
def _certificate(model: AgentModel, disturbance: bytes, start: bytes, region: bytes) -> Certificate:
    """A certificate, which takes ten milliseconds to tabulate: once for all agents and nodes alike."""
    disturbance_, start_, region_ = (np.frombuffer(values) for values in (disturbance, start, region))
    return Certificate(model, disturbance=disturbance_, start=start_, region=region_)
