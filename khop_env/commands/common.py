"""Shared by the commands: options, the handling of mistakes, and how names become scenarios and tasks."""

from __future__ import annotations

import enum
import json
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from khop_env.terminal import say

if TYPE_CHECKING:
    from khop_env.observers import Estimator, Networked
    from khop_env.scenarios import Scenario
    from khop_env.tasks import Task


INTERRUPTED = 130
"""Exit status after Ctrl-C, as shells have it."""


class ObserveOption(enum.StrEnum):
    """Source of the states of agents beyond the neighbours."""

    ESTIMATE = "estimate"
    ORACLE = "oracle"
    LOCAL = "local"


ScenarioArgument = Annotated[
    str,
    typer.Argument(
        metavar="SCENARIO",
        help="A name (khop list), with parameters (random_geometric:agents=100,k=2); a .toml file; or a Python object "
        "or function, my_file.py:my_scenario or my_module:my_scenario.",
    ),
]
EnvironmentArgument = Annotated[
    str,
    typer.Argument(
        metavar="ENV", help="A name (khop list), or a task of your own: my_file.py:MyTask or my_module:MyTask."
    ),
]
EnvironmentScenario = Annotated[
    str | None,
    typer.Option(
        "--scenario",
        help="A scenario's name, .toml file, or Python object (my_file.py:my_scenario); by default the environment's "
        "own.",
    ),
]
EnvOption = Annotated[
    list[str] | None,
    typer.Option(
        "--env",
        metavar="NAME=VALUE",
        help="An argument of the environment: control_period=0.1, reward=team, leaders=drifter_0+drifter_3; "
        "repeatable.",
    ),
]
NetworkOption = Annotated[
    str | None,
    typer.Option(
        "--network",
        help="Messages instead of continuous exchange: ideal, factory, wifi, espnow, ... (khop network), also with "
        "other values, lossy:loss=0.3,burst=5; none: continuous exchange; by default the scenario's own, if any.",
    ),
]
EstimatorOption = Annotated[
    str | None,
    typer.Option(
        "--estimator",
        help="Estimates from messages: ppso (the paper's observers, by rounds), relay (stamped states, passed on), or "
        "a class of your own, my_file.py:MyEstimator.",
    ),
]
ShieldOption = Annotated[
    str | None,
    typer.Option(
        "--shield",
        metavar="MARGIN",
        help="Play every policy in a safety filter that keeps agents apart: certified (by the certified bounds of "
        "estimates), none (by the estimates alone), or by a margin of so many metres; also certified,gamma=0.5.",
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]


@contextmanager
def mistakes(name: str | None = None) -> Iterator[None]:
    """Report a mistake of the user's in one paragraph, without a traceback; `name` is the scenario's."""
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
    """A design's error in the words of a scenario file; unchanged for scenarios by name."""
    if not name.endswith(".toml"):
        return message
    for value in ("True", "False"):
        message = message.replace(f"input_observer={value}", f"input_observer = {value.lower()}")
    return f"{name}: {message}"


def load(name: str) -> Scenario:
    """The scenario that the user names, whose law exists.

    Raises:
        ValueError: if there is no such scenario, file, object or law.
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


def shielded_name(policy: str, shield: str | None) -> str:
    """A policy's name in a safety filter, as `agents.make_policy` reads it; unchanged without `--shield`.

    Raises:
        ValueError: for an unknown margin or option, or a policy that is in a filter already.
    """
    if shield is None:
        return policy
    from agents.policies import FILTER, safety_filter
    from agents.scripted import ZeroPolicy

    margin, comma, options = shield.partition(",")
    try:
        safety_filter(shield, ZeroPolicy())
    except ValueError as error:
        raise ValueError(f"--shield: {str(error).removeprefix('shield ')}") from None
    if policy.partition(":")[0] == FILTER:
        raise ValueError(f"--shield {shield}: {policy!r} is in a safety filter already: leave one of them out")
    return f"{FILTER}:{policy}" if shield == "certified" else f"{FILTER}:margin={margin}{comma}{options}:{policy}"


def networked(scenario: Scenario, network: str | None, estimator: str | None) -> Networked | None:
    """The observers over the network that the options, or else the scenario, choose; None for continuous exchange.

    Raises:
        ValueError: for an unknown network or estimator, or an estimator without a network.
    """
    from khop_env.network import Network
    from khop_env.observers import Networked

    own = None if estimator is None else loaded_estimator(estimator)
    chosen = Network.of(scenario.network if network is None else network)
    if chosen is None:
        if estimator is not None:
            raise ValueError(
                f"--estimator {estimator}: estimates are made from messages, and there is no network; choose one, e.g. "
                "--network wifi"
            )
        return None
    return Networked(chosen, scenario.estimator if own is None else own)


def loaded_estimator(name: str) -> str | Estimator:
    """The estimator that a Python object's name stands for, made if it is a class; any other name as it is.

    Raises:
        ValueError: if there is no such object, or it isn't an estimator.
    """
    from khop_env.objects import called, is_object_name, load_object
    from khop_env.observers import as_estimator

    if not is_object_name(name):
        return name
    found = load_object(name)
    if isinstance(found, type):
        found = called(name, found)
    try:
        return as_estimator(found)
    except ValueError as error:
        raise ValueError(f"{name}: {error}") from None


def with_network(arguments: dict[str, Any], network: str | None, estimator: str | None) -> dict[str, Any]:
    """The arguments of an environment, with a network and an estimator where options choose them.

    Raises:
        ValueError: where --env chooses them, too, or for an estimator that can't be loaded.
    """
    options = {"network": network, "estimator": estimator}
    for name, value in options.items():
        if value is not None and name in arguments:
            raise ValueError(f"--env {name} and --{name}: choose one of them")
    found = arguments | {name: value for name, value in options.items() if value is not None}
    if isinstance(found.get("estimator"), str):
        found["estimator"] = loaded_estimator(found["estimator"])
    return found


def find_environment(name: str) -> Task | type[Task] | None:
    """The task that a name of an environment, or of a Python object, stands for; None where it is no such name.

    Raises:
        ValueError: if a Python object is named that can't be found.
    """
    from khop_env.objects import is_object_name, load_object
    from khop_env.registry import SCENARIOS, environments, find_task
    from khop_env.tasks import Task

    if name in environments():
        return find_task(name)
    if name.partition(":")[0] in SCENARIOS or not is_object_name(name):
        return None
    found = load_object(name)
    return (
        find_task(found) if isinstance(found, Task) or (isinstance(found, type) and issubclass(found, Task)) else None
    )


def require_figure(figure: Path | None) -> None:
    """Refuse a figure that couldn't be written before there is something to lose, and make its folder.

    Raises:
        ValueError: for a file name of another kind.
        OSError: if its folder can't be made.
    """
    if figure is None:
        return
    if figure.suffix.lower() not in (".png", ".pdf", ".svg"):
        raise ValueError(f"--figure {figure}: a figure's name ends in .png, .pdf or .svg")
    figure.parent.mkdir(parents=True, exist_ok=True)


def print_json(value: Any) -> None:
    """One JSON object on stdout."""
    typer.echo(json.dumps(value, indent=2, allow_nan=False))
