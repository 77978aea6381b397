"""Checks of what a task returns, so that a mistake in a user's own task is named where it is made."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from khop_env.tasks.base import Outcome, Task


def require_outcome(task: Task, outcome: Any, num_envs: int, agents: int) -> None:
    """Refuse a result of `Task.evaluate` that isn't an `Outcome` of the right shapes.

    Args:
        task: that returned it.
        outcome: the result.
        num_envs: number of environments B.
        agents: number of acting agents N.

    Raises:
        ValueError: naming what is wrong, and the expected shape.
    """
    shape = num_envs, agents
    if _is_usual(outcome, shape):
        return
    who = f"{type(task).__name__}.evaluate()"
    if not isinstance(outcome, Outcome) or not isinstance(outcome.infos, Mapping):
        raise ValueError(f"{who} must return Outcome(reward, terminated, infos), infos by name; got {outcome!r:.200}")
    terminated = outcome.terminated
    if not isinstance(terminated, np.ndarray) or terminated.shape != (num_envs,) or terminated.dtype.kind != "b":
        raise ValueError(
            f"{who}: terminated must be an array of {num_envs} bools, one per environment, e.g. "
            f"np.zeros(world.num_envs, bool); got {_shown(terminated)}"
        )
    if "task_error" not in outcome.infos:
        raise ValueError(
            f"{who}: infos must have 'task_error', the distance of each agent from its goal; got "
            f"{', '.join(map(repr, outcome.infos)) or 'none'}"
        )
    for name, values in {"reward": outcome.reward, **outcome.infos}.items():
        if not isinstance(values, np.ndarray) or values.shape != shape:
            what = name if name == "reward" else f"the info {name}"
            raise ValueError(
                f"{who}: {what} must be an array of shape {shape}, environments by acting agents; got {_shown(values)}"
            )


def _is_usual(outcome: Any, shape: tuple[int, int]) -> bool:
    """Whether the outcome is right and made of plain arrays: a quick answer for every step; False leaves it open."""
    if type(outcome) is not Outcome or type(outcome.infos) is not dict or "task_error" not in outcome.infos:
        return False
    terminated = outcome.terminated
    if type(terminated) is not np.ndarray or terminated.dtype != np.bool_ or terminated.shape != shape[:1]:
        return False
    for values in (outcome.reward, *outcome.infos.values()):
        if type(values) is not np.ndarray or values.shape != shape:
            return False
    return True


def require_columns(task: Task, rows: int, names: Mapping[str, Sequence[str]]) -> None:
    """Refuse columns of a task that nobody writes, or that have the name of another one.

    Args:
        task: bound.
        rows: number of live rows in all its columns.
        names: of the columns of each agent's observation, by id.

    Raises:
        ValueError: naming the column.
    """
    if rows and type(task).observe is Task.observe:
        raise ValueError(
            f"task {task.name!r} has columns with a row, and no observe(world, out) that writes these rows; write it, "
            "or leave row out for constants"
        )
    checked: set[int] = set()  # by identity: thousands of agents share their names
    for agent, its_names in names.items():
        if id(its_names) in checked:
            continue
        checked.add(id(its_names))
        if len(set(its_names)) < len(its_names):
            twice = next(name for name in its_names if its_names.count(name) > 1)
            raise ValueError(f"task {task.name!r}: the observation of {agent!r} has two columns {twice!r}; rename one")


def _shown(value: object) -> str:
    return f"shape {value.shape} of {value.dtype}" if isinstance(value, np.ndarray) else repr(value)[:100]
