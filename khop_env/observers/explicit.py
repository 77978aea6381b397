"""The explicit step, with which the paper samples its example: accurate and simple, and stable at about 1e-5 s only.

Why: docs/theory/step.md, "Why explicit steps are short".
"""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple, Protocol

import numpy as np

from khop_env.observers.base import Assumptions, Plant, PlantState
from khop_env.observers.design import Funnels, ObserverDesign
from khop_env.observers.disagreement import correction, disagreement_by, largest_curvature
from khop_env.observers.funnel_observers import FunnelObservers, LinksNow, weights_at
from khop_env.observers.layout import FloatArray
from khop_env.observers.prediction import Prediction
from khop_env.observers.weights import Weights


class FunnelError(RuntimeError):
    """An explicit step left the funnel, outside which the observers aren't defined; take a shorter step."""


class Derivative(NamedTuple):
    """The observers' whole derivative at one instant.

    Attributes:
        estimate: (P, B) of the state estimates.
        input_estimate: (Q, B) of the input estimates.
        e: (P, B) normalised disagreement.
        q: (Q, B) normalised input disagreement.
    """

    estimate: FloatArray
    input_estimate: FloatArray
    e: FloatArray
    q: FloatArray


class RightHandSide(Protocol):
    """The observers' derivative, however it is computed: batched, or agent by agent from messages."""

    def __call__(self, state: PlantState, rho: FloatArray, omega: FloatArray) -> Derivative:
        """The derivative at a state, with funnels (rows, B) of state and input observers."""
        ...


class BatchedRightHandSide:
    """The observers' derivative for all environments at once.

    Args:
        design: the observers.
        num_envs: number of environments B.
    """

    def __init__(self, design: ObserverDesign, num_envs: int) -> None:
        self._layouts = design.states.layout, design.inputs.layout
        self._xi, self._mu = (np.zeros((layout.size, num_envs)) for layout in self._layouts)
        sizes = (*self._layouts, *self._layouts)
        self._derivative = Derivative(*(np.zeros((layout.size, num_envs)) for layout in sizes))
        self._prediction, self._rate = Prediction(design, num_envs), np.zeros_like(self._xi)
        self._links = None if design.schedule is None else LinksNow(design, num_envs)

    def __call__(self, state: PlantState, rho: FloatArray, omega: FloatArray) -> Derivative:
        """See `RightHandSide`."""
        found, memory = self._derivative, state.memory
        weights = weights_at(self._links, state)
        for layout, now, estimate, source, widths, xi, e, rate in (
            (self._layouts[0], weights[0], memory["estimate"], state.x, rho, self._xi, found.e, found.estimate),
            (
                self._layouts[1],
                weights[1],
                memory["input_estimate"],
                state.g,
                omega,
                self._mu,
                found.q,
                found.input_estimate,
            ),
        ):
            disagreement_by(layout, now, estimate, source, xi)
            correction(layout.arrays, xi, widths, e, rate)
        self._prediction.rate(state.t, memory["estimate"], memory["input_estimate"], self._rate)
        found.estimate[...] += self._rate
        return found


class Explicit(FunnelObservers):
    """Forward Euler, with which the paper samples its example; needs steps of about 1e-5 s.

    It follows a schedule of links as long as no change puts a disagreement outside its funnel.

    Args:
        right_hand_side: builds the observers' derivative from a design and a number of environments; batched by
            default.
    """

    name = "explicit"
    order = 1

    def __init__(self, right_hand_side: Callable[[ObserverDesign, int], RightHandSide] = BatchedRightHandSide) -> None:
        self._make = right_hand_side

    def __repr__(self) -> str:
        return f"Explicit({self._make.__name__})" if isinstance(self._make, type) else "Explicit()"

    def prepare(self, design: ObserverDesign, num_envs: int, assumed: Assumptions) -> None:
        """Allocate the buffers for steps of `design` in `num_envs` environments."""
        super().prepare(design, num_envs, assumed)
        self._derivative = self._make(design, num_envs)
        self._xi, self._mu = (np.zeros((funnels.layout.size, num_envs)) for funnels in (design.states, design.inputs))

    def advance(self, plant: Plant, before: PlantState, state: PlantState, dt: float) -> None:
        """Advance `state`, a copy of `before`, by `dt` seconds, moving the `plant` with it.

        Raises:
            FunnelError: if a disagreement leaves its funnel, or was outside before the step, after a jump.
            SolveError: if a state isn't finite.
        """
        rate = self._derivative(state, self.rho.at(state.t), self.omega.at(state.t))
        weights = weights_at(self.links, state)  # of this step: links that change at its end are the next one's
        for kind, funnels, normalized in (("state", self.design.states, rate.e), ("input", self.design.inputs, rate.q)):
            ratio = np.abs(normalized)
            if not np.all(ratio < 1.0):
                column, env = _largest(ratio)
                raise FunnelError(
                    f"the {kind} observer of {self._name(funnels, column, env)} is outside its funnel before the step, "
                    f"at {ratio[column, env]:.4g} times its width: the "
                    f"{'state' if kind == 'state' else 'input (Assumption 2-ii)'} jumped"
                    f"{'' if self.links is None else ', or links went or came'}. No explicit step can go on "
                    "from there; the proximal step can"
                )
        plant.stage(0, np.array([dt]), dt, before, state)
        state.memory["estimate"] += dt * rate.estimate
        state.memory["input_estimate"] += dt * rate.input_estimate
        plant.actuate(state)
        self._require_inside(before.t, state, dt, rate, weights)

    def _require_inside(
        self,
        start: FloatArray,
        state: PlantState,
        dt: float,
        rate: Derivative,
        weights: tuple[Weights | None, Weights | None],
    ) -> None:
        memory, (of_states, of_inputs) = state.memory, weights
        for kind, funnels, now, widths, estimate, source, xi, e_before in (
            ("state", self.design.states, of_states, self.rho, memory["estimate"], state.x, self._xi, rate.e),
            ("input", self.design.inputs, of_inputs, self.omega, memory["input_estimate"], state.g, self._mu, rate.q),
        ):
            disagreement_by(funnels.layout, now, estimate, source, xi)
            ratio = np.abs(xi) / widths.at(state.t)[funnels.layout.column_row]
            if not np.all(ratio < 1.0):
                raise FunnelError(self._left_funnel(kind, funnels, ratio, e_before, dt, start))

    def _name(self, funnels: Funnels, column: int, env: int) -> str:
        """Target, observer, component and environment of a column of estimates, for a message."""
        layout, fleet = funnels.layout, self.design.fleet
        agent, component, _ = fleet.component_names()[layout.column_source[column]]
        observer = fleet.ids[layout.observer[layout.column_pair[column]]]
        return f"{agent!r} in {observer!r}, component {component!r}, environment {env},"

    def _left_funnel(
        self, kind: str, funnels: Funnels, ratio: FloatArray, e: FloatArray, dt: float, start: FloatArray
    ) -> str:
        """Error message: the observer that left its funnel in a step from the times `start`, and a stable step."""
        layout = funnels.layout
        column, env = _largest(ratio)
        target = int(layout.row_target[layout.column_row[column]])
        curvature = np.zeros((len(layout.target), self.num_envs))
        widths = funnels.rho.evaluate(start, np.empty((layout.rows, self.num_envs)))
        largest_curvature(layout.arrays, e, widths, curvature)
        stable = 2.0 / (layout.euler_rate[target] * curvature[target, env])
        return (
            f"the explicit step left the funnel: {kind} observer of {self._name(funnels, column, env)} reached "
            f"|{'e' if kind == 'state' else 'q'}| = {ratio[column, env]:.4g} at t = {start[env] + dt:.6g} s with "
            f"dt = {dt:g} s; just before, a step below {min(stable, dt):.2g} s would have been stable, and at steady "
            f"state it has to be far below {funnels.explicit_step_bound().min():.2g} s: take a shorter one, or the "
            "proximal step"
        )


def _largest(ratio: FloatArray) -> tuple[int, int]:
    """Column and environment of the largest |e|; a NaN counts as the largest."""
    column, env = np.unravel_index(int(np.argmax(np.where(np.isnan(ratio), np.inf, ratio))), ratio.shape)
    return int(column), int(env)
