"""What the tests of the environments share: which there are, how to play them, and what equal means."""

from __future__ import annotations

import importlib
import itertools
from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from functools import cache, partial
from typing import Any

import gymnasium
import numpy as np

import khop_env
from khop_env.env import BatchedEnv, KHopEnv
from khop_env.registry import scenario
from khop_env.scenarios import Scenario

ENVIRONMENTS = khop_env.environments()
SCENARIOS = ("paper", "convoy", "mixed_fleet", "random_geometric:agents=12")
MODES = ("estimate", "oracle", "local")
EVERY = list(itertools.product(ENVIRONMENTS, SCENARIOS))
CROSS = list(itertools.product(ENVIRONMENTS, SCENARIOS, MODES, (True, False)))  # ..., observe, uniform
IDS = dict(zip(ENVIRONMENTS, ("khop/Consensus-v0", "khop/Formation-v0", "khop/LeaderFollowing-v0"), strict=True))


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


def same(one: Any, other: Any) -> bool:
    """Whether two nests of dicts, sequences, dataclasses, arrays and numbers are equal bit for bit, types included."""
    if type(one) is not type(other):
        return False
    if isinstance(one, np.ndarray):
        if one.dtype == object:
            return one.shape == other.shape and all(map(same, one.ravel().tolist(), other.ravel().tolist()))
        return one.dtype == other.dtype and one.shape == other.shape and one.tobytes() == other.tobytes()
    if isinstance(one, np.random.Generator):
        return same(one.bit_generator.state, other.bit_generator.state)
    if isinstance(one, Mapping):
        return list(one) == list(other) and all(same(one[key], other[key]) for key in one)
    if isinstance(one, list | tuple):
        return len(one) == len(other) and all(map(same, one, other))
    if is_dataclass(one):
        return all(same(getattr(one, f.name), getattr(other, f.name)) for f in fields(one))
    if type(one).__module__.startswith("khop_env"):
        return same(vars(one), vars(other))
    return one == other


def state(env: KHopEnv | BatchedEnv) -> tuple[Any, ...]:
    """Everything that the next steps depend on, in a form that `same` compares."""
    saved = env.get_state()
    return (
        saved.simulator,
        saved.inputs,
        saved.cycles,
        saved.over,
        saved.environment,
        saved.routes,
        saved.generators,
        saved.seeded,
    )


def arrays(value: Any) -> Iterator[np.ndarray]:
    """All arrays in a nest."""
    if isinstance(value, np.ndarray):
        yield value
        if value.dtype == object:
            yield from (inner for one in value for inner in arrays(one))
    elif isinstance(value, Mapping):
        yield from (inner for one in value.values() for inner in arrays(one))
    elif isinstance(value, list | tuple):
        yield from (inner for one in value for inner in arrays(one))
