"""Parameters of the scripted policies where the user gives none: those that `khop tune` found, and their limits."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from agents.policy import EnvDescription

PATH = Path(__file__).with_name("tuned.toml")


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


def sampled_gain(gain: float, averages: bool, env: EnvDescription) -> float:
    """The largest gain up to `gain` that an environment's control period allows.

    A velocity k times the sum over an agent's d edges (the mean: d = 1), held for T, keeps every agent within the hull
    of its neighbours as long as k d T <= 1 (Gershgorin's circles of I - k T L). A gain that was tuned nearer to the
    limit of stability than that keeps its distance: k T stays what it was at the period of tuning.

    Args:
        gain: in 1/s.
        averages: whether the law takes the mean over edges.
        env: where it acts.
    """
    period = env.control_period
    most = max(sum(slot.task_edge for slot in layout.slots) for layout in env.layouts.values())
    stable = 1.0 / ((1 if averages else max(1, most)) * period)
    return min(gain, max(stable, gain * _table()["control_period"] / period))
