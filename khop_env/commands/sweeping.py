"""`khop train --sweep`: all combinations of settings' values, and a table of what they reached."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import typer

from khop_env.commands.common import INTERRUPTED, mistakes, print_json
from khop_env.commands.folders import folder_name
from khop_env.commands.training import play_command
from khop_env.terminal import Progress, folded, print_table, print_text, say

if TYPE_CHECKING:
    from agents.learning.sweep_file import Sweep
    from agents.learning.sweep_results import RunResult, SweepResult

FAILED = 2


def run(
    file: Path,
    sweep: Sweep,
    out: Path | None,
    *,
    workers: int,
    ray: bool,
    resume: bool,
    callbacks: Sequence[str],
    as_json: bool,
) -> None:
    """Run a sweep, and print its results.

    Args:
        file: the sweep's, for its folder's name.
        sweep: the sweep.
        out: its folder, or None.
        workers: as for `run_sweep`; so are the others.
        ray: see there.
        resume: see there.
        callbacks: see there.
        as_json: whether to print JSON instead of a table.
    """
    from agents.learning.sweep import run_sweep
    from agents.workers import Interrupted

    folder = out or Path("runs") / "sweeps" / folder_name(file.stem)
    interrupted = False
    with mistakes(), Progress(f"{sweep.settings['environment']}, {len(sweep.runs())} trainings") as progress:

        def report(found: RunResult, over: int, total: int) -> None:
            best = found.best
            reached = found.error if best is None else f"return {best.mean_return:.3f}"
            progress.say(f"{over} of {total} {found.folder.name}: {reached or found.status}")

        try:
            result = run_sweep(
                sweep,
                folder,
                workers=workers,
                ray=ray,
                resume=resume,
                callbacks=callbacks,
                on_run=report,
                progress=progress,
            )
        except Interrupted as error:
            result, interrupted = error.partial, True
    _print(result, folder, as_json)
    failed = [each for each in result.runs.values() if each.status == "failed"]
    if failed:
        say(f"khop: {len(failed)} of {len(result.runs)} trainings failed; --resume tries them again:")
        for each in failed:
            say(f"  {each.folder.name}: {each.error}")
    if interrupted:
        finished = sum(each.status == "finished" for each in result.runs.values())
        say(
            f"khop: interrupted; {finished} of {len(result.runs)} trainings are finished, and the same command with "
            "--resume continues"
        )
        raise typer.Exit(INTERRUPTED)
    if failed:
        raise typer.Exit(FAILED)


def _print(result: SweepResult, folder: Path, as_json: bool) -> None:
    from agents.learning.environment import build, described
    from agents.learning.sweep_file import as_text, short

    runs, summary = list(result.runs.values()), result.summary()
    config = runs[0].config
    unit = described(build(config, 1), config).error_unit
    files = {"summary": folder / "summary.csv", "runs": folder / "runs.csv"}
    if as_json:
        found: dict[str, Any] = {
            "environment": config.environment,
            "summary": summary,
            "runs": [each.as_dict() for each in runs],
            "task_error_unit": unit,
            "finished": all(each.status == "finished" for each in runs),
            "folder": str(folder),
        }
        print_json({**found, "files": {name: str(path) for name, path in files.items()}})
        return
    names = [short(name) for name in result.sweep.values]
    rows = [
        (
            *(folded(as_text(row[name])) for name in names),
            f"{row['seeds']} of {len(result.sweep.seeds)}",
            _with_range(row),
            _number(row["last_return"]),
            _number(row["task_error"]),
            "" if row["seconds"] is None else f"{row['seconds']:.0f}",
        )
        for row in summary
    ]
    header = (*names, "seeds", "return", "at the end", f"task error ({unit})", "time (s)")
    title = f"{config.environment}, {len(runs)} trainings, the best settings first"
    print_table(header, rows, title, whole=("seeds", "return"))
    print_text(
        "return: of the best evaluation of each training, mean over seeds with the lowest and the highest; at the end: "
        "of the last evaluation; task error: of the best one; time: of one training. Only finished trainings count."
    )
    for name, path in files.items():
        typer.echo(f"{name}: {path}")
    best = max(runs, key=lambda run: -math.inf if run.best is None else run.best.mean_return)
    if best.best is not None:
        typer.echo(f"play the best: {play_command(best.config, folder / best.folder.name)}")


def _with_range(row: Mapping[str, Any]) -> str:
    if row["mean_return"] is None:
        return ""
    if row["seeds"] == 1:
        return _number(row["mean_return"])
    return f"{_number(row['mean_return'])}\n[{_number(row['lowest_return'])}, {_number(row['highest_return'])}]"


def _number(value: float | None) -> str:
    return "" if value is None else f"{value:.3f}" if abs(value) < 10 else f"{value:.4g}"
