"""Scenarios by name, from files, and from a user's own Python."""

from __future__ import annotations

import inspect
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any, get_type_hints

from khop_env import catalog
from khop_env.objects import called, is_object_name, load_object
from khop_env.physics import did_you_mean
from khop_env.scenarios.scenario import Scenario

ScenarioFactory = Callable[..., Scenario]
"""A function that makes a scenario; the parameters of a family are int, float, bool or str, with defaults."""

SCENARIOS: dict[str, ScenarioFactory] = {
    name: load_object(f"khop_env.scenarios.{name}:{name}") for name in catalog.SCENARIOS
}
"""Every scenario of the library."""

_TRUTH = {"true": True, "false": False}


def scenarios() -> tuple[str, ...]:
    """The names of all scenarios."""
    return tuple(SCENARIOS)


def scenario(name_or_path: str | Path, **parameters: Any) -> Scenario:
    """A scenario by name, with parameters, or from a file.

        scenario("paper")
        scenario("random_geometric", agents=100, k=2)
        scenario("random_geometric:agents=100,k=2")
        scenario("mine.toml")
        scenario("my_module:make_scenario")
        scenario("my_file.py:scenario")

    Args:
        name_or_path: a registered name, parameters of a family after a colon, a path that ends in .toml, or the place
            of a `Scenario` or of a function that returns one.
        parameters: parameters of a family; they override those after the colon.

    Raises:
        ScenarioFileError: if the file is wrong.
        ValueError: for an unknown name or parameter; the message suggests the closest one.
    """
    text = str(name_or_path)
    if text.endswith(".toml"):
        from khop_env.scenarios.files import read_scenario

        if parameters:
            raise ValueError(f"a scenario file takes no parameters; got {', '.join(parameters)} with {text}")
        return read_scenario(text)
    name, _, settings = text.partition(":")
    if name not in SCENARIOS and is_object_name(text):
        found = load_object(text)
        made = called(text, found, **parameters) if callable(found) else found
        if not isinstance(made, Scenario):
            raise ValueError(
                f"{text} should be a Scenario or a function that returns one, e.g. my_file.py:my_scenario; got "
                f"{type(made).__name__}"
            )
        return made
    if name not in SCENARIOS:
        if text.lower().endswith(".toml") or Path(text).is_file():
            raise ValueError(f"no scenario {text!r}; if it is a scenario file, rename it: such a name ends in .toml")
        raise ValueError(f"no scenario {name!r}; {did_you_mean(name, SCENARIOS)} (A file's name ends in .toml.)")
    factory = SCENARIOS[name]
    known = inspect.signature(factory).parameters
    parameters = parameters_from_text(settings, get_type_hints(factory), f"scenario {text!r}") | parameters
    for key in parameters:
        if key not in known:
            what = did_you_mean(key, known) if known else "it has none"
            raise ValueError(f"scenario {name!r} has no parameter {key!r}; {what}")
    return factory(**parameters)


def parameters_from_text(text: str, types: Mapping[str, Any], what: str) -> dict[str, Any]:
    """Parameters of "agents=100,k=2": numbers, true or false, or text, as their types ask.

    Args:
        text: the part of a name after its colon; may be empty.
        types: of the known parameters; others stay text, and are refused by name later.
        what: the owner of the parameters, for the error.

    Raises:
        ValueError: for text that isn't parameter=value, or a value of another type.
    """
    found = {}
    for part in filter(None, text.split(",")):
        key, equals, value = (piece.strip() for piece in part.partition("="))
        if not equals:
            raise ValueError(f"{what}: expected parameter=value after the colon; got {part!r}")
        kind = types.get(key, str)
        try:
            found[key] = _TRUTH[value] if kind is bool else kind(value)
        except (ValueError, KeyError):
            expected = "true or false" if kind is bool else f"of type {kind.__name__}"
            raise ValueError(f"{what}: {key} must be {expected}; got {value!r}") from None
    return found
