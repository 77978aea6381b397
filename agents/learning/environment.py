"""The environment as a learner sees it: scaled observations, shaped and normalised rewards, staggered episodes."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from stable_baselines3.common.vec_env import VecEnvWrapper, VecNormalize

from agents.learning.config import TrainingConfig
from agents.learning.scaling import MOST, ObservationScaler
from agents.policy import describe
from khop_env.env import BatchedEnv
from khop_env.env.layout import Float32Array
from khop_env.env.sb3 import KHopSB3VecEnv
from khop_env.registry import make_batched


def build(config: TrainingConfig, num_envs: int | None = None) -> BatchedEnv:
    """The environment of a training run, as arrays.

    Args:
        config: names it.
        num_envs: copies; those of the run by default.

    Raises:
        ValueError: for an unknown environment or scenario, or a wrong argument of the environment.
    """
    where = {} if config.scenario is None else {"scenario": config.scenario}
    count = config.num_envs if num_envs is None else num_envs
    of_config: dict[str, Any] = {"observe": config.observe, "bounds": config.bounds}
    return make_batched(config.environment, **where, num_envs=count, **of_config, **config.arguments)


class TrainingVecEnv(VecEnvWrapper):
    """Makes features of observations, and rewards in which rare large errors don't dominate (`Task.robust_reward`).

    Copies begin at different times of their first episodes, so that not all of them end together.

    Args:
        venv: the environment.
        scaler: makes the features.
        huber: error from which rewards grow linearly only, in the unit of the task error.
    """

    def __init__(self, venv: KHopSB3VecEnv, scaler: ObservationScaler, huber: float) -> None:
        super().__init__(venv, Box(-MOST, MOST, (scaler.size,), np.float32))
        self.batched, self.source, self.scaler, self._huber = venv.batched, venv, scaler, huber
        self.before = np.zeros(0, np.float32)  # observations of the last step

    def reset(self) -> Float32Array:
        """Start new, staggered episodes."""
        self.before = np.asarray(self.venv.reset())
        state, horizon = self.batched.get_state(), self.batched.settings.max_cycles
        staggered = np.arange(self.batched.num_envs) * horizon // self.batched.num_envs
        self.batched.set_state(dataclasses.replace(state, cycles=staggered))
        return self.scaler(self.before, None)

    def step_wait(self) -> tuple[Float32Array, Float32Array, np.ndarray, list[dict[str, Any]]]:
        """Advance and shape."""
        observations, reward, done, infos = self.venv.step_wait()
        seen, before = np.asarray(observations), self.before
        by_copy = np.asarray(reward).reshape(self.batched.num_envs, -1)
        softened = self.batched.task.robust_reward(by_copy, self.source.infos, self._huber)
        rows = np.flatnonzero(done)
        if rows.size:
            last = self.scaler(np.stack([infos[row]["terminal_observation"] for row in rows]), before[rows])
            for row, features in zip(rows, last, strict=True):
                infos[row]["terminal_observation"] = features
            before = before.copy()
            before[rows] = seen[rows]  # a new episode: nothing has changed yet
        self.before = seen
        return self.scaler(seen, before), softened.reshape(-1).astype(np.float32), done, infos


def training_environment(config: TrainingConfig) -> VecNormalize:
    """What Stable-Baselines3 is given; only rewards are normalised by running statistics."""
    batched = build(config)
    scaler = ObservationScaler.of(describe(batched), config.rates)
    wrapped = TrainingVecEnv(KHopSB3VecEnv(batched), scaler, config.huber)
    return VecNormalize(wrapped, norm_obs=False, norm_reward=True, gamma=config.gamma)
