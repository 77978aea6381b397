"""`khop bench`: speed and memory, measured in one run."""

from __future__ import annotations

import sys
from collections.abc import Callable
from pathlib import Path
from typing import Annotated, Any

import typer

from khop_env.commands.common import INTERRUPTED, JsonOption, mistakes, print_json
from khop_env.terminal import print_table, print_text, say

REPOSITORY = Path(__file__).resolve().parents[2]


def bench(
    quick: Annotated[bool, typer.Option("--quick", help="Smaller sizes, rougher numbers.")] = False,
    peers: Annotated[
        Path | None,
        typer.Option(help="Folder of virtual environments (mpe2, vmas, jaxmarl) with libraries to compare with."),
    ] = None,
    only: Annotated[
        str | None,
        typer.Option(
            help="Parts, e.g. explicit,solve; by default all: explicit, scipy, solve, growth, environments, network, "
            "violations, filter, collisions, training."
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Measure speed and memory against explicit, SciPy's and bare loops, and other libraries' environments.

    It runs in a clone of the repository. Exits with 2 if a part failed, and with 130 after Ctrl-C; the other rows are
    printed.
    """
    with mistakes():
        parts = None if only is None else [part.strip() for part in only.split(",")]
        result = _benchmark()(quick=quick, progress=say, peers=peers, only=parts)
    if as_json:
        print_json(result)
    else:
        rows = [(row["name"], _value(row), row["unit"], _target(row)) for row in result["rows"]]
        print_table(("measure", "value", "unit", "target"), rows)
        for text in dict.fromkeys(row["explanation"] for row in result["rows"] if row["explanation"]):
            names = ", ".join(row["name"] for row in result["rows"] if row["explanation"] == text)
            print_text(f"{names}: {text}")
        for reason in dict.fromkeys(row["skipped"] for row in result["rows"] if row["skipped"] is not None):
            names = ", ".join(row["name"] for row in result["rows"] if row["skipped"] == reason)
            print_text(f"skipped: {names}: {reason}")
        print_text("machine: " + ", ".join(f"{name} {value}" for name, value in result["machine"].items()))
    if result["interrupted"]:
        say("khop: interrupted; the rows that are missing weren't measured")
        raise typer.Exit(INTERRUPTED)
    if result["failed"]:
        raise typer.Exit(2)


def _benchmark() -> Callable[..., dict[str, Any]]:
    if not (REPOSITORY / "benchmarks" / "yardsticks.py").exists():
        raise ModuleNotFoundError(
            "benchmarks aren't installed, they are in khop_env's repository: run `make bench` in a clone of it"
        )
    if str(REPOSITORY) not in sys.path:
        sys.path.insert(0, str(REPOSITORY))
    from benchmarks.benchmark import benchmark

    return benchmark


def _target(row: dict[str, Any]) -> str:
    return f"{row['target']}{'' if row['met'] is not False else ': MISSED'}"


def _value(row: dict[str, Any]) -> str:
    return f"{row['value']:.4g}" if row["skipped"] is None else "skipped"
