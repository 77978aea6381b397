"""`khop bench`: speed and memory, measured in one run."""

from __future__ import annotations

from pathlib import Path
from typing import Annotated, Any

import typer

from khop_env.commands.common import JsonOption, print_json
from khop_env.terminal import print_table, say


def bench(
    quick: Annotated[bool, typer.Option("--quick", help="Smaller sizes, rougher numbers.")] = False,
    peers: Annotated[
        Path | None, typer.Option(help="Folder with virtual environments mpe2, vmas, jaxmarl to compare with.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Measure speed and memory against explicit, SciPy's and bare loops, and other libraries' environments."""
    from khop_env.bench import benchmark

    result = benchmark(quick=quick, progress=say, peers=peers)
    if as_json:
        print_json(result)
        return
    rows = [
        tuple("" if row.get(key) is None else row[key] for key in ("name", "value", "unit", "target"))
        for row in result["rows"]
    ]
    print_table(("measure", "value", "unit", "target"), [tuple(_short(cell) for cell in row) for row in rows])
    typer.echo(f"machine: {result.get('machine')}")


def _short(cell: Any) -> str:
    return f"{cell:.4g}" if isinstance(cell, float) else str(cell)
