"""Costs as a value of their own, for algorithms of safe reinforcement learning."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

from pettingzoo.utils.wrappers import BaseParallelWrapper

from khop_env.env.layout import Float32Array
from khop_env.env.parallel import KHopEnv

CostStep = tuple[
    dict[str, Float32Array],
    dict[str, float],
    dict[str, float],
    dict[str, bool],
    dict[str, bool],
    dict[str, dict[str, float]],
]


class CostsApart(BaseParallelWrapper[str, Float32Array, Float32Array]):
    """`step` returns six values as in Safety-Gymnasium: after observations and rewards the costs, by agent.

    Args:
        env: whose infos have the key "cost", e.g. `navigation_v0.parallel_env()`.

    Raises:
        ValueError: at the first step, if they don't.
    """

    def __init__(self, env: KHopEnv) -> None:
        super().__init__(env)

    def step(self, actions: Mapping[str, Float32Array]) -> CostStep:
        """One control period; costs by agent stay in the infos, too.

        Args:
            actions: as for the environment.

        Raises:
            ValueError: if an agent's info has no "cost".
        """
        observations, rewards, terminations, truncations, infos = self.env.step(dict(actions))
        return observations, rewards, _costs(infos, str(self.env)), terminations, truncations, infos


def _costs(infos: Mapping[str, Mapping[str, Any]], name: str) -> dict[str, float]:
    for info in infos.values():
        if "cost" not in info:
            raise ValueError(f"{name} has no costs: its infos have the keys {', '.join(info)}, and not 'cost'")
    return {agent: float(info["cost"]) for agent, info in infos.items()}
