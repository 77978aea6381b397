"""A run's files on disk."""

from __future__ import annotations

import json
from collections.abc import Mapping
from pathlib import Path
from typing import Any

from khop_env.results.figures import paper_figure
from khop_env.results.recording import Recording
from khop_env.results.tables import estimates_table, states_table
from khop_env.scenarios import Scenario


def write_run(
    recording: Recording, scenario: Scenario, summary: Mapping[str, Any], folder: str | Path
) -> dict[str, Path]:
    """Write `summary.json`, `states.parquet`, `estimates.parquet` and `figure.png`, over those of an earlier run.

    Args:
        recording: of the run.
        scenario: what was run.
        summary: as `summarize` makes it.
        folder: made if it isn't there.

    Returns:
        The path of each file by its name without the ending.
    """
    folder = Path(folder)
    folder.mkdir(parents=True, exist_ok=True)
    names = ("summary.json", "states.parquet", "estimates.parquet", "figure.png")
    paths = {Path(name).stem: folder / name for name in names}
    paths["summary"].write_text(json.dumps(summary, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    states_table(recording).write_parquet(paths["states"])
    estimates_table(recording).write_parquet(paths["estimates"])
    paper_figure(recording, scenario, paths["figure"])
    return paths
