"""Default parameters of the scripted policies, found by `khop tune`, and the limit of gains in sampled control."""

from __future__ import annotations

import tomllib
from pathlib import Path
from typing import Any

from agents.policy import EnvDescription

PATH = Path(__file__).with_name("tuned.toml")
OVER = "random"
"""Networks over which parameters for networks are found: drawn anew in every episode."""


def _table() -> dict[str, Any]:
    return tomllib.loads(PATH.read_text(encoding="utf-8"))


def tuned_parameters(env: EnvDescription, law: str) -> dict[str, Any]:
    """The shipped parameters of a law; empty if there are none.

    Parameters for the scenario take precedence over those for another member of its family ("random_geometric:...").

    Args:
        env: provides environment, scenario, observation mode, and whether there is a network.
        law: name of the law.
    """
    scenarios, family = _table().get(env.environment, {}), env.scenario.partition(":")[0]
    relatives = [name for name in scenarios if name.partition(":")[0] == family]
    laws = scenarios[env.scenario if env.scenario in scenarios else relatives[0]] if relatives else {}
    sets = laws.get(law, {})
    return dict(sets.get(tuned_for(env), sets.get("estimate", {})))


def tuned_for(env: EnvDescription) -> str:
    """Which set of parameters is for an environment: "local" for neighbours only, "network" for estimates from
    messages, of which all are late, else "estimate", for true states, too.

    Args:
        env: provides observation mode and network.
    """
    if env.observe == "estimate" and env.network is not None:
        return "network"
    return "local" if env.observe == "local" else "estimate"


def sampled_gain(gain: float, averages: bool, env: EnvDescription) -> float:
    """The gain, lowered if the environment's control period is too long for it.

    A velocity of k times the sum over an agent's d edges (the mean: d = 1), held for T, keeps every agent within the
    hull of itself and its neighbours if k d T <= 1 (Gershgorin's circles of I - k T L). A gain tuned above this limit
    keeps its product k T at the control period of tuning.

    Args:
        gain: in 1/s.
        averages: whether the law takes the mean over edges.
        env: provides control period and task edges.
    """
    period = env.control_period
    most = max(sum(slot.task_edge for slot in layout.slots) for layout in env.layouts.values())
    stable = 1.0 / ((1 if averages else max(1, most)) * period)
    return min(gain, max(stable, gain * _table()["control_period"] / period))
