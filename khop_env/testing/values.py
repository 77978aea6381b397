"""Checks of returned values. A check raises Fault or Skip, or returns; reports print its docstring."""

from __future__ import annotations

import math
import numbers
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Space
from pettingzoo import ParallelEnv

from khop_env.testing.equality import arrays
from khop_env.testing.subject import Fault, Skip, Subject, at_bound, called, play

_EPISODES = 3  # whose ends are compared


def spaces(subject: Subject) -> None:
    """Observations and states are in their spaces, rewards finite."""
    env = subject.any()
    chosen = {"": None, ", all actions at their lower bound": at_bound("low"), ", at their upper": at_bound("high")}
    for text, choose in chosen.items():
        played = play(env, subject.steps, subject.seed, reset_seed=subject.seed, choose=choose)
        for number, step in enumerate(played):
            if fault := _out_of_space(env, step):
                raise Fault(f"{called(number, step)}{text}: {fault}")


def episode_end(subject: Subject) -> None:
    """Only time limits truncate; agents leave when done."""
    env, lengths, by_termination = subject.any(), set(), True
    for seed in range(subject.seed, subject.seed + _EPISODES):
        for number, step in enumerate(play(env, subject.steps, seed, reset_seed=seed)):
            if number and (fault := _wrong_flags(env, step)):
                raise Fault(f"{called(number, step)}: {fault}")
            if not env.agents:
                break
        if env.agents:
            raise Skip(f"an episode takes more than {subject.steps} steps")
        lengths.add(number)
        by_termination &= all(step["terminations"].values())
    if len(lengths) == 1 and lengths != {1} and by_termination:
        raise Fault(
            f"{_EPISODES} episodes of different seeds and actions all end after {lengths.pop()} steps, by termination "
            "of every agent: a time limit is a truncation, at which learners bootstrap the value of the last state"
        )


def nan_action(subject: Subject) -> None:
    """A nan action is refused, or values stay in their spaces."""
    env = subject.any()
    changed: list[str] = []

    def choose(agent: str, space: Space, mask: Any) -> Any:
        action = space.sample() if mask is None else space.sample(mask)
        if not changed and isinstance(space, Box) and space.dtype.kind == "f":
            changed.append(agent)
            action[...] = np.nan
        return action

    played = play(env, 3, subject.seed, reset_seed=subject.seed, choose=choose)
    next(played)
    try:
        for step in played:
            if not changed:
                raise Skip("no agent has real-valued actions")
            if fault := _out_of_space(env, step):
                raise Fault(f"nan in the action of {changed[0]!r} isn't refused: {fault}")
    except (Fault, Skip):
        raise
    except Exception:
        return  # refused


def _out_of_space(env: ParallelEnv, step: dict[str, Any]) -> str | None:
    """Description of the first value of a call that is outside its space or not finite."""
    for agent in env.agents:
        if agent not in step["observations"]:
            return f"no observation of {agent!r}"
    for agent, observation in step["observations"].items():
        if agent in env.possible_agents and (text := _outside(env.observation_space(agent), observation)):
            return f"the observation of {agent!r} {text}"
    for agent, reward in step.get("rewards", {}).items():
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


def _wrong_flags(env: ParallelEnv, step: dict[str, Any]) -> str | None:
    for agent in step["observations"]:
        flags = {key: step[key].get(agent) for key in ("terminations", "truncations")}
        for key, flag in flags.items():
            if not isinstance(flag, bool | np.bool_):
                return f"{key} must be True or False for {agent!r}; got {flag!r}"
        if all(flags.values()):
            return f"{agent!r} is terminated and truncated at once; only one may be True"
        if any(flags.values()) == (agent in env.agents):
            return f"{agent!r} is {'done, but still' if any(flags.values()) else 'not done, but not'} in env.agents"
    return None
