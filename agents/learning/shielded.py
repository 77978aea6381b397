"""The Stable-Baselines3 environment in which a safety filter corrects the actions of a learner."""

from __future__ import annotations

from typing import Any

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnvWrapper

from agents.policy import describe
from agents.safety import SafetyFilter
from agents.safety.environments import space_of
from khop_env.env.layout import Float32Array
from khop_env.env.sb3 import KHopSB3VecEnv


class ShieldedSB3VecEnv(VecEnvWrapper):
    """`make_sb3_vec` with a safety filter that corrects actions before the environment gets them, as in `ShieldedEnv`.

        env = ShieldedSB3VecEnv(make_sb3_vec("navigation_v0", num_envs=16, bounds=True), SafetyFilter(None))

    Args:
        venv: the environment, as `filter` needs it.
        filter: without a policy.

    Attributes:
        filter: the safety filter; `intervention` and `infeasible` of its last step are (B,) by agent. The infos of rows
            whose episode has ended have them, too.

    Raises:
        ValueError: if the filter doesn't fit the environment, or an option is out of range.
    """

    def __init__(self, venv: KHopSB3VecEnv, filter: SafetyFilter) -> None:
        self.filter, self.batched = filter, venv.batched
        described = describe(venv.batched)
        self.filter.reset(described, [0])
        self._agents, self._shape = described.agents, (venv.batched.num_envs, len(described.agents), -1)
        first, inside = self._agents[0], self.filter.inside  # uniform: the same for all
        actions = Box(-1.0, 1.0, (inside.action_sizes[first],), np.float32)
        super().__init__(venv, space_of(inside.layouts[first]), actions)
        self._rows: Float32Array = np.zeros((0, 0), np.float32)

    def reset(self) -> Float32Array:
        """Start new episodes; rows without bounds."""
        self._rows = np.asarray(self.venv.reset())
        self.filter.begin(self._shape[0])
        return self._seen(self._rows)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Correct the actions (rows, m), and take them.

        Raises:
            ValueError: for actions of a wrong shape.
        """
        expected = (self.num_envs, *(self.action_space.shape or ()))
        if np.shape(actions) != expected:
            raise ValueError(f"actions must have shape {expected}; got {np.shape(actions)}")
        corrected = self.filter.correct(self._by_agent(self._rows), self._by_agent(np.asarray(actions)))
        self.venv.step_async(np.stack(list(corrected.values()), axis=1).reshape(self.num_envs, -1))

    def step_wait(self) -> tuple[Float32Array, Float32Array, NDArray[np.bool_], list[dict[str, Any]]]:
        """Advance all rows by one control period."""
        observations, rewards, dones, infos = self.venv.step_wait()
        self._rows = np.asarray(observations)
        ended = np.flatnonzero(dones)
        for row in ended.tolist():
            env, agent = row // len(self._agents), self._agents[row % len(self._agents)]
            last = infos[row]["terminal_observation"]
            infos[row] |= {
                "terminal_observation": self.filter.seen({agent: last})[agent],
                "intervention": float(self.filter.intervention[agent][env]),
                "infeasible": bool(self.filter.infeasible[agent][env]),
            }
        self.filter.begin(self._shape[0], ended // len(self._agents))
        return self._seen(self._rows), np.asarray(rewards), np.asarray(dones), infos

    def get_state(self) -> dict[str, NDArray[Any]]:
        """What the filter remembers; the rest is the state of `batched`."""
        return self.filter.get_state()

    def set_state(self, state: dict[str, NDArray[Any]]) -> None:
        """Continue from `get_state()`'s result, after that of `batched` has been restored."""
        self.filter.set_state(state)
        self._rows = self.batched.observations().reshape(self.num_envs, -1)

    def _by_agent(self, rows: NDArray[Any]) -> dict[str, NDArray[Any]]:
        each = rows.reshape(self._shape)
        return {agent: each[:, number] for number, agent in enumerate(self._agents)}

    def _seen(self, rows: Float32Array) -> Float32Array:
        agent = self._agents[0]
        return np.ascontiguousarray(self.filter.seen({agent: rows})[agent])  # uniform: the same columns for all
