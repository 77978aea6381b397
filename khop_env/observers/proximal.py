"""The paper's observers by a coupled proximal step: implicit-explicit Runge-Kutta, inside the funnels for any step.

docs/theory/step.md has the proof, and what is measured only.
"""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import NamedTuple

import numpy as np

from khop_env.elementary import combine
from khop_env.observers.base import Assumptions, Memory, Plant, PlantState, SolveError
from khop_env.observers.design import Funnels, ObserverDesign
from khop_env.observers.funnel_observers import FunnelObservers, weights_at
from khop_env.observers.layout import FloatArray
from khop_env.observers.prediction import Prediction
from khop_env.observers.solve import MAX_ITERATIONS
from khop_env.observers.solver import Solver
from khop_env.threads import Threads


@dataclass(frozen=True)
class Tableau:
    """An implicit-explicit Runge-Kutta pair: row s holds the weights of the stages before s (and, implicit, of s)."""

    nodes: tuple[float, ...]
    explicit: tuple[tuple[float, ...], ...]
    implicit: tuple[tuple[float, ...], ...]


_GAMMA = 1.0 - 1.0 / math.sqrt(2.0)
_DELTA = 1.0 - 1.0 / (2.0 * _GAMMA)
# ARS(1,1,1), ARS(2,2,2) and ARS(4,4,3): U. M. Ascher, S. J. Ruuth, R. J. Spiteri, Implicit-explicit Runge-Kutta methods
# for time-dependent partial differential equations, 1997. Stiffly accurate: a step's result is its last stage, which is
# a proximal step itself, so the funnel is kept at every grid point and in every stage.
TABLEAUS = {
    1: Tableau(nodes=(1.0,), explicit=((1.0,),), implicit=((1.0,),)),
    2: Tableau(
        nodes=(_GAMMA, 1.0),
        explicit=((_GAMMA,), (_DELTA, 1.0 - _DELTA)),
        implicit=((_GAMMA,), (1.0 - _GAMMA, _GAMMA)),
    ),
    3: Tableau(
        nodes=(1 / 2, 2 / 3, 1 / 2, 1.0),
        explicit=((1 / 2,), (11 / 18, 1 / 18), (5 / 6, -5 / 6, 1 / 2), (1 / 4, 7 / 4, 3 / 4, -7 / 4)),
        implicit=((1 / 2,), (1 / 6, 1 / 2), (-1 / 2, 1 / 2, 1 / 2), (3 / 2, -3 / 2, 1 / 2, 1 / 2)),
    ),
}


MOST_THREADS = 256


def _square(rows: tuple[tuple[float, ...], ...]) -> FloatArray:
    """Rows of a tableau as a matrix (stages, stages)."""
    return np.array([[*row, *[0.0] * (len(rows) - len(row))] for row in rows])


class Stages(NamedTuple):
    """The parts of a step's stages.

    Attributes:
        predicted: (stages, P, B) f(x_hat) + g_hat at the stage before.
        slopes: (stages, P, B) the state observers' correction at the stage.
        input_slopes: (stages, Q, B) the input observers'.
    """

    predicted: FloatArray
    slopes: FloatArray
    input_slopes: FloatArray


class Proximal(FunnelObservers):
    """Proximal step: the barrier is implicit, everything else explicit; |e| < 1 at every grid point for any step.

    Its memory adds "eps" (P, B) and "nu" (Q, B): the transformed disagreements, from which the next solve starts.

    Args:
        order: 1, 2 or 3.
        threads: number of threads that share the environments (or targets, in a small batch); results don't depend
            on it.

    Attributes:
        evaluations: of the barrier, in all steps so far.
        prediction: f(x_hat) + g_hat, once prepared.
        stages: the parts of the last step, once prepared.
        pool: the threads, once prepared.

    Raises:
        ValueError: if there is no such order, or threads is out of range.
    """

    name = "proximal"
    basis = "construction"

    def __init__(self, order: int = 2, threads: int = 1) -> None:
        if order not in TABLEAUS:
            raise ValueError(f"the proximal step exists at order 1, 2 and 3; got order={order!r}")
        if isinstance(threads, bool) or not isinstance(threads, int | np.integer) or not 1 <= threads <= MOST_THREADS:
            raise ValueError(f"threads must be an integer from 1 to {MOST_THREADS}; got {threads!r}")
        self.order, self.threads = order, threads
        self.evaluations = 0
        self._tableau = TABLEAUS[order]
        self._explicit, self._implicit = self._tableau.explicit, self._tableau.implicit
        self._dt = math.nan
        self._unit = np.array(self._tableau.nodes), _square(self._explicit), _square(self._implicit)
        self._scheme = math.nan, self._unit

    def __repr__(self) -> str:
        return f"Proximal(order={self.order}, threads={self.threads})"

    def prepare(self, design: ObserverDesign, num_envs: int, assumed: Assumptions) -> None:
        """Allocate the buffers for steps of `design` in `num_envs` environments."""
        super().prepare(design, num_envs, assumed)
        count, pairs, input_pairs = len(self._tableau.nodes), design.states.layout.size, design.inputs.layout.size
        self.prediction = Prediction(design, num_envs)
        self.stages = Stages(*(np.zeros((count, size, num_envs)) for size in (pairs, pairs, input_pairs)))
        self.pool = Threads(self.threads)
        self._solve_states = Solver(design.states.layout, num_envs, self.pool)
        self._solve_inputs = Solver(design.inputs.layout, num_envs, self.pool)

    def allocate(self) -> Memory:
        """Estimates and warm starts."""
        memory = super().allocate()
        return {**memory, "eps": np.zeros_like(memory["estimate"]), "nu": np.zeros_like(memory["input_estimate"])}

    def advance(self, plant: Plant, before: PlantState, state: PlantState, dt: float) -> None:
        """Advance `state`, a copy of `before`, by `dt` seconds, moving the `plant` with it.

        Raises:
            SolveError: if a state, input, disturbance or estimate isn't finite.
        """
        memory, last, weights = state.memory, before.memory, self._weights_of(dt)
        predicted, slopes, input_slopes = self.stages
        estimate, input_estimate = memory["estimate"], memory["input_estimate"]
        for s, node in enumerate(self._tableau.nodes):
            # rates at the stage before: the state holds that stage's values, at its time
            self.prediction.rate(state.t, estimate, input_estimate, predicted[s])
            explicit, implicit, tau = weights[s]
            plant.stage(s, explicit, node * dt, before, state)
            combine(last["estimate"], explicit, s + 1, predicted, estimate, 0, self.num_envs)
            if s:
                combine(estimate, implicit, s, slopes, estimate, 0, self.num_envs)
            rho = self.rho.at(state.t)
            of_states, of_inputs = weights_at(self.links, state)
            found = self._solve_states(tau, estimate, state.x, rho, memory["eps"], slopes[s], of_states)
            self.account(found, self.design.states, state.x, rho)
            plant.actuate(state)
            if self.design.inputs.layout.size:
                if s:
                    combine(last["input_estimate"], implicit, s, input_slopes, input_estimate, 0, self.num_envs)
                omega = self.omega.at(state.t)
                found = self._solve_inputs(
                    tau, input_estimate, state.g, omega, memory["nu"], input_slopes[s], of_inputs
                )
                self.account(found, self.design.inputs, state.g, omega)

    def scheme(self, dt: float) -> tuple[FloatArray, FloatArray, FloatArray]:
        """Times of the stages (S,), explicit and implicit weights (S, S), all in s, for a step of `dt` seconds."""
        if dt != self._scheme[0]:
            nodes, explicit, implicit = self._unit
            self._scheme = dt, (nodes * dt, explicit * dt, implicit * dt)
        return self._scheme[1]

    def _weights_of(self, dt: float) -> list[tuple[FloatArray, FloatArray, float]]:
        """Per stage the explicit weights, the implicit ones, and the last of these, all in s."""
        if dt != self._dt:
            explicit, implicit = ([np.array(row) * dt for row in rows] for rows in (self._explicit, self._implicit))
            self._weights = [(a, b, float(b[-1])) for a, b in zip(explicit, implicit, strict=True)]
            self._dt = dt
        return self._weights

    def account(self, found: list[tuple[int, int, int]], funnels: Funnels, source: FloatArray, rho: FloatArray) -> None:
        """Count the work of a solve of `funnels`, of the values `source` within `rho`, range by range.

        Raises:
            SolveError: if the solve failed, with the reason.
        """
        for evaluations, env, target in found:
            self.evaluations += evaluations
            if env >= 0:
                raise SolveError(self._failure(funnels, target, env, source, rho))

    def _failure(self, funnels: Funnels, target: int, env: int, source: FloatArray, rho: FloatArray) -> str:
        fleet, block = self.design.fleet, funnels.layout.blocks[target]
        observers = f"environment {env}, observers of {fleet.ids[block.agent]!r}: "
        kind = "state" if funnels is self.design.states else "input map"
        for c in range(block.components):
            value, width = source[block.sources.start + c, env], rho[block.rows.start + c, env]
            name = fleet.component_names()[block.sources.start + c][1]
            if not np.isfinite(value):
                return (
                    f"{observers}its {kind} became {value} in component {name!r}; check the agent model, the law and "
                    "the disturbance, or take a shorter step if the plant itself diverged"
                )
            if not (np.isfinite(width) and width > 0.0):
                return f"{observers}the funnel of component {name!r} became {width}; it has to be positive and finite"
        return (
            f"{observers}the estimates became non-finite, or the solve didn't converge in {MAX_ITERATIONS} "
            "iterations; check the agent model's drift at the estimates, and please report the latter"
        )
