"""The command line, `khop`.

Tables and one JSON object (`--json`) go to stdout; progress and messages to stderr. Exit status: 0; 1 where a check or
a run finds the observers' guarantee or the environments' contract broken; 2 for a mistake of the user's, or where
something failed on the way; 130 after Ctrl-C, with the results up to then.
"""

from __future__ import annotations

import contextlib
import gc
import inspect
import os
import sys
import warnings
from collections.abc import Callable
from typing import Annotated, Any

import typer
from typer.core import TyperCommand, TyperGroup

from khop_env import __version__
from khop_env.commands.bench import bench
from khop_env.commands.deploy import deploy
from khop_env.commands.evaluate import evaluate
from khop_env.commands.iss import iss
from khop_env.commands.network import network
from khop_env.commands.run import run
from khop_env.commands.scenarios import check, export, list_scenarios
from khop_env.commands.test import contract
from khop_env.commands.train import train
from khop_env.commands.tune import tune
from khop_env.own_agents import AGENTS, claim_agents
from khop_env.terminal import say


class _Flags:
    """Shows flags in --help without a type, as they take no value."""

    def get_params(self, ctx: Any) -> list[Any]:
        found: list[Any] = super().get_params(ctx)  # type: ignore[misc]
        for parameter in found:
            if getattr(parameter, "is_flag", False):
                parameter.metavar = ""
        return found


class _Command(_Flags, TyperCommand):
    """A command."""


class _Group(_Flags, TyperGroup):
    """All commands."""


app = typer.Typer(
    name="khop",
    cls=_Group,
    help="Decentralised k-hop prescribed performance observers: the paper's experiment and yours.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


def _help(command: Callable[..., None]) -> str:
    """A docstring whose paragraphs are a line each, for the terminal to fold."""
    return "\n\n".join(" ".join(part.split()) for part in (inspect.getdoc(command) or "").split("\n\n"))


COMMANDS: dict[str, Callable[..., None]] = {
    "list": list_scenarios,
    "check": check,
    "run": run,
    "deploy": deploy,
    "export": export,
    "evaluate": evaluate,
    "train": train,
    "tune": tune,
    "iss": iss,
    "network": network,
    "test": contract,
    "bench": bench,
}
for name, command in COMMANDS.items():
    app.command(name, cls=_Command, help=_help(command))(command)


_COLLECTED_AFTER = 20_000  # new objects; Python's 700 take a tenth of the time of a short run, most of it for imports


def main() -> None:
    """Run the command line; where stdout can't be written to, say so in one line, and not at all to a closed pipe."""
    warnings.showwarning = _warn
    gc.set_threshold(_COLLECTED_AFTER)
    try:
        if warning := claim_agents():
            say(f"khop: {warning}")
        app()
    except BrokenPipeError:
        _drop_stdout()
        raise SystemExit(2) from None
    except ImportError as error:
        if (error.name or "").partition(".")[0] != AGENTS:
            raise
        say(f"khop: {error}")
        raise SystemExit(2) from None
    except OSError as error:
        _drop_stdout()
        say(f"khop: {error}")
        raise SystemExit(2) from None


_showwarning = warnings.showwarning


def _warn(message: Warning | str, category: type[Warning], *where: Any, **more: Any) -> None:
    """A warning meant for users in one line, others as Python shows them."""
    if category is UserWarning:
        say(f"khop: {message}")
    else:
        _showwarning(message, category, *where, **more)


def _drop_stdout() -> None:
    """Send what is still buffered nowhere, so that the interpreter doesn't stumble over it when it ends."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@app.callback(invoke_without_command=True)
def _root(version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False) -> None:
    if version:
        typer.echo(__version__)
        raise typer.Exit
