"""Consensus laws: the paper's bounded one, and a linear one."""

from __future__ import annotations

from dataclasses import dataclass

from agents.lyapunov import ComparisonGain, consensus_gain
from agents.velocity_law import VelocityLaw
from khop_env.observers import FloatArray
from khop_env.scenarios import Scenario
from khop_env.simulation import EdgeLaw, View
from khop_env.simulation.edge_law import LINEAR, TANH, sum_edges


@dataclass
class TanhConsensus(VelocityLaw):
    """v_i = k_c sum over task edges of tanh(p_j - p_i - d_ij), component by component, p_j true or estimated.

    The paper's u_i, with the task's displacements d_ij (zero in consensus). Goal set A: p_j - p_i = d_ij on all task
    edges. In consensus set-ISS with respect to A, for a common Lipschitz drift, a connected task graph and commands
    below the input limits, in the region of `ComparisonGain`, which derives the gain gamma; without drift in the whole
    space for small errors, and then also with displacements. With displacements and a drift A isn't invariant, since
    drifts differ between positions: measured only. Other models (carts, unicycles, vessels) follow the
    commanded velocity with their own controllers: measured only.

    Attributes:
        gain: k_c in 1/s, positive and finite.
    """

    gain: float = 2.0

    def __post_init__(self) -> None:
        self.require_positive("gain")

    def edge_law(self) -> EdgeLaw | None:
        """Its compiled form; a subclass may have another `command`."""
        return EdgeLaw(TANH, self.gain) if type(self) is TanhConsensus else None

    def command(self, view: View, displacement: FloatArray, velocity: FloatArray) -> None:
        """The gain times the sum of tanh of the displacements."""
        sum_edges(self.gain, True, view.edges[:, 0], displacement, velocity, 0, velocity.shape[2])

    def speed_limit(self, most_edges: int) -> float:
        """The gain per edge, since |tanh| < 1."""
        return self.gain * most_edges

    def set_iss_gain(self, scenario: Scenario) -> ComparisonGain | None:
        """The analytical gain on a scenario, or None if none can be derived."""
        return consensus_gain(scenario, self.gain, bounded=True)


@dataclass
class LinearConsensus(VelocityLaw):
    """v_i = k sum over task edges of (p_j - p_i - d_ij), clipped at the input limits.

    The standard protocol (R. Olfati-Saber and R. M. Murray, IEEE Trans. Automatic Control 49(9), 2004) with saturation.
    Goal set A as for `TanhConsensus`. In consensus set-ISS with respect to A, for agents with a common Lipschitz drift
    and a connected task graph, while no input saturates: `ComparisonGain` derives the linear gain and its region;
    without drift also with displacements. Beyond it, with displacements under a drift, with the drift cancelled, and
    for models with other inputs: measured only.

    Attributes:
        gain: k in 1/s, positive and finite.
        cancel_drift: whether agents whose input is a velocity subtract their own f(x).
    """

    gain: float = 2.0
    cancel_drift: bool = False

    def __post_init__(self) -> None:
        self.require_positive("gain")

    def edge_law(self) -> EdgeLaw | None:
        """Its compiled form; a subclass may have another `command`."""
        return EdgeLaw(LINEAR, self.gain, 0.0, self.cancel_drift) if type(self) is LinearConsensus else None

    def command(self, view: View, displacement: FloatArray, velocity: FloatArray) -> None:
        """The gain times the sum of the displacements."""
        sum_edges(self.gain, False, view.edges[:, 0], displacement, velocity, 0, velocity.shape[2])

    def set_iss_gain(self, scenario: Scenario) -> ComparisonGain | None:
        """The analytical gain on a scenario, or None if none can be derived."""
        return None if self.cancel_drift else consensus_gain(scenario, self.gain, bounded=False)
