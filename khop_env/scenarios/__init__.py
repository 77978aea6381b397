"""Scenarios: named problems, one file each, and scenario files on disk."""

from khop_env.scenarios.convoy import convoy
from khop_env.scenarios.corridor import corridor
from khop_env.scenarios.crossing import crossing
from khop_env.scenarios.mixed_fleet import mixed_fleet
from khop_env.scenarios.paper import paper
from khop_env.scenarios.random_geometric import random_geometric
from khop_env.scenarios.scenario import Bounds, LawChoice, Scenario
from khop_env.scenarios.swap import swap

__all__ = [
    "Bounds",
    "LawChoice",
    "Scenario",
    "convoy",
    "corridor",
    "crossing",
    "mixed_fleet",
    "paper",
    "random_geometric",
    "swap",
]
