"""Fingerprint of an environment: its configuration as plain values, to be stored and compared."""

from __future__ import annotations

import dataclasses
from collections.abc import Iterator, Mapping
from typing import Any

import networkx as nx
import numpy as np

from khop_env.env import BatchedEnv
from khop_env.scenarios import Scenario
from khop_env.tasks import Task

# fields of a scenario; its network is in the settings, where an environment's own replaces it
_IRRELEVANT = ("name", "description", "law", "duration", "dt", "order", "network", "estimator", "figure_agent")
_LISTED = 3  # differences


def fingerprint(scenario: Scenario, env: BatchedEnv) -> dict[str, Any]:
    """Everything that the numbers of an environment depend on, as JSON values.

    Args:
        scenario: scenario of the environment.
        env: the environment.
    """
    parts = {field.name: getattr(scenario, field.name) for field in dataclasses.fields(scenario)}
    return {
        "task": {**env.task.signature(env.world), **_parameters(env.task)},
        "scenario": plain({name: value for name, value in parts.items() if name not in _IRRELEVANT}),
        "settings": plain(env.settings),
        "observation": [layout.names for layout in env.layouts[:1]],
    }


def _parameters(task: Task) -> dict[str, Any]:
    """The arguments of a task that is a dataclass."""
    fields: tuple[Any, ...] = dataclasses.fields(task) if dataclasses.is_dataclass(task) else ()
    return {each.name: plain(getattr(task, each.name)) for each in fields if each.init}


def differences(saved: Any, current: Any) -> str:
    """Up to three places where two fingerprints differ, with both values; empty if they are equal."""
    places = list(_differences(saved, current, ""))
    return "; ".join(places[:_LISTED] + [f"and {len(places) - _LISTED} more"] * (len(places) > _LISTED))


def _differences(saved: Any, current: Any, where: str) -> Iterator[str]:
    if isinstance(saved, dict) and isinstance(current, dict):
        for key in {**saved, **current}:
            place = f"{where}.{key}" if where else str(key)
            yield from _differences(saved.get(key, "missing"), current.get(key, "missing"), place)
    elif isinstance(saved, list | tuple) and isinstance(current, list | tuple) and len(saved) == len(current):
        for number, pair in enumerate(zip(saved, current, strict=True)):
            yield from _differences(*pair, f"{where}[{number}]")
    elif saved != current:
        yield f"{where} is {_short(saved)} there and {_short(current)} here"


def _short(value: Any) -> str:
    if isinstance(value, dict | list | tuple) and len(repr(value)) > 60:
        return f"{len(value)} values"
    return repr(value)


def plain(value: Any) -> Any:
    """Convert to mappings, lists and plain values; an object becomes its type and attributes."""
    if value is None or isinstance(value, bool | int | float | str):
        return value
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return {str(key): plain(item) for key, item in value.items()}
    if isinstance(value, list | tuple):
        return [plain(item) for item in value]
    if isinstance(value, nx.Graph):
        return sorted(sorted(edge) for edge in value.edges)
    if callable(value) and hasattr(value, "__qualname__"):
        return f"{value.__module__}.{value.__qualname__}"
    if dataclasses.is_dataclass(value):
        parts = {field.name: getattr(value, field.name) for field in dataclasses.fields(value)}
    else:
        parts = {name: item for name, item in getattr(value, "__dict__", {}).items() if not name.startswith("_")}
    return {"type": type(value).__name__, **{name: plain(item) for name, item in parts.items()}}
