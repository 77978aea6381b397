"""Tuned parameters of the scripted policies, which `khop tune` finds and this package ships."""

from __future__ import annotations

import tomllib
from functools import cache
from pathlib import Path
from typing import Any

from agents.policy import EnvDescription

PATH = Path(__file__).with_name("tuned.toml")


@cache
def _table() -> dict[str, Any]:
    return tomllib.loads(PATH.read_text(encoding="utf-8"))


def tuned_parameters(env: EnvDescription, law: str) -> dict[str, Any]:
    """The shipped parameters of a law, or none.

    Those for the scenario win over those for another member of its family ("random_geometric:..."). There are some for
    observations with estimates, which serve on the truth, too, and some for local ones.

    Args:
        env: environment, scenario and observation mode.
        law: name of the law.
    """
    scenarios, family = _table().get(env.environment, {}), env.scenario.partition(":")[0]
    relatives = [name for name in scenarios if name.partition(":")[0] == family]
    laws = scenarios[env.scenario if env.scenario in scenarios else relatives[0]] if relatives else {}
    return dict(laws.get(law, {}).get("local" if env.observe == "local" else "estimate", {}))
