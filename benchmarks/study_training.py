"""The trainings of the study, in processes: finished runs aren't repeated, and one that was cut is continued."""

from __future__ import annotations

import dataclasses
import json
import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import Any, NamedTuple

from agents.learning.config import Backend, TrainingConfig
from agents.learning.config_file import read_config
from agents.learning.run_folder import CHECKPOINT, write
from agents.workers import run_in_processes
from benchmarks.study import DONE, Run, state_of

_INTERRUPTED = "interrupted"


class _Job(NamedTuple):
    run: Run
    root: Path
    until: float  # no training begins after this time
    commit: str
    backend: Backend


def train_all(
    chosen: Sequence[Run],
    root: Path,
    *,
    workers: int = 2,
    until: float = float("inf"),
    commit: str = "",
    backend: Backend = "torch",
    say: Callable[[str], None] = print,
) -> list[str]:
    """Run the missing trainings.

    Args:
        chosen: in this order.
        root: folder of the study.
        workers: number of processes; 1 for this one.
        until: time (`time.time()`) after which no training begins.
        commit: of the code, in words.
        backend: of all trainings that can have it.
        say: called with a line after every run.

    Returns:
        A line for every run that failed, can't be trained, or wasn't because its folder has other settings.

    Raises:
        KeyboardInterrupt: on Ctrl-C; runs that were cut go on from their last evaluation the next time.
    """
    states = {run: state_of(run, root) for run in chosen}
    problems = []
    for run, state in states.items():
        if state.text:
            problems.append(f"{run.label}: {state.text}")
            say(problems[-1])
    jobs = [_Job(run, root, until, commit, backend) for run, state in states.items() if state.kind == "missing"]
    start, trained = time.perf_counter(), 0
    for number, outcome in in_processes(_train, jobs, workers):
        if outcome is None:
            continue
        good, text = outcome
        if text == _INTERRUPTED:
            raise KeyboardInterrupt
        trained += 1
        if not good:
            problems.append(f"{jobs[number].run.label}: {text}")
        left = (time.perf_counter() - start) / trained * (len(jobs) - trained)
        say(f"{trained} of {len(jobs)}: {jobs[number].run.label}: {text}; about {left / 60:.0f} min left for all")
    if len(jobs) > trained:
        say(f"{len(jobs) - trained} of {len(jobs)} trainings weren't begun: the time is over")
    return problems


def in_processes(function: Callable[[Any], Any], jobs: Sequence[Any], workers: int) -> Iterator[tuple[int, Any]]:
    """Index and result of each job as they are finished; with one worker in this process."""
    return run_in_processes(function, jobs, workers) if workers > 1 else enumerate(map(function, jobs))


def _config(job: _Job, folder: Path) -> TrainingConfig:
    """The settings of a training; one that was begun goes on with its backend."""
    config, backend = job.run.config(), job.backend
    if (folder / CHECKPOINT).exists():
        backend = read_config(folder / "config.toml").get("backend", "torch")
    return dataclasses.replace(config, backend=backend) if config.policy == "mlp" else config


def _train(job: _Job) -> tuple[bool, str] | None:
    """Whether it went well, and in words what came out; None if it wasn't begun. One failure doesn't end the others."""
    from agents.learning.training import train

    if time.time() > job.until:
        return None
    folder = job.run.folder(job.root)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            training = train(_config(job, folder), folder, resume=(folder / CHECKPOINT).exists())
        except Exception as error:
            return False, f"failed: {type(error).__name__}: {error}"
    if not training.finished:
        return False, _INTERRUPTED
    write(folder / DONE, json.dumps({"seconds": round(training.seconds, 1), "commit": job.commit}) + "\n")
    best = max(point.mean_return for point in training.curve)
    return True, f"{best:.4g} in {training.seconds:.0f} s"
