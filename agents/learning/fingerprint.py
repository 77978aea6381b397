"""What an environment is made of, in plain values that can be stored and compared."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

import networkx as nx
import numpy as np

from khop_env.env import BatchedEnv
from khop_env.scenarios import Scenario
from khop_env.tasks import Task

_IRRELEVANT = ("name", "description", "law", "duration", "dt", "order")  # of a scenario, to an environment
_SHOWN = 3


def fingerprint(scenario: Scenario, env: BatchedEnv) -> dict[str, Any]:
    """All that the numbers of an environment depend on, as JSON has it.

    Args:
        scenario: what it was made from.
        env: the environment.
    """
    parts = {one.name: getattr(scenario, one.name) for one in dataclasses.fields(scenario)}
    return {
        "task": {**env.task.signature(env.world), **_parameters(env.task)},
        "scenario": plain({name: value for name, value in parts.items() if name not in _IRRELEVANT}),
        "settings": plain(env.settings),
        "observation": [layout.names for layout in env.layouts[:1]],
    }


def _parameters(task: Task) -> dict[str, Any]:
    """The arguments that a task was made with, where it is a dataclass."""
    fields: tuple[Any, ...] = dataclasses.fields(task) if dataclasses.is_dataclass(task) else ()
    return {each.name: plain(getattr(task, each.name)) for each in fields if each.init}


def differences(one: Any, other: Any) -> str:
    """Up to three places where two fingerprints differ, with both values; empty where there are none."""
    found = list(_differences(one, other, ""))
    return "; ".join(found[:_SHOWN] + [f"and {len(found) - _SHOWN} more"] * (len(found) > _SHOWN))


def _differences(one: Any, other: Any, where: str) -> Iterator[str]:
    if isinstance(one, dict) and isinstance(other, dict):
        for key in {**one, **other}:
            place = f"{where}.{key}" if where else str(key)
            yield from _differences(one.get(key, "missing"), other.get(key, "missing"), place)
    elif isinstance(one, list | tuple) and isinstance(other, list | tuple) and len(one) == len(other):
        for number, (mine, its) in enumerate(zip(one, other, strict=True)):
            yield from _differences(mine, its, f"{where}[{number}]")
    elif one != other:
        yield f"{where} is {_short(one)} there and {_short(other)} here"


def _short(value: Any) -> str:
    if isinstance(value, dict | list | tuple) and len(repr(value)) > 60:
        return f"{len(value)} values"
    return repr(value)


def plain(value: Any) -> Any:
    """Mappings, lists and plain values; objects as their type and attributes."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return {str(key): plain(one) for key, one in value.items()}
    if isinstance(value, list | tuple):
        return [plain(one) for one in value]
    if isinstance(value, nx.Graph):
        return sorted(sorted(edge) for edge in value.edges)
    if callable(value) and hasattr(value, "__qualname__"):
        return f"{value.__module__}.{value.__qualname__}"
    if dataclasses.is_dataclass(value):
        parts = {one.name: getattr(value, one.name) for one in dataclasses.fields(value)}
    else:
        parts = {name: one for name, one in getattr(value, "__dict__", {}).items() if not name.startswith("_")}
    return {"type": type(value).__name__, **{name: plain(one) for name, one in parts.items()}}
