"""Results of a sweep: one line for each training, and one for each combination of values, the best first."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, Literal

import numpy as np

from agents.learning.config import TrainingConfig
from agents.learning.curve import Evaluation
from agents.learning.run_folder import write
from agents.learning.sweep_file import Sweep, SweepRun, as_text, short

if TYPE_CHECKING:
    import polars as pl

Status = Literal["not begun", "interrupted", "failed", "finished"]


@dataclass(frozen=True)
class RunResult:
    """Result of one training.

    Attributes:
        values: of the settings in the grid.
        config: all its settings.
        folder: where it is.
        status: "finished", "failed", "interrupted" (--resume continues it), or "not begun".
        curve: its evaluations until then.
        seconds: wall time of training.
        error: why it failed.
    """

    values: Mapping[str, Any]
    config: TrainingConfig
    folder: Path
    status: Status = "not begun"
    curve: tuple[Evaluation, ...] = ()
    seconds: float = 0.0
    error: str | None = None

    @classmethod
    def of(cls, run: SweepRun, folder: Path) -> RunResult:
        """Of a training before it begins, in the folder of the sweep."""
        return cls(run.values, run.config, folder / run.name)

    @classmethod
    def saved(cls, run: SweepRun, folder: Path, checkpoint: Mapping[str, Any]) -> RunResult:
        """What a checkpoint says of a training."""
        curve = tuple(Evaluation(**point) for point in checkpoint["curve"])
        ended = checkpoint.get("ended") and checkpoint["config"]["timesteps"] == run.config.timesteps
        finished = ended or (curve and curve[-1].timesteps >= run.config.timesteps)
        found = dataclasses.replace(cls.of(run, folder), curve=curve, seconds=float(checkpoint["seconds"]))
        return dataclasses.replace(found, status="finished" if finished else "interrupted")

    def failed(self, error: str) -> RunResult:
        """The same training, which failed."""
        return dataclasses.replace(self, status="failed", error=error)

    @property
    def best(self) -> Evaluation | None:
        """The best evaluation, of which best.npz is the policy; None before the first one."""
        return max(self.curve, key=lambda point: point.mean_return, default=None)

    def as_dict(self) -> dict[str, Any]:
        """A line of runs.csv, with values as they are; "folder" is in that of the sweep."""
        best, last = self.best, self.curve[-1] if self.curve else None
        return {
            **{short(name): value for name, value in self.values.items()},
            "seed": self.config.seed,
            "status": self.status,
            "best_return": best and best.mean_return,
            "best_task_error": best and best.final_task_error,
            "best_timesteps": best and best.timesteps,
            "last_return": last and last.mean_return,
            "last_timesteps": last and last.timesteps,
            "seconds": self.seconds,
            "folder": self.folder.name,
            "error": self.error,
        }


@dataclass(frozen=True)
class SweepResult:
    """Results of all trainings of a sweep.

    Attributes:
        sweep: the sweep.
        folder: of the sweep.
        runs: by the name of the folder of each.
    """

    sweep: Sweep
    folder: Path
    runs: Mapping[str, RunResult]

    def summary(self) -> list[dict[str, Any]]:
        """Of each combination of values means over the seeds whose trainings are finished, the best first.

        "seeds" is their number; "mean_return" the mean of their best evaluations, "std_return" its standard deviation
        over seeds (None for one), "lowest_return" and "highest_return" its range; "last_return" of the last
        evaluations; "task_error" of the best ones; "seconds" of the trainings. None where no training is finished.
        """
        rows = []
        for values in {repr(run.values): run.values for run in self.runs.values()}.values():
            runs = [run for run in self.runs.values() if run.values == values and run.status == "finished"]
            best = [point for run in runs if (point := run.best) is not None]
            returns = [point.mean_return for point in best]
            row: dict[str, Any] = {short(name): value for name, value in values.items()}
            row |= {
                "seeds": len(runs),
                "mean_return": _mean(returns),
                "std_return": float(np.std(returns, ddof=1)) if len(returns) > 1 else None,
                "lowest_return": min(returns, default=None),
                "highest_return": max(returns, default=None),
                "last_return": _mean([run.curve[-1].mean_return for run in runs if run.curve]),
                "task_error": _mean([point.final_task_error for point in best]),
                "seconds": _mean([run.seconds for run in runs]),
            }
            rows.append(row)
        return sorted(rows, key=lambda row: -np.inf if row["mean_return"] is None else row["mean_return"], reverse=True)

    def frame(self) -> pl.DataFrame:
        """A row for each training; values of settings as text."""
        return self._frame([run.as_dict() for run in self.runs.values()])

    def write(self) -> None:
        """Write runs.csv and summary.csv into the folder."""
        write(self.folder / "runs.csv", self.frame().write_csv())
        write(self.folder / "summary.csv", self._frame(self.summary()).write_csv())

    def _frame(self, rows: list[dict[str, Any]]) -> pl.DataFrame:
        import polars as pl

        names = [short(name) for name in self.sweep.values]
        texts = [{**row, **{name: as_text(row[name]) for name in names}} for row in rows]
        return pl.DataFrame(texts, infer_schema_length=None)


def _mean(values: list[float]) -> float | None:
    return float(np.mean(values)) if values else None
