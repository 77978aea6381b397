"""The training environment: scaled observations, robust and normalised rewards, staggered episodes."""

from __future__ import annotations

import dataclasses
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from stable_baselines3.common.vec_env import VecEnvWrapper, VecNormalize

from agents.evaluation import chosen_scenario
from agents.learning.config import TrainingConfig
from agents.learning.global_state import StateScaler
from agents.learning.residual import Script
from agents.learning.scaling import MOST, ObservationScaler
from agents.learning.shielded import ShieldedSB3VecEnv
from agents.learning.slots import SlotScaler
from agents.policies import needs, safety_filter
from agents.policy import EnvDescription, describe
from khop_env.env import BatchedEnv
from khop_env.env.layout import Float32Array
from khop_env.env.sb3 import KHopSB3VecEnv
from khop_env.observers import FloatArray
from khop_env.registry import make_batched


def build(config: TrainingConfig, num_envs: int | None = None) -> BatchedEnv:
    """The environment of a training run as a `BatchedEnv`.

    Args:
        config: names environment, scenario and observation mode.
        num_envs: number of environments; by default that of the run.

    Raises:
        ValueError: if environment, scenario or an argument of the environment is unknown or invalid.
    """
    where = {} if config.scenario is None else {"scenario": config.scenario}
    count = config.num_envs if num_envs is None else num_envs
    arguments: dict[str, Any] = {"bounds": config.bounds, **config.arguments}
    if config.shield is not None:  # the learner doesn't get what the filter needs
        needed = needs(safety_filter(str(config.shield), None))
        scenario = chosen_scenario(config.environment, config.scenario)
        arguments = needed.among(config.arguments, scenario) | {"bounds": config.bounds or needed.bounds}
    return make_batched(config.environment, **where, num_envs=count, observe=config.observe, **arguments)


WIDE = 4.0  # actions of a learner whose excess over [-1, 1] counts
WHOLE = 2.0  # actions of a learner that can take a script's full input to the opposite one


class TrainingVecEnv(VecEnvWrapper):
    """Computes features of observations, and rewards not dominated by rare large errors (`Task.robust_reward`).

    Environments begin at different times of their first episodes, so that the ends of episodes are spread.

    With `critic="state"` a row ends with features of the true global state, for the critic alone.

    Args:
        venv: the environment.
        scaler: computes the features.
        config: its `huber`, `intervention` and `saturation` say how rewards are changed, its `critic` what rows hold.
        script: acts beside the learner, whose actions are added to its own; None for none.
    """

    def __init__(
        self,
        venv: KHopSB3VecEnv | ShieldedSB3VecEnv,
        scaler: ObservationScaler | SlotScaler,
        config: TrainingConfig,
        script: Script | None = None,
    ) -> None:
        actions = venv.action_space
        if config.algorithm != "sac" and (config.saturation or script):
            # PPO's actions are clipped to their space: a wider one shows how far they go; SAC's would be stretched
            most = WIDE if config.saturation else WHOLE
            actions = Box(-most, most, actions.shape, np.float32)
        self.batched, self.scaler, self.script, self._config = venv.batched, scaler, script, config
        self.state = StateScaler.of(self.batched) if config.critic == "state" else None
        features = scaler(np.zeros((1, *(venv.observation_space.shape or ())), np.float32), None)
        size = features.shape[1] + (0 if self.state is None else self.state.size)
        super().__init__(venv, Box(-MOST, MOST, (size,), np.float32), actions)
        self.shield = venv if isinstance(venv, ShieldedSB3VecEnv) else None
        self.source: KHopSB3VecEnv = venv.venv if isinstance(venv, ShieldedSB3VecEnv) else venv  # type: ignore[assignment]
        self.before = np.zeros(0, np.float32)  # observations of the previous step
        self._excess: FloatArray | float = 0.0

    def reset(self) -> Float32Array:
        """Start new, staggered episodes; features (num_envs * N, size)."""
        self.before = np.asarray(self.venv.reset())
        if self.script is not None:
            self.script.reset(self._config.seed)
        state, horizon = self.batched.get_state(), self.batched.settings.horizon
        staggered = np.arange(self.batched.num_envs) * horizon // self.batched.num_envs
        self.batched.set_state(dataclasses.replace(state, cycles=staggered))
        return self._with_state(self.scaler(self.before, None))

    def step_async(self, actions: np.ndarray) -> None:
        """Take the actions (rows, m), with the script's added to them."""
        if self.script is not None:
            actions = actions + self.script.act(self.before)
        inside = np.clip(actions, -1.0, 1.0)
        if self._config.saturation:
            self._excess = np.square(actions - inside, dtype=float).sum(axis=1).reshape(self.batched.num_envs, -1)
        self.venv.step_async(inside)

    def step_wait(self) -> tuple[Float32Array, Float32Array, np.ndarray, list[dict[str, Any]]]:
        """Advance by one control period; features, robust rewards, dones and infos, one row per agent."""
        observations, reward, done, infos = self.venv.step_wait()
        current, before, config = np.asarray(observations), self.before, self._config
        by_env = np.asarray(reward).reshape(self.batched.num_envs, -1)
        softened = self.batched.task.robust_reward(by_env, self.source.infos, config.huber)
        period = self.batched.settings.control_period
        if self.shield is not None and config.intervention:
            changed = np.stack([self.shield.filter.intervention[agent] for agent in self.batched.agents], axis=1)
            softened = softened - config.intervention * period * changed
        if config.saturation:
            softened = softened - config.saturation * period * self._excess
        rows = np.flatnonzero(done)
        if rows.size:
            last = self.scaler(np.stack([infos[row]["terminal_observation"] for row in rows]), before[rows])
            if self.state is not None:
                states = np.stack([infos[row]["terminal_state"] for row in rows])
                last = np.hstack([last, self.state(states)])
            for row, features in zip(rows, last, strict=True):
                infos[row]["terminal_observation"] = features
            before = before.copy()
            before[rows] = current[rows]  # a new episode: no change yet
            if self.script is not None:
                self.script.begin(np.flatnonzero(np.reshape(done, (self.batched.num_envs, -1)).any(axis=1)))
        self.before = current
        features = self._with_state(self.scaler(current, before))
        return features, softened.reshape(-1).astype(np.float32), done, infos

    def _with_state(self, features: Float32Array) -> Float32Array:
        """Features of observations, with those of the present global state beside them if the critic sees it."""
        if self.state is None:
            return features
        states = np.repeat(self.state(self.batched.state()), len(self.batched.agents), axis=0)
        return np.hstack([features, states])


def training_environment(config: TrainingConfig) -> VecNormalize:
    """The environment that Stable-Baselines3 trains on; only rewards are normalised by running statistics."""
    batched = build(config)
    inner = KHopSB3VecEnv(batched)
    rows: KHopSB3VecEnv | ShieldedSB3VecEnv = inner
    if config.shield is not None:
        rows = ShieldedSB3VecEnv(inner, safety_filter(str(config.shield), None, config.bounds))
    found = described(batched, config)
    scaler: ObservationScaler | SlotScaler
    if config.policy == "attention":
        scaler = SlotScaler.of(found, config.rates)
    else:
        scaler = ObservationScaler.of(found, config.rates, config.nearest)
    script = None if config.residual is None else Script(config.residual, found, batched.num_envs)
    wrapped = TrainingVecEnv(rows, scaler, config, script)
    return VecNormalize(wrapped, norm_obs=False, norm_reward=True, gamma=config.gamma)


def described(batched: BatchedEnv, config: TrainingConfig) -> EnvDescription:
    """An environment that `build` made, as the learner gets it.

    Raises:
        ValueError: if the safety filter or the script, where there are to be such, doesn't fit it.
    """
    found = describe(batched)
    if config.shield is not None:
        shield = safety_filter(str(config.shield), None, config.bounds)
        shield.reset(found, [0])
        found = shield.inside
    if config.residual is not None:
        Script(config.residual, found, 1)
    return found
