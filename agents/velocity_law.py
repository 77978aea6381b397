"""Base class of the feedback laws: velocity commands from task edges, converted to each model's inputs."""

from __future__ import annotations

import dataclasses
import math
from typing import Any

import numpy as np

from khop_env.compiled import compiled
from khop_env.elementary import tanh
from khop_env.observers import FloatArray, IntArray
from khop_env.physics import velocity_to_input
from khop_env.simulation import View

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

    def speed_limit(self, most_edges: int) -> float:
        """Bound on each component of a command in m/s, for up to `most_edges` task edges per agent; inf by default."""
        return math.inf

    def __call__(self, t: FloatArray, view: View) -> FloatArray:
        """Inputs (B, m), within the input limits."""
        if view is not self.__dict__.get("_view"):
            self._prepare(view)
        self.command(view, view.displacement.transpose(1, 2, 0), self._velocity)
        velocity, batch = self._velocity.transpose(2, 0, 1), len(view.x)
        if self._direct:
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
        # if commands can't exceed the limits of integrators, they are the inputs
        most = self.speed_limit(int(np.bincount(view.edges[:, 0], minlength=len(fleet)).max(initial=0)))
        self._direct = not self.cancel_drift and all(
            group.model.type in VELOCITY_INPUTS and np.all(group.model.input_limit >= most) for group in fleet.groups
        )


@compiled
def sum_edges(gain: float, bounded: bool, edges: IntArray, displacement: FloatArray, out: FloatArray) -> None:
    """Write gain * sum over edges of displacement (E, d, B), or of its tanh if `bounded`, into `out` (N, d, B)."""
    out[:] = 0.0
    dim, batch = displacement.shape[1], displacement.shape[2]
    if not bounded:
        for edge in range(edges.shape[0]):
            for c in range(dim):
                for env in range(batch):
                    out[edges[edge, 0], c, env] += gain * displacement[edge, c, env]
    elif batch > 1:
        for edge in range(edges.shape[0]):
            agent = edges[edge, 0]
            for c in range(dim):
                for env in range(batch):
                    out[agent, c, env] += gain * tanh(displacement[edge, c, env])
    else:
        terms = np.empty(displacement.size)  # one environment: vectorise along the edges instead
        flat = displacement.reshape(-1)
        for q in range(flat.size):
            terms[q] = gain * tanh(flat[q])
        for edge in range(edges.shape[0]):
            for c in range(dim):
                out[edges[edge, 0], c, 0] += terms[edge * dim + c]
