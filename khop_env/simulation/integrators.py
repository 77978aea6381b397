"""How time advances: the proximal (implicit-explicit) step and the explicit one, over the same right-hand sides."""

from __future__ import annotations

import math
import os
from collections.abc import Callable
from concurrent.futures import ThreadPoolExecutor
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from khop_env.compiled import compiled
from khop_env.observers import FloatArray, Funnels, PairLayout
from khop_env.observers.disagreement import correction, disagreement, largest_curvature
from khop_env.simulation import proximal
from khop_env.simulation.closed_loop import ClosedLoop
from khop_env.simulation.state import SimulatorState


class FunnelError(RuntimeError):
    """An explicit step left the funnel, where the observers are no longer defined; a shorter step would not have."""


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
def _weighted_sum(
    base: FloatArray, weights: FloatArray, terms: tuple[FloatArray, ...], out: FloatArray
) -> None:
    """out = base + sum_k weights[k] terms[k], all of one shape."""
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
        self._command(state, state.t)

    def step(self, state: SimulatorState, dt: float) -> None:
        """Advance by `dt` seconds, in place.

        Raises:
            SolveError: if a state, input, disturbance or estimate isn't finite.
        """
        loop = self._loop
        t0 = state.t.copy()
        np.copyto(self._x0, state.x)
        np.copyto(self._y0, state.estimate)
        np.copyto(self._ghat0, state.input_estimate)
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
            self._command(state, state.t)
            if self._solve_inputs is not None:
                if s:
                    _weighted_sum(self._ghat0, implicit[:s], self._input_slope[:s], state.input_estimate)
                loop.omega.evaluate(state.t, self._omega)
                self._solve_inputs(tau, state.input_estimate, state.g, self._omega, state.nu, self._input_slope[s])

    def _command(self, state: SimulatorState, t: FloatArray) -> None:
        self._loop.command(t, state.x, state.estimate, state.u)
        self._loop.fleet.input_map(t, state.x.T, state.u.T, state.g.T)

    def _solver(self, layout: PairLayout) -> Callable[..., None]:
        """The proximal solve of one layout, split over threads by environments or, in a small batch, by targets."""
        arrays = (layout.plan, layout.diagonal, layout.relay, layout.link_start, layout.link, layout.first)
        batch, targets = self._loop.batch, len(layout.plan)
        if batch >= self.threads * proximal.LANES:
            cuts = np.linspace(0, batch, self.threads + 1).astype(int).tolist()
            ranges = [((b0, b1), (0, targets)) for b0, b1 in zip(cuts, cuts[1:], strict=False)]
        else:
            cuts = np.linspace(0, targets, self.threads + 1).astype(int).tolist()
            ranges = [((0, batch), (t0, t1)) for t0, t1 in zip(cuts, cuts[1:], strict=False)]

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
                    agent = self._loop.fleet.ids[layout.target[line]]
                    raise SolveError(
                        f"environment {env}: the observers of {agent!r} got a state, input or funnel that isn't "
                        f"finite and positive (state {source[layout.plan[line, 3], env]}); check the agent model, the "
                        "law and the disturbance, or take a shorter step if the plant itself diverged"
                    )

        return solve

    def _threads(self) -> ThreadPoolExecutor:
        if self._pool is None or self._pool[0] != os.getpid():  # a forked child has the object but not the threads
            self._pool = (os.getpid(), ThreadPoolExecutor(self.threads))
        return self._pool[1]


class RightHandSide(Protocol):
    """The observers' whole derivative, however it is computed: batched, or agent by agent from messages."""

    def __call__(
        self, state: SimulatorState, rho: FloatArray, omega: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """Derivatives of the state and input estimates, (P, B) and (Q, B), then e and q of the same shapes."""
        ...


class BatchedRightHandSide:
    """The observers' derivative for all environments at once."""

    def __init__(self, loop: ClosedLoop) -> None:
        self._loop = loop
        self._buffers = [np.zeros((layout.size, loop.batch)) for layout in (loop.state_layout, loop.input_layout) * 3]
        self._belief = np.zeros((loop.state_layout.size, loop.batch))

    def __call__(
        self, state: SimulatorState, rho: FloatArray, omega: FloatArray
    ) -> tuple[FloatArray, FloatArray, FloatArray, FloatArray]:
        """See `RightHandSide`."""
        xi, mu, e, q, dy, dghat = self._buffers
        loop = self._loop
        for layout, estimate, source, funnel, difference, normalized, rate in (
            (loop.state_layout, state.estimate, state.x, rho, xi, e, dy),
            (loop.input_layout, state.input_estimate, state.g, omega, mu, q, dghat),
        ):
            disagreement(*layout.arrays, estimate, source, difference)
            correction(layout.plan, difference, funnel, normalized, rate)
        loop.belief(state.t, state.estimate, state.input_estimate, self._belief)
        dy += self._belief
        return dy, dghat, e, q


class Explicit:
    """Forward Euler, as the paper samples its example: needs steps of about 1e-5 s.

    Args:
        right_hand_side: makes the observers' derivative for a closed loop; batched by default.
    """

    name = "explicit"
    order = 1

    def __init__(self, right_hand_side: Callable[[ClosedLoop], RightHandSide] = BatchedRightHandSide) -> None:
        self._make = right_hand_side

    def prepare(self, loop: ClosedLoop) -> None:
        """Allocate what steps of this closed loop need."""
        self._loop = loop
        self._derivative = self._make(loop)
        self._dx = np.zeros((loop.fleet.n, loop.batch))
        self._rho = np.ones((loop.state_layout.rows, loop.batch))
        self._omega = np.ones((loop.input_layout.rows, loop.batch))
        self._xi = [np.zeros((layout.size, loop.batch)) for layout in (loop.state_layout, loop.input_layout)]

    def start(self, state: SimulatorState) -> None:
        """Make u and g agree with t, x and the estimates."""
        self._loop.command(state.t, state.x, state.estimate, state.u)
        self._loop.fleet.input_map(state.t, state.x.T, state.u.T, state.g.T)

    def step(self, state: SimulatorState, dt: float) -> None:
        """Advance by `dt` seconds, in place.

        Raises:
            FunnelError: if a disagreement leaves its funnel; the state is then the last one inside.
        """
        loop = self._loop
        loop.rho.evaluate(state.t, self._rho)
        loop.omega.evaluate(state.t, self._omega)
        dy, dghat, e, q = self._derivative(state, self._rho, self._omega)
        before = state.copy()
        loop.plant(state.t, state.x, state.g, state.drawn, self._dx)
        state.x += dt * self._dx
        state.estimate += dt * dy
        state.input_estimate += dt * dghat
        state.t += dt
        self.start(state)
        for kind, funnels, bank, funnel, estimate, source, xi, e_before in (
            ("state", loop.design.states, loop.rho, self._rho, state.estimate, state.x, self._xi[0], e),
            ("input", loop.design.inputs, loop.omega, self._omega, state.input_estimate, state.g, self._xi[1], q),
        ):
            funnel_before = funnel.copy()
            bank.evaluate(state.t, funnel)
            disagreement(*funnels.layout.arrays, estimate, source, xi)
            ratio = np.abs(xi) / funnel[funnels.layout.column_row]
            if not np.all(ratio < 1.0):
                message = _left_funnel(loop, kind, funnels, ratio, e_before, funnel_before, float(dt), before.t)
                state.assign(before)
                raise FunnelError(message)


def _left_funnel(
    loop: ClosedLoop,
    kind: str,
    funnels: Funnels,
    ratio: FloatArray,
    e: FloatArray,
    funnel: FloatArray,
    dt: float,
    t: FloatArray,
) -> str:
    """Which observer left its funnel, when, and the step that would have been stable just before."""
    layout, fleet = funnels.layout, loop.fleet
    column, env = np.unravel_index(int(np.argmax(np.where(np.isnan(ratio), np.inf, ratio))), ratio.shape)
    target = int(layout.row_target[layout.column_row[column]])
    curvature = np.zeros((len(layout.target), loop.batch))
    largest_curvature(layout.plan, e, funnel, curvature)
    stable = 2.0 / (layout.eigenvalues[target, 1] * curvature[target, env])
    agent, component, _ = fleet.component_names()[layout.column_source[column]]
    letter = "e" if kind == "state" else "q"
    return (
        f"the explicit step left the funnel: {kind} observer of {agent!r} in "
        f"{fleet.ids[layout.observer[layout.column_pair[column]]]!r}, component {component!r}, environment {env}, "
        f"reached |{letter}| = {ratio[column, env]:.4g} at t = {t[env] + dt:.6g} s with dt = {dt:g} s; just before, a step "
        f"below {min(stable, dt):.2g} s would have been stable: take a shorter one, or integrator='proximal'"
    )
