"""Certified boxes: what a state known some time ago says about the state now, whatever the network did in between.

    certificate = Certificate(model, disturbance=0.1, start=noise)
    box = certificate.box(x_received, age)
    estimate = box.clip(estimate)
    bound = box.far_face(estimate)

Theory and proofs: docs/theory/certificates.md.
"""

from __future__ import annotations

import math

import numpy as np

from khop_env.observers.boxes import Box
from khop_env.observers.dead_reckoning import predict
from khop_env.observers.layout import FloatArray
from khop_env.observers.radius import RadiusTable
from khop_env.physics import AgentModel, Growth

_PROBES = 256


class Certificate:
    """Certified boxes of agents of one model, from a state known at some instant and the time since.

    Inputs have to be within the model's limits.

    Args:
        model: of the agent.
        disturbance: bound on |w| of each state, in state units per second; a number or (n,).
        start: largest error of the known state: the noise of what is sent, or the radius of the initial set; a number
            or (n,), inf where nothing is known.
        region: (n,) largest |x| of the true state at all times, e.g. `AgentModel.operating_region`; None for unknown.

    Attributes:
        growth: as the model declares it, None if it doesn't.
        rate: (n,) bound on |g| + |w|, in state units per second.
        longest_step: longest Euler step in s of a sampled system that is certified (docs/theory/certificates.md,
            "Sampled systems").
        reason: why nothing is certified; "" for a certificate that bounds every component.

    Raises:
        ValueError: for a negative or misshapen bound, or a declared growth that is seen to be too small.
    """

    def __init__(
        self,
        model: AgentModel,
        *,
        disturbance: FloatArray | float = 0.0,
        start: FloatArray | float = 0.0,
        region: FloatArray | None = None,
    ) -> None:
        self.model, n = model, model.n
        self.region = np.full(n, math.inf) if region is None else _bounds(region, n, "region")
        self.start, disturbance = _bounds(start, n, "start"), _bounds(disturbance, n, "disturbance")
        self.growth = model.drift_growth(self.region)
        self.rate = rate = model.checked_input_map_bound() + disturbance
        self.reason = _reason(model, self.growth, rate, self.start)
        self._table = None
        self.longest_step = math.inf
        if self.growth is not None:
            self.longest_step = _longest_step(model, self.growth, refuse_too_small(model, self.growth))
            self._table = RadiusTable(self.growth, rate, self.start)

    @property
    def certified(self) -> bool:
        """True if every component has a bound."""
        return not self.reason

    def radius(self, age: FloatArray) -> FloatArray:
        """Bound on |x - p| of each component, p predicted from the known state; inf where nothing is certified.

        Args:
            age: (...) time since the state was measured, in s; with clocks that may differ by s, s more (and see the
                documentation for models with a drift).

        Returns:
            (n, ...) in the states' units.

        Raises:
            ValueError: for an age that is negative or not a number.
        """
        age = np.asarray(age, np.float64)
        if not (age >= 0.0).all():
            raise ValueError(f"an age is a time since a message, not negative; got {age[~(age >= 0.0)].flat[0]!r}")
        if self._table is None:
            return np.full((self.model.n, *age.shape), math.inf)
        return self._table.at(age)

    def box(self, x: FloatArray, age: FloatArray, t: FloatArray | float = 0.0) -> Box:
        """The box that is certain to hold the state.

        Args:
            x: (n, B) known states.
            age: (B,) time since then, in s.
            t: (B,) when that was, in s, for drifts that depend on time.
        """
        center, error = predict(self.model, x, age, t, self.growth)
        box = Box.around(center, self.radius(age) + error)
        region = self.region.reshape(-1, *[1] * (center.ndim - 1))
        return box.intersect(Box(-region, region))


def refuse_too_small(model: AgentModel, growth: Growth) -> float:
    """Compare a declared growth with finite differences of the drift at random states and times.

    Returns:
        The fastest decay -df_j/dx_j that was seen, in 1/s, at least 0.

    Raises:
        ValueError: naming the entry that is exceeded.
    """
    rng, n = np.random.default_rng(0), model.n
    if growth.matrix.shape != (n, n):
        raise ValueError(f"{_name(model)}.drift_growth: matrix {growth.matrix.shape} for {n} states; expected {(n, n)}")
    reach, fastest = np.where(np.isfinite(growth.region), 0.999 * growth.region, 3.0), 0.0
    x, t = reach * rng.uniform(-1.0, 1.0, (_PROBES, n)), rng.uniform(0.0, 100.0, _PROBES)
    names = list(model.states)
    for state in range(n):
        step = 1e-5 * reach[state]
        ahead, behind = x.copy(), x.copy()
        ahead[:, state] += step
        behind[:, state] -= step
        slope = (model.drift(t, ahead) - model.drift(t, behind)) / (2.0 * step)
        fastest = max(fastest, -float(slope[:, state].min()))
        seen = np.where(np.arange(n) == state, slope, np.abs(slope)).max(axis=0)
        declared = growth.matrix[:, state]
        for row in np.flatnonzero(seen > declared + 1e-6 * (np.abs(declared) + np.abs(seen).max()))[:1]:
            raise ValueError(
                f"{_name(model)}.drift_growth: matrix[{row}, {state}] = {declared[row]:g}, but the rate of "
                f"{names[row]!r} changes by {seen[row]:.6g} per unit of {names[state]!r}; declare a bound"
            )
    seen = np.ptp(model.drift(np.full(_PROBES, t[0]), x), axis=0)
    for row in np.flatnonzero(seen > growth.spread * (1.0 + 1e-9))[:1]:
        raise ValueError(
            f"{_name(model)}.drift_growth: spread = {growth.spread[row]:g} for {names[row]!r}, but its rates "
            f"at some two states differ by {seen[row]:.6g}; declare a bound on that, or np.inf"
        )
    return fastest


def _longest_step(model: AgentModel, growth: Growth, seen: float) -> float:
    """1 over the fastest decay -df_j/dx_j of a drift: as declared, at most its Lipschitz constant, at least as seen.

    `Growth.step` is 1/16 over the largest rate; half of 1 over that is kept.
    """
    lipschitz = float(model.drift_lipschitz())
    fastest = max(seen, float(-np.diag(growth.matrix).min(initial=0.0)), lipschitz if math.isfinite(lipschitz) else 0.0)
    return min(8.0 * growth.step, 1.0 / fastest if fastest > 0.0 else math.inf)


def _reason(model: AgentModel, growth: Growth | None, rate: FloatArray, start: FloatArray) -> str:
    if growth is None:
        return (
            f"not certified: {_name(model)}.drift_growth() gives no bound on how its drift grows"
            " (some drifts have one in a bounded operating region)"
        )
    for bound, what in ((rate, "|g| + |w|"), (start, "the error of the known state")):
        for row in np.flatnonzero(~np.isfinite(bound)):
            return f"not certified: {what} has no bound in the state {list(model.states)[row]!r} of {_name(model)}"
    return ""


def _bounds(value: FloatArray | float, n: int, what: str) -> FloatArray:
    found = np.asarray(value, np.float64)
    if found.shape not in ((), (n,)) or not (found >= 0.0).all():
        raise ValueError(f"{what} must be a number or {n} numbers, not negative; got {value!r}")
    return np.broadcast_to(found, n).copy()


def _name(model: AgentModel) -> str:
    return model.__class__.__name__
