"""THE ASSEMBLY: one file, one named problem."""

from khop_env.scenarios.paper import paper
from khop_env.scenarios.scenario import Bounds, LawChoice, Scenario

__all__ = ["Bounds", "LawChoice", "Scenario", "paper"]
