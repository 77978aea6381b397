"""`khop test`: the contract of the environments, checked on any environment."""

from __future__ import annotations

import contextlib
import dataclasses
import sys
from collections.abc import Callable
from functools import partial
from typing import Annotated, Any

import typer

from khop_env.commands.common import EnvironmentScenario, JsonOption, load, mistakes, print_json
from khop_env.terminal import Progress


def contract(
    environment: Annotated[
        str,
        typer.Argument(
            metavar="ENV",
            help="A name (khop list); a module with parallel_env, as mpe2.simple_spread_v3; or a Python object: an "
            "environment, a function that returns one, or a task: my_module:make_env, my_file.py:MyTask.",
        ),
    ],
    scenario: EnvironmentScenario = None,
    steps: Annotated[int, typer.Option(min=1, help="Steps of an episode, and of comparisons.")] = 300,
    seed: Annotated[int, typer.Option(min=0, help="First seed.")] = 0,
    skip: Annotated[str, typer.Option(help="Checks to leave out: other_seed,unseeded")] = "",
    as_json: JsonOption = False,
) -> None:
    """Check an environment: spaces, seeds, memory, copies, ends of episodes, views, leaks, and libraries' own checks.

    Exits with 1 if a check fails. Any PettingZoo ParallelEnv will do; what doesn't apply to it is skipped, with the
    reason.
    """
    with mistakes(), contextlib.redirect_stdout(sys.stderr):  # what the environment prints isn't part of the report
        from khop_env.testing import check_environment

        made, name = _maker(environment, scenario)
        left_out = [part.strip() for part in skip.split(",") if part.strip()]
        with Progress(f"checking {name}") as progress:
            report = check_environment(made, steps=steps, seed=seed, skip=left_out, progress=progress)
    if as_json:
        print_json({"ok": report.ok, **dataclasses.asdict(report)})
    else:
        typer.echo(str(report))
    if not report.ok:
        raise typer.Exit(1)


def _maker(name: str, scenario: str | None) -> tuple[Callable[[], Any] | Any, str]:
    """An environment, or a function that makes it and was tried once, so that its own mistakes are named.

    Raises:
        ValueError: if there is none of that name, or if making it raises.
    """
    from khop_env.objects import called, load_object
    from khop_env.physics import did_you_mean
    from khop_env.registry import environments, make
    from khop_env.tasks import Task

    if name in environments():
        return partial(make, name, scenario and load(scenario)), name
    try:
        found = load_object(name)
    except ValueError as error:
        if not name.isidentifier():
            raise
        raise ValueError(f"no environment {name!r}; {did_you_mean(name, environments())} And {error}") from error
    if isinstance(found, Task) or (isinstance(found, type) and issubclass(found, Task)):
        return partial(make, found, scenario and load(scenario)), name
    if scenario is not None:
        raise ValueError(f"--scenario is for environments that khop list names and for tasks; {name} has its own")
    found = getattr(found, "parallel_env", found)
    if callable(found):
        called(name, found)
    return found, name
