"""The explicit step, as the paper samples its example: accurate and simple, and stable at about 1e-5 s only."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

import numpy as np

from khop_env.observers import FloatArray, Funnels
from khop_env.observers.disagreement import correction, disagreement, largest_curvature
from khop_env.simulation.closed_loop import ClosedLoop
from khop_env.simulation.integrators import require_finite
from khop_env.simulation.state import SimulatorState


class FunnelError(RuntimeError):
    """An explicit step left the funnel, where the observers are no longer defined; a shorter step would not have."""


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
        self._loop.actuate(state.t, state.x, state.estimate, state.u, state.g)

    def step(self, state: SimulatorState, dt: float) -> None:
        """Advance by `dt` seconds, in place.

        Raises:
            FunnelError: if a disagreement leaves its funnel, or a jump had put it outside; the state is the one before.
            SolveError: if a state isn't finite; likewise.
        """
        loop = self._loop
        loop.rho.evaluate(state.t, self._rho)
        loop.omega.evaluate(state.t, self._omega)
        dy, dghat, e, q = self._derivative(state, self._rho, self._omega)
        for kind, funnels, normalized in (("state", loop.design.states, e), ("input", loop.design.inputs, q)):
            ratio = np.abs(normalized)
            if not np.all(ratio < 1.0):
                column, env = _largest(ratio)
                raise FunnelError(
                    f"the {kind} observer of {_who(loop, funnels, column, env)} is outside its funnel before the step, "
                    f"at {ratio[column, env]:.4g} times its width: the "
                    f"{'state' if kind == 'state' else 'input (Assumption 2-ii)'} jumped. No explicit step can go on "
                    "from there; the proximal integrator can"
                )
        before = state.copy()
        try:
            loop.plant(state.t, state.x, state.g, state.drawn, self._dx)
            state.x += dt * self._dx
            state.estimate += dt * dy
            state.input_estimate += dt * dghat
            state.t += dt
            require_finite(state.x, loop.fleet)
            self.start(state)
            self._require_inside(state, float(dt), before, e, q)
        except BaseException:
            state.assign(before)
            raise

    def _require_inside(
        self, state: SimulatorState, dt: float, before: SimulatorState, e: FloatArray, q: FloatArray
    ) -> None:
        loop = self._loop
        for kind, funnels, bank, funnel, estimate, source, xi, e_before in (
            ("state", loop.design.states, loop.rho, self._rho, state.estimate, state.x, self._xi[0], e),
            ("input", loop.design.inputs, loop.omega, self._omega, state.input_estimate, state.g, self._xi[1], q),
        ):
            bank.evaluate(state.t, funnel)
            disagreement(*funnels.layout.arrays, estimate, source, xi)
            ratio = np.abs(xi) / funnel[funnels.layout.column_row]
            if not np.all(ratio < 1.0):
                raise FunnelError(_left_funnel(loop, kind, funnels, ratio, e_before, dt, before.t))


def _largest(ratio: FloatArray) -> tuple[int, int]:
    """Column and environment of the largest |e|; a NaN counts as that."""
    column, env = np.unravel_index(int(np.argmax(np.where(np.isnan(ratio), np.inf, ratio))), ratio.shape)
    return int(column), int(env)


def _who(loop: ClosedLoop, funnels: Funnels, column: int, env: int) -> str:
    """Target, observer, component and environment of a column of estimates, for a message."""
    layout, fleet = funnels.layout, loop.fleet
    agent, component, _ = fleet.component_names()[layout.column_source[column]]
    observer = fleet.ids[layout.observer[layout.column_pair[column]]]
    return f"{agent!r} in {observer!r}, component {component!r}, environment {env},"


def _left_funnel(
    loop: ClosedLoop, kind: str, funnels: Funnels, ratio: FloatArray, e: FloatArray, dt: float, t: FloatArray
) -> str:
    """Which observer left its funnel in a step from the times `t`, and the step that would have been stable."""
    layout = funnels.layout
    column, env = _largest(ratio)
    target = int(layout.row_target[layout.column_row[column]])
    curvature = np.zeros((len(layout.target), loop.batch))
    largest_curvature(layout.plan, e, funnels.rho.evaluate(t, np.empty((layout.rows, loop.batch))), curvature)
    stable = 2.0 / (layout.eigenvalues[target, 1] * curvature[target, env])
    return (
        f"the explicit step left the funnel: {kind} observer of {_who(loop, funnels, column, env)} reached "
        f"|{'e' if kind == 'state' else 'q'}| = {ratio[column, env]:.4g} at t = {t[env] + dt:.6g} s with dt = {dt:g} s"
        f"; just before, a step below {min(stable, dt):.2g} s would have been stable, and at steady state it has to be "
        f"far below {funnels.explicit_step_bound().min():.2g} s: take a shorter one, or the proximal integrator"
    )
