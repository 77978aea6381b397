"""THE DECISIONS: observation to action. Feedback laws now; policies, training and evaluation build on them."""

from agents.consensus import TanhConsensus
from agents.laws import LAWS, LawError, make_law
from agents.velocity import VELOCITY_CONTROLLERS, velocity_to_input

__all__ = ["LAWS", "VELOCITY_CONTROLLERS", "LawError", "TanhConsensus", "make_law", "velocity_to_input"]
