"""THE DECISIONS: observation to action. Feedback laws now; policies, training and evaluation build on them."""

from agents.consensus import TanhConsensus
from agents.laws import LAWS, LawError, make_law

__all__ = ["LAWS", "LawError", "TanhConsensus", "make_law"]
