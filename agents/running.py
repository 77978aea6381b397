"""A policy in its environment, stepped and recorded as a simulator is."""

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
    """What `results.record` takes: a simulator whose steps are control periods of an environment with a policy.

    Args:
        env: the environment; it is reset.
        policy: who plays.
        seed: of the episode.
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
        """Of the episode, in s."""
        settings = self.env.batched.settings
        return settings.max_cycles * settings.control_period

    @property
    def extremes(self) -> Extremes:
        """The largest ratios since the reset, not only since the last action."""
        return self._extremes.copied()

    def task_error(self) -> float:
        """Mean over the agents of their task error now."""
        return float(self.env.batched.task_errors().mean())

    def step(self, dt: float) -> None:
        """One control period, whose length `dt` has to be."""
        actions: Mapping[str, Any] = self.policy.act(self._observations)
        self._observations, *_ = self.env.step(actions)
        for running, now in zip(self._extremes, self.simulator.extremes, strict=True):
            np.maximum(running, now, out=running)


def policy_run(spec: str, scenario: Scenario, observe: Observe, duration: float, seed: int) -> PolicyRun:
    """A learned policy in the environment that it was trained for.

    Args:
        spec: e.g. "ppo:runs/mine"; "ppo:pretrained" is the only shipped one for the scenario.
        scenario: where it acts.
        observe: observation mode.
        duration: of the episode in s, rounded up to whole control periods.
        seed: of the episode.

    Raises:
        PolicyFileError: for a policy that doesn't fit.
    """
    policy = make_policy(spec)
    about = policy.about_for(scenario.name) if isinstance(policy, PretrainedPolicy) else policy.about  # type: ignore[attr-defined]
    cycles = max(1, math.ceil(duration / Settings.control_period - 1e-9))
    env = make(about["environment"], scenario, observe=observe, bounds=about["bounds"], max_cycles=cycles)
    return PolicyRun(env, policy, seed)
