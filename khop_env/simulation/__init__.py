"""Plant and observers advance together: the plant's stepper, the simulator, its state, and the view of a law."""

from khop_env.simulation.arena import Arena, Obstacle
from khop_env.simulation.dense_output import DenseOutput
from khop_env.simulation.edge_law import EdgeLaw
from khop_env.simulation.initial import InitialSet
from khop_env.simulation.plant import FleetPlant
from khop_env.simulation.simulator import Simulator
from khop_env.simulation.state import SimulatorState
from khop_env.simulation.step_control import StepControl, StepCount
from khop_env.simulation.view import OBSERVE, Law, Observe, View, ViewBuilder

__all__ = [
    "OBSERVE",
    "Arena",
    "DenseOutput",
    "EdgeLaw",
    "FleetPlant",
    "InitialSet",
    "Law",
    "Observe",
    "Obstacle",
    "Simulator",
    "SimulatorState",
    "StepControl",
    "StepCount",
    "View",
    "ViewBuilder",
]
