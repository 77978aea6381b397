"""Plant and observers advance together: the plant's stepper, the simulator, its state, and the view of a law."""

from khop_env.simulation.arena import Arena, Obstacle
from khop_env.simulation.edge_law import EdgeLaw
from khop_env.simulation.initial import InitialSet
from khop_env.simulation.plant import FleetPlant
from khop_env.simulation.simulator import Simulator
from khop_env.simulation.state import SimulatorState
from khop_env.simulation.view import OBSERVE, Law, Observe, View, ViewBuilder

__all__ = [
    "OBSERVE",
    "Arena",
    "EdgeLaw",
    "FleetPlant",
    "InitialSet",
    "Law",
    "Observe",
    "Obstacle",
    "Simulator",
    "SimulatorState",
    "View",
    "ViewBuilder",
]
