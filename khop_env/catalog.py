"""The tables of environments and scenarios, which can be read without importing what they name.

The module `khop_env/<name>.py` is an environment's page, in PettingZoo's format; `khop_env/scenarios/<name>.py` has a
scenario's function, of the same name.
"""

from __future__ import annotations

import ast
from pathlib import Path
from typing import Any

ENVIRONMENTS = {  # and the task that each plays
    "consensus_v0": "khop_env.tasks.consensus:Consensus",
    "formation_v0": "khop_env.tasks.formation:Formation",
    "leader_following_v0": "khop_env.tasks.leader_following:LeaderFollowing",
    "navigation_v0": "khop_env.tasks.navigation:Navigation",
}

SCENARIOS = ("paper", "convoy", "mixed_fleet", "random_geometric", "swap", "crossing", "corridor")


def gymnasium_id(environment: str) -> str:
    """E.g. "khop/LeaderFollowing-v0" for "leader_following_v0"."""
    name, _, version = environment.rpartition("_v")
    return f"khop/{''.join(word.capitalize() for word in name.split('_'))}-v{version}"


def describe() -> list[dict[str, Any]]:
    """Name, one line, and parameters with their defaults of every scenario.

    They are read from the text of its function, since importing all scenarios takes longer than listing them. A default
    is a literal or a constant of the same file.
    """
    found = []
    for name in SCENARIOS:
        text = (Path(__file__).parent / "scenarios" / f"{name}.py").read_text(encoding="utf-8")
        body = ast.parse(text).body
        function = next(each for each in body if isinstance(each, ast.FunctionDef) and each.name == name)
        constants = {ast.unparse(each.targets[0]): each.value for each in body if isinstance(each, ast.Assign)}
        defaults = [constants.get(ast.unparse(each), each) for each in function.args.defaults]
        found.append(
            {
                "name": name,
                "description": (ast.get_docstring(function) or "").partition("\n")[0],
                "parameters": {
                    parameter.arg: ast.literal_eval(default)
                    for parameter, default in zip(function.args.args, defaults, strict=True)
                },
            }
        )
    return found
