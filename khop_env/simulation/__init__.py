"""THE CLOCK: world and belief advance together. Everything with dt in it is here."""

from khop_env.simulation.explicit import BatchedRightHandSide, Explicit, FunnelError, RightHandSide
from khop_env.simulation.integrators import Integrator, Proximal, SolveError
from khop_env.simulation.messages import MessagePassing
from khop_env.simulation.simulator import Extremes, InitialSet, Simulator
from khop_env.simulation.state import SimulatorState
from khop_env.simulation.view import OBSERVE, Law, Observe, View

__all__ = [
    "OBSERVE",
    "BatchedRightHandSide",
    "Explicit",
    "Extremes",
    "FunnelError",
    "InitialSet",
    "Integrator",
    "Law",
    "MessagePassing",
    "Observe",
    "Proximal",
    "RightHandSide",
    "Simulator",
    "SimulatorState",
    "SolveError",
    "View",
]
