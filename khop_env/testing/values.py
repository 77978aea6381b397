"""Checks of what one environment returns. Each raises Fault or Skip, or returns; reports print its docstring."""

from __future__ import annotations

import math
import numbers
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Space
from pettingzoo import ParallelEnv

from khop_env.testing.equality import arrays
from khop_env.testing.subject import Fault, Skip, Subject, at_bound, called, play

_EPISODES = 3  # of which the ends are compared


def spaces(subject: Subject) -> None:
    """Observations, states in their spaces; rewards finite."""
    env = subject.any()
    chosen = {"": None, ", all actions at their lower bound": at_bound("low"), ", at their upper": at_bound("high")}
    for text, choose in chosen.items():
        played = play(env, subject.steps, subject.seed, reset_seed=subject.seed, choose=choose)
        for number, seen in enumerate(played):
            if fault := _out_of_space(env, seen):
                raise Fault(f"{called(number, seen)}{text}: {fault}")


def episode_end(subject: Subject) -> None:
    """Only a time limit truncates; whoever is done leaves."""
    env, lengths, by_termination = subject.any(), set(), True
    for seed in range(subject.seed, subject.seed + _EPISODES):
        for number, seen in enumerate(play(env, subject.steps, seed, reset_seed=seed)):
            if number and (fault := _wrong_flags(env, seen)):
                raise Fault(f"{called(number, seen)}: {fault}")
            if not env.agents:
                break
        if env.agents:
            raise Skip(f"an episode takes more than {subject.steps} steps")
        lengths.add(number)
        by_termination &= all(seen["terminations"].values())
    if len(lengths) == 1 and lengths != {1} and by_termination:
        raise Fault(
            f"{_EPISODES} episodes of different seeds and actions all end after {lengths.pop()} steps, by termination "
            "of every agent: a time limit is a truncation, after which learners estimate what would have followed"
        )


def nan_action(subject: Subject) -> None:
    """An action that is nan is refused, or does no harm."""
    env = subject.any()
    spoilt: list[str] = []

    def choose(agent: str, space: Space, mask: Any) -> Any:
        action = space.sample() if mask is None else space.sample(mask)
        if not spoilt and isinstance(space, Box) and space.dtype.kind == "f":
            spoilt.append(agent)
            action[...] = np.nan
        return action

    played = play(env, 3, subject.seed, reset_seed=subject.seed, choose=choose)
    next(played)
    try:
        for seen in played:
            if not spoilt:
                raise Skip("no agent has real-valued actions")
            if fault := _out_of_space(env, seen):
                raise Fault(f"nan in the action of {spoilt[0]!r} isn't refused: {fault}")
    except (Fault, Skip):
        raise
    except Exception:
        return  # refused


def _out_of_space(env: ParallelEnv, seen: dict[str, Any]) -> str | None:
    """The first value of a call's that is outside its space or not finite."""
    for agent in env.agents:
        if agent not in seen["observations"]:
            return f"no observation of {agent!r}"
    for agent, observation in seen["observations"].items():
        if agent in env.possible_agents and (text := _outside(env.observation_space(agent), observation)):
            return f"the observation of {agent!r} {text}"
    for agent, reward in seen.get("rewards", {}).items():
        if not isinstance(reward, numbers.Real | np.generic) or not math.isfinite(float(reward)):
            return f"the reward of {agent!r} must be a finite number; got {reward!r}"
    if isinstance(getattr(env, "state_space", None), Space) and (text := _outside(env.state_space, env.state())):
        return f"state() {text}"
    return None


def _outside(space: Space, value: Any) -> str | None:
    for array in arrays(value):
        if array.dtype.kind == "f" and not np.isfinite(array).all():
            index = tuple(int(i) for i in np.argwhere(~np.isfinite(array))[0])
            return f"isn't finite: entry {_index(index)} is {array[index]}"
    if space.contains(value):
        return None
    if isinstance(space, Box) and isinstance(value, np.ndarray) and value.shape == space.shape:
        beyond = np.argwhere((value < space.low) | (value > space.high))
        if len(beyond):
            index = tuple(int(i) for i in beyond[0])
            return (
                f"is outside its Box: entry {_index(index)} is {value[index]}, its bounds are {space.low[index]} and "
                f"{space.high[index]}"
            )
    got = f"{value.dtype} of shape {value.shape}" if isinstance(value, np.ndarray) else f"{value!r:.100}"
    return f"isn't in {space!r:.200}: got {got}"


def _index(index: tuple[int, ...]) -> str:
    return str(index[0]) if len(index) == 1 else str(index)


def _wrong_flags(env: ParallelEnv, seen: dict[str, Any]) -> str | None:
    for agent in seen["observations"]:
        flags = {key: seen[key].get(agent) for key in ("terminations", "truncations")}
        for key, flag in flags.items():
            if not isinstance(flag, bool | np.bool_):
                return f"{key} must be True or False for {agent!r}; got {flag!r}"
        if all(flags.values()):
            return f"{agent!r} is terminated and truncated at once, so that the two can't be told apart"
        if any(flags.values()) == (agent in env.agents):
            return f"{agent!r} is {'done, but still' if any(flags.values()) else 'not done, but not'} in env.agents"
    return None
