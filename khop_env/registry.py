"""Scenarios by name."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from pathlib import Path
from typing import Any, get_type_hints

from khop_env.physics import did_you_mean
from khop_env.scenarios.mixed_fleet import mixed_fleet
from khop_env.scenarios.paper import paper
from khop_env.scenarios.random_geometric import random_geometric
from khop_env.scenarios.scenario import Scenario

ScenarioFactory = Callable[..., Scenario]
"""A function that makes a scenario; the parameters of a family are int, float, bool or str, with defaults."""

SCENARIOS: dict[str, ScenarioFactory] = {
    factory.__name__: factory for factory in (paper, mixed_fleet, random_geometric)
}
"""Every scenario of the library: the module `khop_env/scenarios/<name>.py` and its function of the same name."""

_TRUTH = {"true": True, "false": False}


def scenarios() -> tuple[str, ...]:
    """The names of all scenarios."""
    return tuple(SCENARIOS)


def describe() -> list[dict[str, Any]]:
    """Name, one line, and parameters with their defaults of every scenario."""
    return [
        {
            "name": name,
            "description": (inspect.getdoc(factory) or "").partition("\n")[0],
            "parameters": {key: one.default for key, one in inspect.signature(factory).parameters.items()},
        }
        for name, factory in SCENARIOS.items()
    ]


def scenario(name_or_path: str | Path, **parameters: Any) -> Scenario:
    """A scenario by name, with parameters, or from a file.

        scenario("paper")
        scenario("random_geometric", agents=100, k=2)
        scenario("random_geometric:agents=100,k=2")
        scenario("mine.toml")

    Args:
        name_or_path: a registered name, parameters of a family after a colon, or a path that ends in .toml.
        parameters: parameters of a family; they win over those after the colon.

    Raises:
        ScenarioFileError: if the file is wrong.
        ValueError: for an unknown name or parameter, naming the nearest.
    """
    text = str(name_or_path)
    if text.endswith(".toml"):
        from khop_env.scenarios.files import read_scenario

        if parameters:
            raise ValueError(f"a scenario file takes no parameters; got {', '.join(parameters)} with {text}")
        return read_scenario(text)
    name, _, given = text.partition(":")
    if name not in SCENARIOS:
        if text.lower().endswith(".toml") or Path(text).is_file():
            raise ValueError(f"no scenario {text!r}; if it is a scenario file, rename it: such a name ends in .toml")
        raise ValueError(f"no scenario {name!r}; {did_you_mean(name, SCENARIOS)} (A file's name ends in .toml.)")
    factory = SCENARIOS[name]
    known = inspect.signature(factory).parameters
    hints = get_type_hints(factory)
    for part in filter(None, given.split(",")):
        key, equals, value = (piece.strip() for piece in part.partition("="))
        if not equals:
            raise ValueError(f"scenario {text!r}: expected parameter=value after the colon; got {part!r}")
        if key in known:  # others are refused below
            value = _parse(name, key, value, hints.get(key, str))
        parameters.setdefault(key, value)
    for key in parameters:
        if key not in known:
            what = did_you_mean(key, known) if known else "it has none"
            raise ValueError(f"scenario {name!r} has no parameter {key!r}; {what}")
    return factory(**parameters)


def _parse(scenario_name: str, key: str, text: str, kind: type) -> Any:
    try:
        return _TRUTH[text] if kind is bool else kind(text)
    except (ValueError, KeyError):
        expected = "true or false" if kind is bool else f"of type {kind.__name__}"
        raise ValueError(f"scenario {scenario_name!r}: {key} must be {expected}; got {text!r}") from None
