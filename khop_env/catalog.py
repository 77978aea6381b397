"""The table of environments: name, and the task in `khop_env.tasks` that it plays. Everything else derives from it.

The module `khop_env/<name>.py` is the environment's page, in PettingZoo's format.
"""

from __future__ import annotations

ENVIRONMENTS = {
    "consensus_v0": "khop_env.tasks.consensus:Consensus",
    "formation_v0": "khop_env.tasks.formation:Formation",
    "leader_following_v0": "khop_env.tasks.leader_following:LeaderFollowing",
    "navigation_v0": "khop_env.tasks.navigation:Navigation",
}


def gymnasium_id(environment: str) -> str:
    """E.g. "khop/LeaderFollowing-v0" for "leader_following_v0"."""
    name, _, version = environment.rpartition("_v")
    return f"khop/{''.join(word.capitalize() for word in name.split('_'))}-v{version}"
