"""A policy in its environment, with the interface of a simulator, for recordings."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from agents.learning.learned import PretrainedPolicy
from agents.policies import make_policy
from agents.policy import Policy, describe, policy_seeds
from khop_env.env import KHopEnv, Settings
from khop_env.observers import Extremes
from khop_env.registry import make
from khop_env.scenarios import Scenario
from khop_env.simulation import Observe, Simulator


class PolicyRun:
    """A policy in closed loop with its environment, to be passed to `results.record`; a step is a control period.

    Args:
        env: the environment; it is reset.
        policy: the policy.
        seed: seed of the episode.
    """

    def __init__(self, env: KHopEnv, policy: Policy, seed: int) -> None:
        self.env, self.policy = env, policy
        self.simulator: Simulator = env.batched.simulator
        policy.reset(describe(env), policy_seeds([seed]))
        self._observations, _ = env.reset(seed=seed)
        self._extremes = self.simulator.extremes

    def __getattr__(self, name: str) -> Any:
        return getattr(self.simulator, name)

    @property
    def duration(self) -> float:
        """Length of the episode in s."""
        settings = self.env.batched.settings
        return settings.max_cycles * settings.control_period

    @property
    def extremes(self) -> Extremes:
        """The largest ratios since the reset, over all actions."""
        return self._extremes.copied()

    def task_error(self) -> float:
        """Current task error, mean over the agents."""
        return float(self.env.batched.task_errors().mean())

    def step(self, dt: float) -> None:
        """Advance by one control period; `dt` must be its length."""
        actions: Mapping[str, Any] = self.policy.act(self._observations)
        self._observations, *_ = self.env.step(actions)
        for running, now in zip(self._extremes, self.simulator.extremes, strict=True):
            np.maximum(running, now, out=running)


def policy_run(spec: str, scenario: Scenario, observe: Observe, duration: float, seed: int) -> PolicyRun:
    """A learned policy in the environment that it was trained for.

    Args:
        spec: e.g. "ppo:runs/first"; "ppo:pretrained" if a single policy is shipped for the scenario.
        scenario: scenario of the environment.
        observe: observation mode.
        duration: length of the episode in s, rounded up to whole control periods.
        seed: seed of the episode.

    Raises:
        PolicyFileError: if the policy doesn't fit the environment.
    """
    policy = make_policy(spec)
    about = policy.about_for(scenario.name) if isinstance(policy, PretrainedPolicy) else policy.about  # type: ignore[attr-defined]
    cycles = max(1, math.ceil(duration / Settings.control_period - 1e-9))
    env = make(about["environment"], scenario, observe=observe, bounds=about["bounds"], max_cycles=cycles)
    return PolicyRun(env, policy, seed)
