"""The plant under its law and disturbance, and its one stepper: implements `observers.Plant`.

Arrays are (columns, B) here, batch last and contiguous, because compiled loops run along the batch. Models, laws,
disturbances and users get views (B, ...) of them.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import ArrayLike

from khop_env.elementary import all_finite, weighted_sum
from khop_env.observers import FloatArray, PlantState, SolveError
from khop_env.physics import Fleet, read_only
from khop_env.simulation.view import Law, ViewBuilder

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
    """

    def __init__(
        self,
        fleet: Fleet,
        num_envs: int,
        disturbance: Any | None,
        law: Law | None,
        views: ViewBuilder | None,
        saturated: bool = False,
    ) -> None:
        self.fleet, self.num_envs = fleet, num_envs
        self.disturbance, self.law, self.views = disturbance, law, views
        self._limit = fleet.input_limit[:, None] if saturated else None
        self._rates: tuple[FloatArray, ...] = ()
        self._states = self._inputs = self._effects = self._drawn = np.zeros((0, 0))
        self._t = np.zeros(0)
        self._w = np.zeros((fleet.n, num_envs)).T  # (B, n) in the memory order of the states

    @property
    def rates(self) -> tuple[FloatArray, ...]:
        """(n, B) rates at the stages of the last step, from its beginning on."""
        return self._rates

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
        if len(self._rates) <= number:
            self._rates = (*self._rates, np.zeros((self.fleet.n, self.num_envs)))
        self.rate(state, self._rates[number])
        np.add(before.t, elapsed, out=state.t)
        weighted_sum(before.x, weights, self._rates[: number + 1], state.x)
        require_finite(state.x, self.fleet)

    def actuate(self, state: PlantState) -> None:
        """Write the law's inputs into `state.u` (m, B), without a law leave the held ones there; then g(x, u).

        Raises:
            ValueError: if the law returns inputs of a wrong shape.
        """
        states = self._bind(state)
        if self.law is not None:
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
        self.fleet.input_map(self._t, states, self._inputs, self._effects)

    def effect(self, state: PlantState) -> None:
        """Write g(x, u) of the inputs in force."""
        self.fleet.input_map(self._t, self._bind(state), self._inputs, self._effects)

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
