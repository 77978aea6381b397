"""Measurement of Theorem 4 (docs/theory/set_iss.md): the distance at which errors keep a team from its goal set.

Two experiments on a scenario's closed loop, whose goal set A is agreement of the positions:

- `injected_errors`: the law acts on true states plus errors of a prescribed norm; the ultimate distance to A divided by
  that norm is the empirical set-ISS gain, listed beside the analytical one (`ComparisonGain`).
- `swept_bounds`: the law acts on the observers' estimates, and the bounds' final value delta(inf) is swept.
"""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.laws import make_law
from agents.lyapunov import ComparisonGain
from agents.workers import Interrupted, UnfinishedError
from khop_env.observers import DesignError, Exponential, FloatArray, TargetObservers
from khop_env.results.metrics import consensus_error, finite
from khop_env.results.recording import Progress
from khop_env.scenarios import Scenario
from khop_env.simulation import Law, Simulator, View
from khop_env.tasks import directed

SIZES = tuple(float(f"{size:.3g}") for size in np.geomspace(0.02, 2.0, 7))  # m
FACTORS = tuple(float(f"{factor:.3g}") for factor in np.geomspace(10.0, 0.1, 7))  # of the scenario's delta(inf)
PATTERNS = ("constant", "swinging", "adversarial")
TAIL = 0.25  # last fraction of a run, in which ultimate values are taken
BEGIN = 0.3  # fraction of a run after which the observers' transient is over and the paired oracle run begins

_ROUNDING = 1e-4  # relative: errors of the simulator's and of the comparison's steps


def analytical_gain(scenario: Scenario) -> ComparisonGain | None:
    """The set-ISS gain of the scenario's law; None if it can only be measured."""
    derive = getattr(make_law(scenario.law), "set_iss_gain", None)
    return None if derive is None else derive(scenario)


class PerturbedLaw:
    """A law with errors of prescribed norm on the positions of agents that aren't neighbours.

    Constant errors have random directions; swinging ones rotate between two; adversarial ones drive every agent away
    from the mean, which increases the Lyapunov function most. The stacked error of an environment always has the norm
    `size`.

    Args:
        law: the unperturbed law.
        size: norm of the stacked error, in m.
        perturbed: (E,) task edges that carry errors.
        rng: draws directions and frequencies.
        batch: number of environments; the patterns alternate.
        dim: dimension of a position.
    """

    def __init__(
        self, law: Law, size: float, perturbed: NDArray[np.bool_], rng: np.random.Generator, batch: int, dim: int
    ) -> None:
        self.size, self._law, self._perturbed = size, law, perturbed
        shape = 2, batch, int(perturbed.sum()), dim
        self._directions = rng.normal(size=shape)
        self._frequency = rng.uniform(0.2, 5.0, batch)  # rad/s
        self._pattern = np.arange(batch) % len(PATTERNS)
        self._seen: View | None = None

    def errors(self, t: FloatArray, view: View) -> FloatArray:
        """(B, perturbed edges, d) errors in m."""
        first, second = self._directions
        angle = np.where(self._pattern == 1, self._frequency * t, 0.0)[:, None, None]
        errors = np.cos(angle) * first + np.sin(angle) * second
        positions = view.fleet.positions(view.x)
        away = (positions - positions.mean(axis=1, keepdims=True))[:, view.edges[self._perturbed, 0]]
        errors = np.where((self._pattern == 2)[:, None, None], away, errors)
        length = np.sqrt((errors**2).sum(axis=(1, 2), keepdims=True))
        return np.asarray(self.size * errors / np.maximum(length, 1e-12))

    def __call__(self, t: FloatArray, view: View) -> FloatArray:
        """Inputs (B, m) of the law on true states plus errors."""
        if self._seen is None:
            self._seen = dataclasses.replace(view)  # the same object in all calls, as laws expect
        self._seen.x, self._seen.displacement = view.x, view.displacement.copy(order="K")
        self._seen.displacement[:, self._perturbed] += self.errors(t, view)
        return self._law(t, self._seen)


def injected_errors(
    scenario: Scenario,
    *,
    sizes: Sequence[float] = SIZES,
    episodes: int = 8,
    seed: int = 0,
    progress: Progress | None = None,
) -> list[dict[str, Any]]:
    """The ultimate distance to A of the law on true states plus errors, without disturbances.

    Args:
        scenario: provides fleet, graphs and law.
        sizes: norms of the stacked error in m.
        episodes: number of initial states for each pattern of errors.
        seed: seed of the initial states and the errors.
        progress: called with the completed fraction.

    Returns:
        One row per size and pattern: `error` and `pattern`; `distance`, the largest in the last quarter of a run over
        the episodes; `gain`, distance over error; `bound`, the ultimate bound by the analytical gain or None; and
        `holds`, whether every run stayed below the solution of the comparison equation through the last quarter, or
        None if there is none. Lengths are in m.

    Raises:
        Interrupted: on Ctrl-C; its `partial` holds the rows until then.
    """
    calm, bound, batch = scenario.replace(disturbance=None), analytical_gain(scenario), episodes * len(PATTERNS)
    edges = directed(calm.task)
    perturbed = np.array([not calm.communication.has_edge(j, i) for i, j in edges.tolist()], bool)
    x0 = [calm.initial.draw(np.random.default_rng(seed + b // len(PATTERNS))) for b in range(batch)]
    steps = round(calm.duration / calm.dt)
    rows: list[dict[str, Any]] = []

    def inject(number: int, size: float) -> Iterator[dict[str, Any]]:
        rng = np.random.default_rng([seed, 2])  # the same directions for every size
        law = PerturbedLaw(make_law(calm.law), size, perturbed, rng, batch, calm.fleet.position_dim)
        simulator = calm.build(law=law, observe="oracle", num_envs=batch)
        simulator.reset(seed, x0)
        distance, kept = np.zeros(batch), np.ones(batch, bool)
        limit = np.full(batch, math.inf)
        for step in range(steps):
            simulator.step(calm.dt)
            now = consensus_error(calm.fleet, simulator.x)
            if step >= (1.0 - TAIL) * steps:
                distance = np.maximum(distance, now)
                if bound is not None:
                    limit = bound.step(limit, np.full(batch, size), calm.dt)
                    kept &= now <= limit * (1.0 + _ROUNDING)
            else:
                limit = now
            if progress is not None and step % 100 == 0:
                progress((number + step / steps) / len(sizes))
        analytical = None if bound is None else finite(bound.ultimate(size))
        for kind, pattern in enumerate(PATTERNS):
            selected = slice(kind, None, len(PATTERNS))
            worst = float(distance[selected].max())
            holds = bool(kept[selected].all()) if np.isfinite(limit[selected]).all() else None
            measured = {"distance": worst, "gain": worst / size, "bound": analytical, "holds": holds}
            yield {"error": size, "pattern": pattern, **measured}

    try:
        for number, size in enumerate(sizes):
            rows += inject(number, size)
    except KeyboardInterrupt:
        raise Interrupted(rows) from None
    return rows


def swept_bounds(
    scenario: Scenario,
    *,
    factors: Sequence[float] = FACTORS,
    episodes: int = 16,
    seed: int = 0,
    progress: Progress | None = None,
) -> list[dict[str, Any]]:
    """The distance to A on estimates, for bounds whose final values are multiples of the scenario's.

    After the observers' transient each run is paired with a run from the same state whose law acts on true states; its
    distance is the floor. The excess, the absolute difference of the two distances, is the effect of the estimates.
    Every combination runs with and without disturbances, with the scenario's observers ("as designed"), and with
    observers that use neither drift nor inputs ("bare", Theorem 2), whose errors don't vanish in agreement.

    Args:
        scenario: provides fleet, graphs, observers and law; its bounds must be `Exponential`.
        factors: multiples of delta(inf).
        episodes: number of episodes per row.
        seed: seed of the initial states and disturbances.
        progress: called with the completed fraction.

    Returns:
        One row per factor, kind of observers, and with or without disturbance: observers, disturbed, factor, delta
        (the smallest delta(inf) of a position, in m), error (largest norm of the errors in the law's arguments, in m),
        floor, distance, excess (largest values over all episodes in the last quarter of a run, in m), bound (on the
        distance, in m, by the comparison equation of `ComparisonGain` with the errors and disturbances measured at the
        steps; None if these are too large for it), holds (whether every run stayed below it, to a relative 1e-4),
        normalized (largest |xi| / rho).

    Raises:
        ValueError: if a bound isn't `Exponential`.
        DesignError: if observers can't be designed for a factor, before any simulation.
        UnfinishedError: if the observers can't start from a drawn initial state; its `partial` holds the rows until
            then.
        Interrupted: on Ctrl-C, with the same `partial`.
    """
    designs: list[tuple[str, bool, float]] = [
        (kind, disturbed, factor)
        for kind in ("as designed", "bare")
        for disturbed in (False, True)
        for factor in factors
    ]
    variants = []
    for kind, disturbed, factor in designs:
        if disturbed and scenario.disturbance is None:
            continue
        variant = with_final_bounds(scenario, factor)
        if kind == "bare":
            variant = variant.replace(
                observers=(TargetObservers(drift=False, input_observer=False),) * len(variant.models), theta=None
            )
        if not disturbed:
            variant = variant.replace(disturbance=None)
        try:
            variant.build()  # design errors appear before the first simulation
        except DesignError as error:
            if kind == "bare":
                continue  # inputs without a bound: they need their observers
            raise DesignError(f"delta(inf) x {factor:g}: {error}") from error
        variants.append(({"observers": kind, "disturbed": disturbed, "factor": factor}, variant))
    rows: list[dict[str, Any]] = []
    try:
        for number, (names, variant) in enumerate(variants, 1):
            try:
                rows.append({**names, **_paired(variant, episodes, seed)})
            except DesignError as error:
                if names["observers"] != "bare":
                    raise UnfinishedError(f"delta(inf) x {names['factor']:g}: {error}", rows) from error
            if progress is not None:
                progress(number / len(variants))
    except KeyboardInterrupt:
        raise Interrupted(rows) from None
    return rows


def slope(rows: Sequence[Mapping[str, Any]], x: str, y: str) -> float | None:
    """Slope of log y over log x by least squares, over rows in which both are positive; None for fewer than two."""
    points = np.log([(row[x], row[y]) for row in rows if row[x] > 0.0 and row[y] > 0.0])
    if len(points) < 2:
        return None
    return float(np.polyfit(points[:, 0], points[:, 1], 1)[0])


def with_final_bounds(scenario: Scenario, factor: float) -> Scenario:
    """The scenario with every delta(inf) scaled; the transient part delta(0) - delta(inf) stays.

    Raises:
        ValueError: if a bound isn't `Exponential`.
    """

    def scaled(bound: Any) -> Exponential:
        if not isinstance(bound, Exponential):
            raise ValueError(f"only Exponential bounds can be swept; {scenario.name!r} has {bound!r}")
        return Exponential(bound.initial + (factor - 1.0) * bound.final, factor * bound.final, bound.rate)

    delta = scenario.delta
    if not isinstance(delta, Mapping):
        return scenario.replace(delta=scaled(delta))
    return scenario.replace(
        delta={
            kind: [scaled(component) for component in bound] if isinstance(bound, Sequence) else scaled(bound)
            for kind, bound in delta.items()
        }
    )


def _paired(scenario: Scenario, episodes: int, seed: int) -> dict[str, Any]:
    """A row of `swept_bounds`: runs on estimates, paired after the transient with runs on true states."""
    run, oracle = (
        scenario.build(law=make_law(scenario.law), observe=mode, num_envs=episodes) for mode in ("estimate", "oracle")
    )
    run.reset(seed)
    read, truth = _read_columns(scenario)
    steps = round(scenario.duration / scenario.dt)
    begin, tail = round(BEGIN * steps), round((1.0 - TAIL) * steps)
    distance, floor, error, allowed, excess = np.zeros((5, episodes))
    comparison = analytical_gain(scenario)
    push = _Push(scenario, run)
    before, kept = np.zeros((2, episodes)), True
    for step in range(steps):
        if step == begin:
            oracle.restore(run.save())
            limit = consensus_error(run.fleet, run.x)
        run.step(scenario.dt)
        now = np.array([np.linalg.norm(run.estimates[:, read] - run.x[:, truth], axis=1), push()])
        if step < begin:
            before = now
            continue
        oracle.step(scenario.dt)
        on_estimates, on_truth = consensus_error(run.fleet, run.x), consensus_error(run.fleet, oracle.x)
        error = np.maximum(error, now[0])
        if comparison is not None:
            largest = np.maximum(now, before)
            limit = comparison.step(limit, largest[0], scenario.dt, largest[1])
            kept &= bool(np.all(on_estimates <= limit * (1.0 + _ROUNDING)))
        before = now
        if step >= tail:
            distance, floor = np.maximum(distance, on_estimates), np.maximum(floor, on_truth)
            excess = np.maximum(excess, np.abs(on_estimates - on_truth))
            allowed = np.maximum(allowed, limit)
    limit_reached = None if comparison is None else finite(float(allowed.max()))
    layout = scenario.design.states.layout
    positions = np.isin(layout.row_source, scenario.fleet.position_index)
    return {
        "delta": min(
            bound.infimum() for bound, used in zip(scenario.design.states.bounds, positions, strict=True) if used
        ),
        "error": float(error.max()),
        "floor": float(floor.max()),
        "distance": float(distance.max()),
        "excess": float(excess.max()),
        "bound": limit_reached,
        "holds": None if limit_reached is None else kept,
        "normalized": float(max(run.extremes.normalized.max(), run.extremes.input_normalized.max())),
    }


class _Push:
    """Norm |Pi w| of the disturbance along a run that has been reset, in m/s."""

    def __init__(self, scenario: Scenario, run: Simulator) -> None:
        disturbance, self._run = scenario.disturbance, run
        self._attached = None if disturbance is None else disturbance.attach(scenario.fleet)
        self._drawn, self._w = run.save().drawn, np.zeros(run.x.shape[::-1]).T

    def __call__(self) -> FloatArray:
        run = self._run
        if self._attached is not None:
            self._attached(run.t, run.x, self._drawn, self._w)
        return consensus_error(run.fleet, self._w)


def _read_columns(scenario: Scenario) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Columns of the estimates that the law uses, and of the corresponding true states."""
    fleet, slot = scenario.fleet, scenario.design.states.layout.slot
    read, truth = [], []
    for i, j in directed(scenario.task).tolist():
        if not scenario.communication.has_edge(j, i):
            read.append(slot[i, j] + fleet.position_index[j] - fleet.state_offset[j])
            truth.append(fleet.position_index[j])
    return np.array(read, np.int64).reshape(-1), np.array(truth, np.int64).reshape(-1)
