"""Tasks: one file each, on any scenario. A task of your own derives from `Task`."""

from khop_env.tasks.base import Column, MapCanvas, Outcome, Task, World, directed
from khop_env.tasks.consensus import Consensus
from khop_env.tasks.edges import EdgeArguments, EdgeTask
from khop_env.tasks.formation import Formation
from khop_env.tasks.leader_following import LeaderFollowing
from khop_env.tasks.navigation import Navigation, NavigationArguments

__all__ = [
    "Column",
    "Consensus",
    "EdgeArguments",
    "EdgeTask",
    "Formation",
    "LeaderFollowing",
    "MapCanvas",
    "Navigation",
    "NavigationArguments",
    "Outcome",
    "Task",
    "World",
    "directed",
]
