"""Common to the tests of environments: all environments, how to play them, and equality bit for bit."""

from __future__ import annotations

import importlib
import itertools
from collections.abc import Callable
from functools import cache, partial
from typing import Any

import gymnasium
import numpy as np

import khop_env
from khop_env.catalog import gymnasium_id
from khop_env.env import SHARED_INFOS, BatchedEnv, KHopEnv
from khop_env.registry import find_task, scenario
from khop_env.scenarios import Scenario
from khop_env.tasks import EdgeTask
from khop_env.testing import CHECKS, check_environment, difference

ENVIRONMENTS = khop_env.environments()
SCENARIOS = ("paper", "convoy", "mixed_fleet", "random_geometric:agents=12")
MODES = ("estimate", "oracle", "local")
EVERY = list(itertools.product(ENVIRONMENTS, SCENARIOS))
CROSS = list(itertools.product(ENVIRONMENTS, SCENARIOS, MODES, (True, False)))  # ..., observe, uniform
ALONG_EDGES = tuple(name for name in ENVIRONMENTS if issubclass(find_task(name), EdgeTask))
EVERY_ALONG_EDGES = list(itertools.product(ALONG_EDGES, SCENARIOS))
CROSS_ALONG_EDGES = [each for each in CROSS if each[0] in ALONG_EDGES]
IDS = {name: gymnasium_id(name) for name in ENVIRONMENTS}


@cache
def info_keys(environment: str) -> tuple[str, ...]:
    """Keys of an environment's infos, in their order: the task's, then those that all share."""
    env = batched(environment)
    return (*env.task.evaluate(env.world).infos, *SHARED_INFOS)


def ends_within(environment: str, radius: float) -> dict[str, float]:
    """The argument with which episodes terminate when every agent's task error is at most `radius`, in m."""
    return {"success_radius" if environment in ALONG_EDGES else "goal_radius": radius}


@cache
def built(name: str) -> Scenario:
    """A scenario, whose observers are designed once for all tests."""
    return scenario(name)


def parallel(environment: str, name: str = "paper", **arguments: Any) -> KHopEnv:
    """A ParallelEnv."""
    return importlib.import_module(f"khop_env.{environment}").parallel_env(built(name), **arguments)


def aec(environment: str, name: str = "paper", **arguments: Any) -> Any:
    """An AEC environment."""
    return importlib.import_module(f"khop_env.{environment}").env(built(name), **arguments)


def batched(environment: str, name: str = "paper", **arguments: Any) -> BatchedEnv:
    """Copies as arrays."""
    return importlib.import_module(f"khop_env.{environment}").batched_env(built(name), **arguments)


joint = partial(gymnasium.make, disable_env_checker=True)


def random_actions(env: KHopEnv, rng: np.random.Generator, scale: float = 1.0) -> dict[str, np.ndarray]:
    """Uniform in [-scale, scale]."""
    return {
        agent: rng.uniform(-scale, scale, env.action_space(agent).shape).astype(np.float32)
        for agent in env.possible_agents
    }


def play(env: KHopEnv, cycles: int, seed: int = 0, scale: float = 1.0) -> list[Any]:
    """All that `cycles` steps return, with actions drawn from a generator of their own; without seed, an episode that
    ends is followed by the next.
    """
    rng = np.random.default_rng(seed)
    seen: list[Any] = []
    for _ in range(cycles):
        if not env.agents:
            seen.append(env.reset())
        seen.append(env.step(random_actions(env, rng, scale)))
    return seen


def same(first: Any, second: Any) -> bool:
    """True if two nests of dicts, sequences, dataclasses, arrays and numbers are equal bit for bit, types included."""
    return difference(first, second) is None


def require_contract(make: Callable[[], Any], *checks: str, steps: int = 300) -> None:
    """The public checks pass; those named, or all of them, run, and no library warns of anything."""
    report = check_environment(make, steps=steps, skip=set(CHECKS) - set(checks or CHECKS))
    report.raise_if_failed()
    assert [check.name for check in report.checks if check.status == "passed"] == list(checks or CHECKS), str(report)
    assert not any(check.detail for check in report.checks if check.status == "passed"), str(report)


def state(env: KHopEnv | BatchedEnv) -> tuple[Any, ...]:
    """Everything that the next steps depend on, in a form that `same` compares."""
    saved = env.get_state()
    return (
        saved.simulator,
        saved.inputs,
        saved.cycles,
        saved.over,
        saved.environment,
        saved.task,
        saved.generators,
        saved.seeded,
    )
