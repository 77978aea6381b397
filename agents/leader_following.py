"""Leader following with an unknown leader input."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agents.velocity_law import VelocityLaw
from khop_env.observers import FloatArray
from khop_env.simulation import EdgeLaw, View
from khop_env.simulation.edge_law import SHRUNK_MEAN, sum_edges


@dataclass
class LeaderFollowingLaw(VelocityLaw):
    """v_i = k (s q_i - p_i), with q_i the mean over task edges of the wanted position p_j - d_ij.

    A proportional tracker whose reference is scaled towards the origin by s: followers whose inputs saturate can't
    catch up with a quickly oscillating leader, and are nearer to it on average with a smaller reference. Goal set A:
    q_i = p_i. With s = 1 and the drift cancelled z_i = p_i - q_i of a single integrator obeys
    z' = -k z + k d + w - q', so that |z| <= e^(-k t) |z(0)| + |d| + (|w| + |q'|) / k while its input doesn't saturate:
    set-ISS with respect to A with gamma(s) = s for estimation errors d, and with the leader's speed |q'| as a further
    disturbance input. With s < 1, saturation, or other models: measured only.

    An agent without information on its leader stays near the origin, where the library's initial sets are centred. In
    consensus this prior knowledge is enough to meet without any communication.

    Attributes:
        gain: k in 1/s, positive and finite.
        shrink: s, from 0 to 1.
        cancel_drift: whether agents whose input is a velocity subtract their own f(x).
    """

    gain: float = 3.0
    shrink: float = 1.0
    cancel_drift: bool = True
    averages = True

    def __post_init__(self) -> None:
        self.require_positive("gain")
        if not 0.0 <= self.shrink <= 1.0:
            raise ValueError(f"shrink must be from 0 to 1; got {self.shrink!r}")

    def edge_law(self) -> EdgeLaw | None:
        """Its compiled form; a subclass may have another `command`."""
        return (
            EdgeLaw(SHRUNK_MEAN, self.gain, self.shrink, self.cancel_drift)
            if type(self) is LeaderFollowingLaw
            else None
        )

    def command(self, view: View, displacement: FloatArray, velocity: FloatArray) -> None:
        """The gain times the distance to the scaled reference."""
        agents = len(velocity)
        edges = np.bincount(view.edges[:, 0], minlength=agents)[:, None, None]
        known = view.known_edges()[:, None]
        position = view.fleet.positions(view.x).transpose(1, 2, 0)
        sum_edges(
            1.0, False, view.edges[:, 0], displacement, velocity, 0, velocity.shape[2]
        )  # sum over known edges of q - p
        velocity += known * position
        velocity *= self.shrink / np.maximum(known, 1)
        velocity -= position
        velocity *= self.gain * (edges > 0)
