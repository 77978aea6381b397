"""Base class of the feedback laws: velocity commands from task edges, converted to each model's inputs."""

from __future__ import annotations

import dataclasses
import functools
import math
from typing import Any

import numpy as np

from khop_env.observers import FloatArray
from khop_env.physics import Fleet, velocity_to_input
from khop_env.simulation import EdgeLaw, View

VELOCITY_INPUTS = ("integrator", "drifter")  # types of agents with x' = f(x) + u, all of whose states are positions


class VelocityLaw:
    """A law that commands velocities; a subclass is a dataclass of its parameters and implements `command`.

    For agents whose input is a velocity (x' = f(x) + u) the command is the input, with `cancel_drift` minus the agent's
    own f(x); for other models `physics.velocity_to_input` converts it. Inputs are clipped at their limits. Edges to
    agents without a valid estimate or state have displacement zero and contribute nothing.

    Attributes:
        cancel_drift: whether agents whose input is a velocity subtract their known drift.
        gain: in 1/s, for laws with a gain.
        averages: whether a command is the gain times the mean over an agent's edges, not times their sum.
    """

    cancel_drift: bool = False
    gain: float
    averages = False

    def command(self, view: View, displacement: FloatArray, velocity: FloatArray) -> None:
        """Write commanded velocities (N, d, B), in m/s, from displacements (E, d, B) along `view.edges`, in m."""
        raise NotImplementedError(f"{type(self).__name__} has no command(view, displacement, velocity)")

    def edge_law(self) -> EdgeLaw | None:
        """The compiled form for simulators; None, the default, for laws whose `command` is Python."""
        return None

    def speed_limit(self, most_edges: int) -> float:
        """Bound on each component of a command in m/s, for up to `most_edges` task edges per agent; inf by default."""
        return math.inf

    def __call__(self, t: FloatArray, view: View) -> FloatArray:
        """Inputs (B, m), within the input limits."""
        if view is not self.__dict__.get("_view"):
            self._prepare(view)
        self.command(view, view.displacement.transpose(1, 2, 0), self._velocity)
        velocity, batch = self._velocity.transpose(2, 0, 1), len(view.x)
        if self.is_input(view.fleet, self._most_edges):
            return velocity.reshape(batch, -1)
        for group in view.fleet.groups:
            states = view.x[:, group.state_slice].reshape(batch, group.size, group.model.n)
            wanted = velocity[:, group.start : group.stop]
            if self.cancel_drift and group.model.type in VELOCITY_INPUTS:
                wanted = wanted - group.model.drift(t[:, None], states)
            self._u[:, group.input_slice] = velocity_to_input(group.model, states, wanted).reshape(batch, -1)
        return self._u

    def __getstate__(self) -> dict[str, Any]:
        return {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}  # type: ignore[arg-type]

    def require_positive(self, *names: str) -> None:
        """Check that parameters are positive and finite.

        Raises:
            ValueError: if one isn't; the message names it.
        """
        for name in names:
            value = getattr(self, name)
            if not 0.0 < value < math.inf:
                raise ValueError(f"{name} must be positive and finite; got {value!r}")

    def _prepare(self, view: View) -> None:
        fleet, batch = view.fleet, len(view.x)
        self._view = view
        self._velocity = np.zeros((len(fleet), fleet.position_dim, batch))
        self._u = np.zeros((batch, fleet.m))
        self._most_edges = int(np.bincount(view.edges[:, 0], minlength=len(fleet)).max(initial=0))

    def is_input(self, fleet: Fleet, most_edges: int) -> bool:
        """Whether commands are inputs as they are: of integrators, whose limits they can't exceed."""
        return not self.cancel_drift and self.speed_limit(most_edges) <= _smallest_velocity_limit(fleet)


@functools.lru_cache(maxsize=64)
def _smallest_velocity_limit(fleet: Fleet) -> float:
    """Of agents whose input is a velocity, in m/s; negative where others are in the fleet."""
    if any(group.model.type not in VELOCITY_INPUTS for group in fleet.groups):
        return -1.0
    return float(fleet.input_limit.min())
