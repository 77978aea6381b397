"""The paper's consensus law: bounded, and distributed along the task graph."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from khop_env.compiled import compiled
from khop_env.elementary import tanh
from khop_env.observers import FloatArray, IntArray
from khop_env.physics import velocity_to_input
from khop_env.simulation import View


@dataclass
class TanhConsensus:
    """v_i = k_c sum over task edges of tanh(p_j - p_i), component by component, p_j as agent i hears or estimates it.

    The velocity command v_i goes to integrators as it stands (the paper's u_i) and to other models through
    `physics.velocity_to_input`. Goal set A: all positions equal. Without drift and disturbance V = |e_c|^2 / 2 with
    e_c = Pi x decreases along integrators, since tanh is odd and increasing (the paper's argument); estimation errors
    of bounded size enter bounded. For the other models the set-ISS property is measured, not proven.

    Attributes:
        gain: k_c in 1/s, positive and finite.
    """

    gain: float = 2.0
    _view: View | None = field(default=None, init=False, repr=False, compare=False)

    def __post_init__(self) -> None:
        if not 0.0 < self.gain < math.inf:
            raise ValueError(f"the gain of the tanh law must be positive and finite; got {self.gain!r}")

    def __getstate__(self) -> dict[str, object]:
        return {"gain": self.gain, "_view": None}

    def __call__(self, t: FloatArray, view: View) -> FloatArray:
        """Inputs (B, m), within the input limits."""
        if view is not self._view:
            self._prepare(view)
        fleet, batch = view.fleet, len(view.x)
        sum_tanh(self.gain, view.edges, view.displacement.transpose(1, 2, 0), self._velocity)
        velocity = self._velocity.transpose(2, 0, 1)
        if self._direct:
            return velocity.reshape(batch, -1)
        for group in fleet.groups:
            states = view.x[:, group.state_slice].reshape(batch, group.size, group.model.n)
            inputs = velocity_to_input(group.model, states, velocity[:, group.start : group.stop])
            self._u[:, group.input_slice] = inputs.reshape(batch, -1)
        return self._u

    def _prepare(self, view: View) -> None:
        fleet, batch = view.fleet, len(view.x)
        self._view = view
        self._velocity = np.zeros((len(fleet), fleet.position_dim, batch))
        self._u = np.zeros((batch, fleet.m))
        # integrators whose limits the sum of tanh can't reach take the command as it is
        degree = np.bincount(view.edges[:, 0], minlength=len(fleet)).max(initial=0)
        self._direct = all(
            group.model.type in ("integrator", "drifter") and np.all(group.model.input_limit >= self.gain * degree)
            for group in fleet.groups
        )


@compiled
def sum_tanh(gain: float, edges: IntArray, displacement: FloatArray, out: FloatArray) -> None:
    """Write the law's velocities (N, d, B) from displacements (E, d, B), which are 0 where an agent knows nothing."""
    out[:] = 0.0
    dim, batch = displacement.shape[1], displacement.shape[2]
    if batch > 1:
        for edge in range(edges.shape[0]):
            agent = edges[edge, 0]
            for c in range(dim):
                for env in range(batch):
                    out[agent, c, env] += gain * tanh(displacement[edge, c, env])
        return
    terms = np.empty(displacement.size)  # one environment: vectorise along the edges instead
    flat = displacement.reshape(-1)
    for q in range(flat.size):
        terms[q] = gain * tanh(flat[q])
    for edge in range(edges.shape[0]):
        for c in range(dim):
            out[edges[edge, 0], c, 0] += terms[edge * dim + c]
