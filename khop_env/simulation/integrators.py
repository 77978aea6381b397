"""What an integrator is, and the proximal one: implicit-explicit Runge-Kutta steps that stay inside the funnels."""

from __future__ import annotations

import itertools
import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from khop_env.compiled import compiled
from khop_env.observers import FloatArray, PairLayout
from khop_env.simulation import proximal
from khop_env.simulation.closed_loop import ClosedLoop
from khop_env.simulation.state import SimulatorState


class SolveError(RuntimeError):
    """A proximal step failed, which only numbers that aren't finite can make it do."""


class Integrator(Protocol):
    """Advances a `SimulatorState` by one step; observers of any realisation (batched or by messages) look like this."""

    name: str
    order: int

    def prepare(self, loop: ClosedLoop) -> None:
        """Allocate what steps of this closed loop need."""
        ...

    def start(self, state: SimulatorState) -> None:
        """Make u, g and the warm starts agree with t, x and the estimates; after a reset or a new held input."""
        ...

    def step(self, state: SimulatorState, dt: float) -> None:
        """Advance by `dt` seconds, in place."""
        ...


@dataclass(frozen=True)
class Tableau:
    """An implicit-explicit Runge-Kutta pair: row s holds the weights of the stages before s (and, implicit, of s)."""

    nodes: tuple[float, ...]
    explicit: tuple[tuple[float, ...], ...]
    implicit: tuple[tuple[float, ...], ...]


_GAMMA = 1.0 - 1.0 / math.sqrt(2.0)
_DELTA = 1.0 - 1.0 / (2.0 * _GAMMA)
# ARS(1,1,1) and ARS(2,2,2): U. M. Ascher, S. J. Ruuth, R. J. Spiteri, Implicit-explicit Runge-Kutta methods for
# time-dependent partial differential equations, 1997. Stiffly accurate: a step's result is its last stage, which is a
# proximal step itself, so the funnel is kept at every grid point and in every stage.
TABLEAUS = {
    1: Tableau(nodes=(1.0,), explicit=((1.0,),), implicit=((1.0,),)),
    2: Tableau(
        nodes=(_GAMMA, 1.0),
        explicit=((_GAMMA,), (_DELTA, 1.0 - _DELTA)),
        implicit=((_GAMMA,), (1.0 - _GAMMA, _GAMMA)),
    ),
}


@compiled
def _weighted_sum(base: FloatArray, weights: FloatArray, terms: tuple[FloatArray, ...], out: FloatArray) -> None:
    """Out = base + sum_k weights[k] terms[k], all of one shape."""
    base, out = base.ravel(), out.ravel()
    for q in range(base.size):
        out[q] = base[q]
    for k in range(len(terms)):
        term, weight = terms[k].ravel(), weights[k]
        for q in range(base.size):
            out[q] += weight * term[q]


class Proximal:
    """The barrier implicit, everything else explicit: |e| < 1 at every grid point, whatever the step (numerics).

    Args:
        order: 1 or 2.
        threads: environments (or targets, in a small batch) are solved by this many threads; results don't depend on
            it.

    Raises:
        ValueError: for another order or fewer than one thread.
    """

    name = "proximal"

    def __init__(self, order: int = 2, threads: int = 1) -> None:
        if order not in TABLEAUS:
            raise ValueError(f"the proximal step exists at order 1 and 2; got order={order!r}")
        if threads < 1:
            raise ValueError(f"threads must be at least 1; got {threads!r}")
        self.order, self.threads = order, threads
        self.evaluations = 0
        self._tableau = TABLEAUS[order]
        self._explicit = [np.array(row) for row in self._tableau.explicit]
        self._implicit = [np.array(row) for row in self._tableau.implicit]
        self._pool: tuple[int, ThreadPoolExecutor] | None = None

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "_pool": None}  # threads don't survive pickling or forking

    def prepare(self, loop: ClosedLoop) -> None:
        """Allocate what steps of this closed loop need."""
        self._loop = loop
        batch, n = loop.batch, loop.fleet.n
        pairs, input_pairs = loop.state_layout.size, loop.input_layout.size
        stages = len(self._tableau.nodes)
        self._plant = tuple(np.zeros((n, batch)) for _ in range(stages))
        self._belief = tuple(np.zeros((pairs, batch)) for _ in range(stages))
        self._slope = tuple(np.zeros((pairs, batch)) for _ in range(stages))
        self._input_slope = tuple(np.zeros((input_pairs, batch)) for _ in range(stages))
        self._x0, self._y0, self._ghat0 = (np.zeros((rows, batch)) for rows in (n, pairs, input_pairs))
        self._rho = np.ones((loop.state_layout.rows, batch))
        self._omega = np.ones((loop.input_layout.rows, batch))
        self._solve_states = self._solver(loop.state_layout)
        self._solve_inputs = self._solver(loop.input_layout) if input_pairs else None

    def start(self, state: SimulatorState) -> None:
        """Make u and g agree with t, x and the estimates."""
        self._command(state)

    def step(self, state: SimulatorState, dt: float) -> None:
        """Advance by `dt` seconds, in place.

        Raises:
            SolveError: if a state, input, disturbance or estimate isn't finite; the state is the one before the step.
        """
        t0 = state.t.copy()
        np.copyto(self._x0, state.x)
        np.copyto(self._y0, state.estimate)
        np.copyto(self._ghat0, state.input_estimate)
        try:
            self._stages(state, t0, dt)
        except SolveError:  # back to where the step began
            state.t[...], state.x[...], state.estimate[...], state.input_estimate[...] = (
                t0,
                self._x0,
                self._y0,
                self._ghat0,
            )
            self._command(state)
            raise

    def _stages(self, state: SimulatorState, t0: FloatArray, dt: float) -> None:
        loop = self._loop
        for s, node in enumerate(self._tableau.nodes):
            # slopes at the stage before; the state holds that stage's values, at its time
            loop.plant(state.t, state.x, state.g, state.drawn, self._plant[s])
            loop.belief(state.t, state.estimate, state.input_estimate, self._belief[s])
            explicit, implicit = self._explicit[s] * dt, self._implicit[s] * dt
            tau = float(implicit[s])
            np.add(t0, node * dt, out=state.t)
            _weighted_sum(self._x0, explicit, self._plant[: s + 1], state.x)
            _weighted_sum(self._y0, explicit, self._belief[: s + 1], state.estimate)
            if s:
                _weighted_sum(state.estimate, implicit[:s], self._slope[:s], state.estimate)
            loop.rho.evaluate(state.t, self._rho)
            self._solve_states(tau, state.estimate, state.x, self._rho, state.eps, self._slope[s])
            self._command(state)
            if self._solve_inputs is not None:
                if s:
                    _weighted_sum(self._ghat0, implicit[:s], self._input_slope[:s], state.input_estimate)
                loop.omega.evaluate(state.t, self._omega)
                self._solve_inputs(tau, state.input_estimate, state.g, self._omega, state.nu, self._input_slope[s])

    def _command(self, state: SimulatorState) -> None:
        self._loop.command(state.t, state.x, state.estimate, state.u)
        self._loop.fleet.input_map(state.t, state.x.T, state.u.T, state.g.T)

    def _solver(self, layout: PairLayout) -> Callable[..., None]:
        """The proximal solve of one layout, split over threads by environments or, in a small batch, by targets."""
        arrays = (layout.plan, layout.diagonal, layout.relay, layout.link_start, layout.link, layout.first)
        batch, targets = self._loop.batch, len(layout.plan)
        if batch >= self.threads * proximal.LANES:
            cuts = np.linspace(0, batch, self.threads + 1).astype(int).tolist()
            ranges = [((b0, b1), (0, targets)) for b0, b1 in itertools.pairwise(cuts)]
        else:
            cuts = np.linspace(0, targets, self.threads + 1).astype(int).tolist()
            ranges = [((0, batch), (t0, t1)) for t0, t1 in itertools.pairwise(cuts)]

        def solve(
            tau: float, y: FloatArray, source: FloatArray, rho: FloatArray, eps: FloatArray, slope: FloatArray
        ) -> None:
            if len(ranges) == 1:
                results = [proximal.solve(*arrays, tau, y, source, rho, eps, y, slope, *ranges[0])]
            else:
                results = list(
                    self._threads().map(
                        lambda part: proximal.solve(*arrays, tau, y, source, rho, eps, y, slope, *part), ranges
                    )
                )
            for evaluations, env, line in results:
                self.evaluations += evaluations
                if env >= 0:
                    raise SolveError(self._failure(layout, line, env, source, rho))

        return solve

    def _failure(self, layout: PairLayout, line: int, env: int, source: FloatArray, rho: FloatArray) -> str:
        fleet, (_, n, _, origin, row, _) = self._loop.fleet, layout.plan[line].tolist()
        who = f"environment {env}, observers of {fleet.ids[layout.target[line]]!r}: "
        kind = "state" if layout is self._loop.state_layout else "input map"
        for c in range(n):
            value, funnel, name = source[origin + c, env], rho[row + c, env], fleet.component_names()[origin + c][1]
            if not np.isfinite(value):
                return (
                    f"{who}its {kind} became {value} in component {name!r}; check the agent model, the law and the "
                    "disturbance, or take a shorter step if the plant itself diverged"
                )
            if not (np.isfinite(funnel) and funnel > 0.0):
                return f"{who}the funnel of component {name!r} became {funnel}; it has to be positive and finite"
        return (
            f"{who}the estimates became non-finite, or the solve didn't converge in {proximal.MAX_ITERATIONS} "
            "iterations; check the agent model's drift at the estimates, and please report the latter"
        )

    def _threads(self) -> ThreadPoolExecutor:
        if self._pool is None or self._pool[0] != os.getpid():  # a forked child has the object but not the threads
            self._pool = (os.getpid(), ThreadPoolExecutor(self.threads))
        return self._pool[1]
