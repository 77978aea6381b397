"""Displacement-based formation control."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agents.velocity_law import VelocityLaw
from khop_env.observers import FloatArray
from khop_env.simulation import EdgeLaw, View
from khop_env.simulation.edge_law import LIMITED_MEAN, sum_edges


@dataclass
class FormationLaw(VelocityLaw):
    """v_i = k times the mean over task edges of (p_j - p_i - d_ij), its norm limited to `speed`.

    Displacement-based formation control (K.-K. Oh, M.-C. Park and H.-S. Ahn, Automatica 53, 2015, section 4). Goal set
    A: p_j - p_i = d_ij on all task edges, wherever the formation is. With z_i = p_i - r_i, d_ij = r_j - r_i and n_i
    edges, single integrators without drift move by z' = -k N^-1 L z: V = sum n_i |z_i - z_bar|^2 / 2 about the
    n-weighted mean decreases at k z' L z, and errors enter linearly, so that the loop is set-ISS with respect to A with
    a linear gain while no speed is limited (for a connected task graph). With limited speeds, a drift that isn't
    cancelled, or other models: measured only.

    Attributes:
        gain: k in 1/s, positive and finite.
        speed: largest commanded speed in m/s, positive and finite.
        cancel_drift: whether agents whose input is a velocity subtract their own f(x).
    """

    gain: float = 2.0
    speed: float = 3.0
    cancel_drift: bool = True
    averages = True

    def __post_init__(self) -> None:
        self.require_positive("gain", "speed")

    def edge_law(self) -> EdgeLaw | None:
        """Its compiled form; a subclass may have another `command`."""
        return EdgeLaw(LIMITED_MEAN, self.gain, self.speed, self.cancel_drift) if type(self) is FormationLaw else None

    def command(self, view: View, displacement: FloatArray, velocity: FloatArray) -> None:
        """The gain times the mean displacement, its norm limited to `speed`."""
        sum_edges(self.gain, False, view.edges[:, 0], displacement, velocity, 0, velocity.shape[2])
        velocity /= np.maximum(view.known_edges(), 1)[:, None]
        length = np.sqrt((velocity * velocity).sum(axis=1, keepdims=True))
        velocity *= self.speed / np.maximum(length, self.speed)
