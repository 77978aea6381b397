"""The plant under its law and disturbance, and its one stepper: implements `observers.Plant`.

Arrays are (columns, B) here, batch last and contiguous, because compiled loops run along the batch. Models, laws,
disturbances and users get views (B, ...) of them.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from khop_env.compiled import compiled, place
from khop_env.elementary import add_block, all_finite, combine
from khop_env.observers import FloatArray, PlantState, SolveError
from khop_env.physics import Fleet, read_only
from khop_env.physics.disturbance import AttachedDisturbance
from khop_env.physics.right_hand_sides import drifts, input_maps
from khop_env.physics.waveforms import disturb
from khop_env.simulation.edge_law import HELD, EdgeArrays, EdgeLaw, compiled_law, has_compiled_controllers
from khop_env.simulation.view import Law, ViewBuilder
from khop_env.threads import Range, Threads

_HELD: tuple[Any, ...] = tuple(EdgeLaw(HELD))

MOST_PARTS = 10_000
"""Steps of the integrator that one `Simulator.step` may be divided into."""


class FleetPlant:
    """x' = f(x) + g(x, u) + w(x, t) for a whole fleet, with u from a law or held.

    Args:
        fleet: the agents.
        num_envs: number of environments B.
        disturbance: an attached disturbance (`physics.Disturbance.attach`), or None.
        law: the feedback law, or None for inputs that are held.
        views: builds the law's view; needed with a law.
        saturated: whether inputs have to be within the models' limits: a law's are clipped, others refused.
        threads: that share the batch.

    Attributes:
        compiled: whether models, disturbance and law are the library's own, with a compiled form.
        runs: the fields of `physics.right_hand_sides.Runs` of all agents; None where a model is Python.
        terms: those of `physics.waveforms.TermArrays`; None where a disturbance is Python.
        edges: of the law.
        threads: that share the batch.
        ranges: of environments, one for each thread.
    """

    def __init__(
        self,
        fleet: Fleet,
        num_envs: int,
        disturbance: Any | None,
        law: Law | None,
        views: ViewBuilder | None,
        saturated: bool = False,
        threads: Threads | None = None,
    ) -> None:
        self.fleet, self.num_envs = fleet, num_envs
        self.disturbance, self.law, self.views = disturbance, law, views
        self.threads = threads or Threads(1)
        self.ranges = self.threads.ranges(num_envs)
        self._of_stage, self._of_effect = (self.threads.worthwhile(num_envs, cost * fleet.n) for cost in (10, 2))
        self._limit = fleet.input_limit[:, None] if saturated else None
        self._rates = np.zeros((0, fleet.n, num_envs))
        attached = AttachedDisturbance((), fleet) if disturbance is None else disturbance
        self.runs, self.terms = fleet.runs, attached.arrays if type(attached) is AttachedDisturbance else None
        edges = None if views is None else views.edge_arrays()
        self.edges = EdgeArrays.none(fleet) if edges is None else edges
        own_law = law is not None and (
            edges is None or not has_compiled_controllers(fleet) or compiled_law(law) is None
        )
        self._form: object = None
        self._law: tuple[Any, ...] = _HELD
        self.compiled = self.runs is not None and self.terms is not None and not own_law
        self._states = self._inputs = self._effects = self._drawn = np.zeros((0, 0))
        self._t = np.zeros(0)
        self._w = np.zeros((fleet.n, num_envs)).T  # (B, n) in the memory order of the states

    def rate(self, state: PlantState, out: FloatArray) -> None:
        """Write x' = f(x) + g + w(x, t) into `out` (n, B)."""
        states = self._bind(state)
        self.fleet.drift(self._t, states, out.T)
        out += state.g
        if self.disturbance is not None:
            out += self.disturbance(self._t, states, self._drawn, self._w).T

    def stage(self, number: int, weights: FloatArray, elapsed: float, before: PlantState, state: PlantState) -> None:
        """Move `state` to stage `number`: `before` plus the rates so far times `weights`, `elapsed` seconds later.

        Raises:
            SolveError: if a state isn't finite.
        """
        rates = self.rates_of(number + 1)
        if self.runs is None or self.terms is None:
            self.rate(state, rates[number])
            np.add(before.t, elapsed, out=state.t)
            combine(before.x, weights, number + 1, rates, state.x, 0, self.num_envs)
            require_finite(state.x, self.fleet)
            return
        arrays = before.t, before.x, state.t, state.x, state.g, rates, self._w.T
        common = self.runs, self.terms, state.drawn, number, elapsed, weights, *arrays

        def part(range_: Range) -> bool:
            return advance_plant(*common, *range_)

        if not all(self.threads.run(part, self._of_stage)):
            require_finite(state.x, self.fleet)

    def rates_of(self, stages: int) -> FloatArray:
        """(stages or more, n, B) x' at the stage before each stage of the last step."""
        if len(self._rates) < stages:
            grown = np.zeros((stages, self.fleet.n, self.num_envs))
            grown[: len(self._rates)] = self._rates
            self._rates = grown
        return self._rates

    def edge_law(self) -> tuple[Any, ...]:
        """The law's compiled form with its parameters as they are now, the fields of `EdgeLaw`."""
        if self.law is None:
            return _HELD
        form = self.law.edge_law()  # type: ignore[attr-defined]
        if form != self._form:
            direct = self.law.is_input(self.fleet, int(self.edges.edges.max(initial=0)))  # type: ignore[attr-defined]
            kind, gain, second, cancel, _ = form
            self._form, self._law = form, (int(kind), float(gain), float(second), bool(cancel), not direct)
        return self._law

    def actuate(self, state: PlantState) -> None:
        """Write the law's inputs into `state.u` (m, B), without a law leave the held ones there; then g(x, u).

        Raises:
            ValueError: if the law returns inputs of a wrong shape.
        """
        if self.law is not None:
            self._bind(state)
            assert self.views is not None
            u = self.law(self._t, self.views.update(state))
            if np.shape(u) != (self.num_envs, self.fleet.m):
                raise ValueError(
                    f"law {self.law!r} returned inputs of shape {np.shape(u)}; expected (environments, inputs) = "
                    f"{(self.num_envs, self.fleet.m)}"
                )
            state.u.T[:] = u
            if self._limit is not None:
                np.clip(state.u, -self._limit, self._limit, out=state.u)
        self.effect(state)

    def effect(self, state: PlantState) -> None:
        """Write g(x, u) of the inputs in force."""
        if self.runs is None:
            self.fleet.input_map(self._t, self._bind(state), self._inputs, self._effects)
            return
        common = self.runs, state.x, state.u, state.g
        self.threads.run(lambda range_: input_maps(*common, *range_), self._of_effect)

    def checked_inputs(self, u: ArrayLike) -> FloatArray:
        """Inputs (m,) or (B, m) that are to be held, checked.

        Raises:
            ValueError: where a law computes the inputs, for a wrong shape or numbers that aren't finite, and over a
                network for inputs beyond their limits.
        """
        if self.law is not None:
            raise ValueError("this simulator has a law, which computes the inputs; build it with law=None to give u")
        inputs = np.asarray(u, dtype=float)
        if inputs.shape not in ((self.fleet.m,), (self.num_envs, self.fleet.m)):
            raise ValueError(
                f"u must have shape ({self.fleet.m},) or {(self.num_envs, self.fleet.m)}; got {inputs.shape}"
            )
        if not np.isfinite(inputs).all():
            bad = np.flatnonzero(~np.isfinite(inputs.reshape(-1, self.fleet.m)).all(axis=0))
            agent, name, unit = self.fleet.input_names()[bad[0]]
            raise ValueError(f"input {name!r} ({unit}) of {agent!r} isn't finite")
        if self._limit is not None:
            largest = np.abs(inputs).reshape(-1, self.fleet.m).max(axis=0)
            for row in np.flatnonzero(largest > self.fleet.input_limit * (1.0 + 1e-6))[:1]:  # may be float32, rounded
                agent, name, unit = self.fleet.input_names()[row]
                raise ValueError(
                    f"input {name!r} of {agent!r} is {largest[row]:g} {unit} in size, beyond its limit "
                    f"{self.fleet.input_limit[row]:g}, and certified bounds over a network assume it isn't: clip it"
                )
        return inputs

    def _bind(self, state: PlantState) -> FloatArray:
        """The states (B, n) as models see them; read-only views are made once, and again for another state's arrays."""
        if self._states.base is not state.x:
            self._states, self._inputs = read_only(state.x.T), read_only(state.u.T)
            self._t, self._drawn = read_only(state.t[:]), read_only(state.drawn[:])
            self._effects = state.g.T
        return self._states


@compiled
def advance_plant(
    runs: Any,
    terms: Any,
    drawn: FloatArray,
    number: int,
    elapsed: float,
    weights: FloatArray,
    t0: FloatArray,
    x0: FloatArray,
    t: FloatArray,
    x: FloatArray,
    g: FloatArray,
    rates: FloatArray,
    w: FloatArray,
    low: int,
    high: int,
) -> bool:
    """`FleetPlant.stage` in the environments low to high - 1.

    Args:
        runs: the fields of `physics.right_hand_sides.Runs`, of all agents.
        terms: those of `physics.waveforms.TermArrays`.
        drawn: (B, K) the disturbance's random numbers.
        number: of the stage.
        elapsed: its time after the beginning of the step, in s.
        weights: (number + 1 or more,) of the rates so far, in s.
        t0: (B,) time at the beginning.
        x0: (n, B) states there.
        t: (B,) time of the stage before, overwritten with that of the stage.
        x: (n, B) states, likewise.
        g: (n, B) effect of the inputs at the stage before.
        rates: (stages, n, B) x'; that of this number is written.
        w: (n, B) scratch.
        low: first environment.
        high: one past the last.

    Returns:
        Whether all states are finite.
    """
    rate = rates[number]
    drifts(runs, x, rate, low, high)
    add_block(g, rate, low, high)
    if terms[0].size:
        disturb(terms, t, x, drawn, w, low, high)
        add_block(w, rate, low, high)
    for e in range(low, high):
        t[e] = t0[e] + elapsed
    combine(x0, weights, number + 1, rates, x, low, high)
    total = 0.0
    for row in range(x.shape[0]):
        for e in range(high - low):
            total += 0.0 * x[row, place(low + e)]  # 0, or NaN once and for all
    return total == 0.0


def require_finite(x: FloatArray, fleet: Fleet) -> None:
    """Refuse states (n, B) that became NaN or infinite, also those of agents without observers.

    Raises:
        SolveError: naming the environment, agent and component.
    """
    if all_finite(x):
        return
    for column, env in np.argwhere(~np.isfinite(x)).tolist():
        agent, name, _ = fleet.component_names()[column]
        raise SolveError(
            f"environment {env}: state {name!r} of {agent!r} became {x[column, env]}; check its agent model, the law "
            "and the disturbance, or take a shorter step if the plant itself diverged"
        )


def parts_of_step(dt: float, longest: float, reason: str) -> int:
    """Number of equal parts into which a step is divided.

    Args:
        dt: step in s.
        longest: longest step in s.
        reason: what doesn't take longer ones, for the error.

    Raises:
        ValueError: for more than `MOST_PARTS`.
    """
    if dt > MOST_PARTS * longest:
        raise ValueError(
            f"dt = {dt:g} s is too long: {reason} takes {longest:.3g} s at a time, and no step is "
            f"divided into more than {MOST_PARTS} parts; take dt of {MOST_PARTS * longest:.3g} s at most"
        )
    return max(1, math.ceil(dt / longest - 1e-9))  # 0.2 - 0.15 is 0.05, not two parts of it
