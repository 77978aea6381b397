"""What the commands share: options, how mistakes are told, and how scenarios are found."""

from __future__ import annotations

import enum
import json
import re
from collections.abc import Iterator
from contextlib import contextmanager
from typing import TYPE_CHECKING, Annotated, Any

import typer

from khop_env.terminal import say

if TYPE_CHECKING:
    from khop_env.scenarios import Scenario


INTERRUPTED = 130
"""Exit status after Ctrl-C, as shells have it."""


class ObserveOption(enum.StrEnum):
    """What the law sees of agents out of earshot."""

    ESTIMATE = "estimate"
    ORACLE = "oracle"
    LOCAL = "local"


ScenarioArgument = Annotated[
    str,
    typer.Argument(
        metavar="SCENARIO",
        help="A name (khop list), one with parameters (random_geometric:agents=100,k=2), or the path of a .toml file.",
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]


@contextmanager
def mistakes(name: str | None = None) -> Iterator[None]:
    """Tell of a mistake in what was asked in one paragraph, without a traceback; `name` is the scenario's."""
    try:
        yield
    except MemoryError as error:
        say(f"khop: there isn't enough memory for that: {error}")
        raise typer.Exit(2) from None
    except (ValueError, OSError, ModuleNotFoundError) as error:
        from khop_env.observers import DesignError

        in_file = name is not None and isinstance(error, DesignError)
        say(f"khop: {in_words_of_the_file(str(name), str(error)) if in_file else error}")
        raise typer.Exit(2) from None


def in_words_of_the_file(name: str, message: str) -> str:
    """What is wrong with a design, as one who edits a scenario file knows it; unchanged for scenarios by name."""
    if not name.endswith(".toml"):
        return message
    for value in ("True", "False"):
        message = message.replace(f"input_observer={value}", f"input_observer = {value.lower()}")
    return f"{name}: {message}"


def folder_name(scenario_name: str) -> str:
    """A scenario's name as that of one visible folder."""
    return re.sub(r"[^\w.-]+", "_", scenario_name).lstrip(".") or "scenario"


def load(name: str) -> Scenario:
    """The scenario that the user names, whose law exists.

    Raises:
        ValueError: if there is no such scenario, file or law.
    """
    from agents.laws import LAWS, LawError, make_law
    from khop_env.registry import scenario
    from khop_env.scenarios.files import read_scenario

    found = read_scenario(name, laws=LAWS) if name.endswith(".toml") else scenario(name)
    try:
        make_law(found.law)
    except LawError as error:
        key = "law" if error.parameter is None else f"law.{error.parameter}"
        raise ValueError(f"{name}: {key}: {error}") from error
    return found


def print_json(value: Any) -> None:
    """One JSON object on stdout."""
    typer.echo(json.dumps(value, indent=2, allow_nan=False))
