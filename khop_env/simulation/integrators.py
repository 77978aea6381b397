"""What an integrator is, and the proximal one: implicit-explicit Runge-Kutta steps that stay inside the funnels."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from khop_env.compiled import compiled
from khop_env.observers import FloatArray, PairLayout
from khop_env.physics import Fleet
from khop_env.simulation import proximal
from khop_env.simulation.closed_loop import ClosedLoop
from khop_env.simulation.solver import Solver
from khop_env.simulation.state import SimulatorState

MOST_THREADS = 256


class SolveError(RuntimeError):
    """A step met numbers that aren't finite, in a state, an input, a disturbance or an estimate."""


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
        ValueError: for another order, or a number of threads that isn't one or is too large.
    """

    name = "proximal"

    def __init__(self, order: int = 2, threads: int = 1) -> None:
        if order not in TABLEAUS:
            raise ValueError(f"the proximal step exists at order 1 and 2; got order={order!r}")
        if isinstance(threads, bool) or not isinstance(threads, int | np.integer) or not 1 <= threads <= MOST_THREADS:
            raise ValueError(f"threads must be an integer from 1 to {MOST_THREADS}; got {threads!r}")
        self.order, self.threads = order, threads
        self.evaluations = 0
        self._tableau = TABLEAUS[order]
        self._explicit = [np.array(row) for row in self._tableau.explicit]
        self._implicit = [np.array(row) for row in self._tableau.implicit]

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
        self._before = SimulatorState.zeros(batch, n, loop.fleet.m, pairs, input_pairs, 0)
        self._rho = np.ones((loop.state_layout.rows, batch))
        self._omega = np.ones((loop.input_layout.rows, batch))
        self._solve_states = Solver(loop.state_layout, batch, self.threads)
        self._solve_inputs = Solver(loop.input_layout, batch, self.threads)

    def start(self, state: SimulatorState) -> None:
        """Make u and g agree with t, x and the estimates."""
        self._loop.actuate(state.t, state.x, state.estimate, state.u, state.g)

    def step(self, state: SimulatorState, dt: float) -> None:
        """Advance by `dt` seconds, in place. Where anything raises, the state is the one before the step.

        Raises:
            SolveError: if a state, input, disturbance or estimate isn't finite.
        """
        state.copy_dynamic(self._before)
        try:
            self._stages(state, dt)
        except BaseException:
            self._before.copy_dynamic(state)
            raise

    def _stages(self, state: SimulatorState, dt: float) -> None:
        loop, before = self._loop, self._before
        for s, node in enumerate(self._tableau.nodes):
            # slopes at the stage before; the state holds that stage's values, at its time
            loop.plant(state.t, state.x, state.g, state.drawn, self._plant[s])
            loop.belief(state.t, state.estimate, state.input_estimate, self._belief[s])
            explicit, implicit = self._explicit[s] * dt, self._implicit[s] * dt
            tau = float(implicit[s])
            np.add(before.t, node * dt, out=state.t)
            _weighted_sum(before.x, explicit, self._plant[: s + 1], state.x)
            require_finite(state.x, loop.fleet)
            _weighted_sum(before.estimate, explicit, self._belief[: s + 1], state.estimate)
            if s:
                _weighted_sum(state.estimate, implicit[:s], self._slope[:s], state.estimate)
            loop.rho.evaluate(state.t, self._rho)
            found = self._solve_states(tau, state.estimate, state.x, self._rho, state.eps, self._slope[s])
            self._account(found, loop.state_layout, state.x, self._rho)
            self.start(state)
            if loop.input_layout.size:
                if s:
                    _weighted_sum(before.input_estimate, implicit[:s], self._input_slope[:s], state.input_estimate)
                loop.omega.evaluate(state.t, self._omega)
                found = self._solve_inputs(
                    tau, state.input_estimate, state.g, self._omega, state.nu, self._input_slope[s]
                )
                self._account(found, loop.input_layout, state.g, self._omega)

    def _account(
        self, found: list[tuple[int, int, int]], layout: PairLayout, source: FloatArray, rho: FloatArray
    ) -> None:
        """Count the work of a solve, and say why it failed if it did."""
        for evaluations, env, line in found:
            self.evaluations += evaluations
            if env >= 0:
                raise SolveError(self._failure(layout, line, env, source, rho))

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


def require_finite(x: FloatArray, fleet: Fleet) -> None:
    """Refuse states (n, B) that became NaN or infinite, also those of agents that nobody estimates.

    Raises:
        SolveError: naming the environment, agent and component.
    """
    if math.isfinite(x.sum()):
        return
    for column, env in np.argwhere(~np.isfinite(x)).tolist():
        agent, name, _ = fleet.component_names()[column]
        raise SolveError(
            f"environment {env}: state {name!r} of {agent!r} became {x[column, env]}; check its agent model, the law "
            "and the disturbance, or take a shorter step if the plant itself diverged"
        )
