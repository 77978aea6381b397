"""Write the files of a run."""

from __future__ import annotations

import contextlib
import json
from collections.abc import Callable, Mapping
from pathlib import Path
from typing import Any

from khop_env.results.figures import paper_figure
from khop_env.results.recording import Recording
from khop_env.results.tables import estimates_table, states_table
from khop_env.scenarios import Scenario


class RunFileError(OSError):
    """Some files of a run couldn't be written; the message says which and why.

    Attributes:
        written: paths of the files that were written.
    """

    def __init__(self, message: str, written: dict[str, Path]) -> None:
        super().__init__(message)
        self.written = written


def write_run(
    recording: Recording, scenario: Scenario, summary: Mapping[str, Any], folder: str | Path
) -> dict[str, Path]:
    """Write `states.parquet`, `estimates.parquet`, `summary.json` and `figure.png`, replacing those of an earlier run.

    If a file can't be written, the others still are, and no file of an earlier run stays in its place.

    Args:
        recording: recording of the run.
        scenario: scenario of the run.
        summary: summary from `summarize`.
        folder: folder of the files; created if it doesn't exist.

    Returns:
        The path of each file, by its name without suffix.

    Raises:
        RunFileError: if files couldn't be written, after all others were.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    writers: dict[str, Callable[[Path], object]] = {
        "states.parquet": lambda path: states_table(recording).write_parquet(path),
        "estimates.parquet": lambda path: estimates_table(recording).write_parquet(path),
        "summary.json": lambda path: path.write_text(_json(summary), encoding="utf-8"),
        "figure.png": lambda path: paper_figure(recording, scenario, path),
    }
    written, failures = {}, []
    for name, write in writers.items():
        path = folder / name
        try:
            write(path)
        except Exception as error:  # whatever the error, the other files must not be lost
            failures.append(f"{path} ({str(error) or type(error).__name__})")
            with contextlib.suppress(OSError):
                path.unlink(missing_ok=True)
        else:
            written[path.stem] = path
    if failures:
        raise RunFileError(f"couldn't write {', '.join(failures)}", written)
    return written


def _json(summary: Mapping[str, Any]) -> str:
    return json.dumps(summary, indent=2, allow_nan=False) + "\n"
