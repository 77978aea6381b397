"""The safety filter's speed: time of an agent's move, and steps of an environment with it."""

from __future__ import annotations

import copy
import time
from types import SimpleNamespace
from typing import cast

import numpy as np

from agents import SafetyFilter, describe, make_policy
from agents.policy import Observations, Policy, by_agent, policy_seeds
from benchmarks.environments import BATCH, TURNS
from benchmarks.report import Report
from khop_env.env import BatchedEnv
from khop_env.env.layout import Float32Array
from khop_env.registry import make_batched


def speed_rows(report: Report, quick: bool) -> None:
    """Microseconds per agent and move without the policy inside, apart and in a crowd; steps with filter and policy.

    Args:
        report: takes the rows.
        quick: as `benchmark`.
    """
    for batch, aim in ((1, 20.0), (64 if quick else BATCH, 2.0)):
        env = make_batched("navigation_v0", "swap", num_envs=batch, network="wifi", bounds=True)
        policy = SafetyFilter(make_policy("keep_right"))
        policy.reset(describe(env), policy_seeds(range(batch)))
        observations, _ = env.reset(0)
        for place, cycles in (("apart", 10), ("crowd", 50)):  # messages have to arrive first, then agents to meet
            for _ in range(cycles):
                observations = _step(env, policy, observations)
            spent = _microseconds(policy, by_agent(env, observations), quick)
            report.add(f"filter_{place}_{'single' if batch == 1 else 'batch'}", spent, "us per agent", most=aim)
    rates, seconds = [], 0.05 if quick else 1.0
    for _ in range(1 if quick else TURNS):
        start, steps = time.perf_counter(), 0
        while time.perf_counter() - start < seconds:
            observations = _step(env, policy, observations)
            steps += 1
        rates.append(steps / (time.perf_counter() - start))
    report.add("environment_with_filter", batch * len(env.agents) * max(rates), "agent-steps/s", least=300_000.0)


def _step(env: BatchedEnv, policy: Policy, observations: Float32Array) -> Float32Array:
    actions = policy.act(by_agent(env, observations))
    observations, _, terminated, truncated, _ = env.step(np.concatenate(list(actions.values()), axis=1))
    if (over := terminated | truncated).any():
        observations, _ = env.reset(env_ids=np.flatnonzero(over))
    return observations


def _microseconds(policy: SafetyFilter, observations: Observations, quick: bool) -> float:
    """Per agent and move, the best of some, less the policy inside; anchors stay where they are."""
    kept = copy.deepcopy(policy)
    wanted = kept.policy.act(observations)
    kept.policy = cast(Policy, SimpleNamespace(act=lambda observations: wanted))
    agents = sum(values.shape[0] for values in observations.values())
    best = np.inf
    for _ in range(3 if quick else 50):
        repeated = copy.deepcopy(kept)
        begin = time.perf_counter()
        repeated.act(observations)
        best = min(best, time.perf_counter() - begin)
    return best / agents * 1e6
