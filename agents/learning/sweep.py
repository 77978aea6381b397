"""Run the trainings of a sweep, in this process, in several, or on a Ray cluster."""

from __future__ import annotations

import contextlib
import dataclasses
import json
from collections.abc import Callable, Generator, Sequence
from pathlib import Path
from typing import Any

from agents.evaluation import chosen_scenario
from agents.learning.callbacks import named_callbacks
from agents.learning.config import TrainingConfig
from agents.learning.curve import Evaluation, evaluation_environment
from agents.learning.environment import build, described
from agents.learning.networks import require_installed
from agents.learning.residual import Script
from agents.learning.run_folder import (
    CHECKPOINT,
    alone_in,
    environment_fingerprint,
    load_checkpoint,
    require_same_environment,
)
from agents.learning.sweep_file import Sweep, SweepRun, in_words
from agents.learning.sweep_results import RunResult, Status, SweepResult
from agents.learning.training import train
from agents.workers import Interrupted, WorkerError, run_in_processes
from khop_env.objects import described as error_in_words
from khop_env.objects import load_object

_ENVIRONMENT = ("scenario", "observe", "bounds", "shield", "residual", "evaluate_network", "arguments")

OnRun = Callable[[RunResult, int, int], None]
"""Called with the result of a training that is over, how many are, and how many there are."""


def run_sweep(
    sweep: Sweep,
    out: str | Path,
    *,
    workers: int = 1,
    ray: bool = False,
    resume: bool = False,
    callbacks: Sequence[str] = (),
    on_run: OnRun | None = None,
    progress: Callable[[float], None] | None = None,
) -> SweepResult:
    """Run the trainings of a sweep. Those that fail don't stop the others.

    Each has a folder of its own, as `train` makes it, in that of the sweep, which also gets runs.csv, a line for each
    training, and summary.csv, one for each combination of values; both are up to date after every training.

    Args:
        sweep: the sweep.
        out: its folder. On a cluster all machines have to share it.
        workers: trainings at once, each in a process; results don't depend on it.
        ray: whether they run on a Ray cluster instead.
        resume: whether to go on in that folder: trainings that are finished aren't repeated, others continue from
            their checkpoints, or begin. Finished ones continue, too, if `timesteps` is larger than it was.
        callbacks: names as `named_callbacks` takes them; each training makes its own.
        on_run: called after each training.
        progress: called with the completed fraction; within trainings only in this process.

    Raises:
        ValueError: if settings don't go together, or a folder holds a run with other settings or in another
            environment; before anything is trained.
        FileExistsError: if the folder holds runs and `resume` isn't set, or a sweep is running there.
        FileNotFoundError: if `resume` is set, and there is no run.
        ModuleNotFoundError: if `ray` is set and Ray isn't installed, or a training needs what isn't.
        Interrupted: on Ctrl-C; its `partial` is the result until then.
    """
    folder, runs = Path(out).resolve(), sweep.runs()
    for run in runs:
        require_installed(run.config)
    fingerprints = _checked(runs)
    for name in callbacks:
        load_object(name)  # each training makes its own
    begun = [run for run in runs if (folder / run.name / CHECKPOINT).exists()]
    if begun and not resume:
        raise FileExistsError(
            f"{folder} holds {len(begun)} of these trainings; continue them with --resume, or choose another folder"
        )
    if resume and not begun:
        raise FileNotFoundError(f"nothing to resume: {folder} holds none of these trainings")
    with alone_in(folder):
        results = {run.name: RunResult.of(run, folder) for run in runs}
        for run in begun:
            saved = load_checkpoint(folder / run.name, _loaded(run.config))
            require_same_environment(folder / run.name, saved, fingerprints[_environment(run)])
            results[run.name] = RunResult.saved(run, folder, saved)
        tasks = [run for run in runs if results[run.name].status != "finished"]
        trainer, over = _Trainer(folder, tuple(callbacks)), len(runs) - len(tasks)
        if progress is not None:
            trainer.progress = lambda part: progress((over + part) / len(runs))
        result = SweepResult(sweep, folder, results)
        result.write()
        try:
            with contextlib.closing(_results(trainer, tasks, workers, ray)) as found:
                for run, each in found:
                    results[run.name], over = each, over + 1
                    result.write()
                    if on_run is not None:
                        on_run(each, over, len(runs))
                    if progress is not None:
                        progress(over / len(runs))
                    if each.status == "interrupted":
                        raise KeyboardInterrupt
        except KeyboardInterrupt:
            for run in tasks:  # those in other processes, or after a second Ctrl-C
                if results[run.name].status == "not begun" and (folder / run.name / CHECKPOINT).exists():
                    saved = load_checkpoint(folder / run.name, _loaded(run.config))
                    results[run.name] = RunResult.saved(run, folder, saved)
            result.write()
            raise Interrupted(result) from None
    return result


class _Trainer:
    """Runs one training, from its checkpoint if there is one; sent to each process."""

    def __init__(self, folder: Path, callbacks: Sequence[str]) -> None:
        self.folder, self._callbacks = folder, callbacks
        self.progress: Callable[[float], None] | None = None

    def __call__(self, run: SweepRun) -> RunResult:
        folder, result = self.folder / run.name, RunResult.of(run, self.folder)
        try:
            resume, callbacks = (folder / CHECKPOINT).exists(), named_callbacks(self._callbacks)
            training = train(run.config, folder, resume=resume, callbacks=callbacks, on_progress=self._report)
        except Exception as error:
            return result.failed(error_in_words(error))
        status: Status = "finished" if training.finished else "interrupted"
        return dataclasses.replace(result, status=status, curve=tuple(training.curve), seconds=training.seconds)

    def _report(self, fraction: float, _: Evaluation | None) -> None:
        if self.progress is not None:
            self.progress(fraction)

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "progress": None}


def _results(
    trainer: _Trainer, runs: Sequence[SweepRun], workers: int, ray: bool
) -> Generator[tuple[SweepRun, RunResult], None, None]:
    """Yield trainings and their results in order of completion."""
    if workers == 1 and not ray:
        for run in runs:
            yield run, trainer(run)
        return
    waiting = list(runs)
    while waiting:
        tasks = list(waiting)
        try:
            with contextlib.closing(_started(trainer, tasks, workers, ray)) as found:
                for number, result in found:
                    waiting.remove(tasks[number])
                    yield tasks[number], result
        except WorkerError as error:  # it killed the other workers: their trainings go on from their checkpoints
            if error.task is None:
                raise
            waiting.remove(lost := tasks[error.task])
            yield lost, RunResult.of(lost, trainer.folder).failed(str(error))


def _started(
    trainer: _Trainer, runs: Sequence[SweepRun], workers: int, ray: bool
) -> Generator[tuple[int, RunResult], None, None]:
    if ray:
        from agents.cluster import run_on_ray

        yield from run_on_ray(trainer, runs)
    else:
        yield from run_in_processes(trainer, runs, workers)


def _checked(runs: Sequence[SweepRun]) -> dict[str, dict[str, Any]]:
    """Fingerprints of the environments of all combinations, which have to exist.

    Raises:
        ValueError: if one can't be made; the message says for which values.
    """
    found: dict[str, dict[str, Any]] = {}
    for run in runs:
        if (key := _environment(run)) in found:
            continue
        config = _loaded(run.config)
        try:
            batched = build(config, 1)
            description = described(batched, config)
            script = None if config.residual is None else Script(config.residual, description, 1)
            found[key] = environment_fingerprint(config, batched, script)
            if config.evaluate_network is not None:
                evaluation_environment(config, 1)
        except ValueError as error:
            raise ValueError(f"grid: {in_words(run.values)}: {error}") from error
    return found


def _environment(run: SweepRun) -> str:
    """The settings that its environment depends on."""
    settings = run.config.as_dict()
    return json.dumps([settings[name] for name in _ENVIRONMENT])


def _loaded(config: TrainingConfig) -> TrainingConfig:
    """With the scenario itself instead of its name, as checkpoints have it."""
    return dataclasses.replace(config, scenario=chosen_scenario(config.environment, config.scenario))
