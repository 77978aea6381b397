"""Play the policies of the study, and keep what was measured: a policy is played once on each thing."""

from __future__ import annotations

import hashlib
import json
import zipfile
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import cache
from pathlib import Path
from typing import NamedTuple

import numpy as np

import khop_env
from agents.comparison import compare
from agents.learning.archive import write_arrays
from agents.tuned import PATH as TUNED
from agents.workers import UnfinishedError
from benchmarks.study import CONTINUOUS, FILTER, NETWORKS, RECIPES, SCRIPTS, SEEDS, Play, Run, StudyTask
from benchmarks.study import state_of as run_state
from benchmarks.study_training import in_processes
from khop_env.observers import FloatArray
from khop_env.simulation import OBSERVE

EPISODES = range(100)
KEPT = (
    "returns",
    "final_task_error",
    "max_normalized_disagreement",
    "late_normalized_disagreement",
    "max_error_to_bound",
)
FLOORS = ("bang_bang", "zero", "random")
Measured = Mapping[str, FloatArray]
"""(episodes,) by name: those of `KEPT`, and where agents may collide the outcomes of `agents.evaluation.Episodes`."""


@dataclass(frozen=True, eq=False)
class Row:
    """One policy, or the policies of one kind of training, played on one thing.

    Attributes:
        name: of the kind of training, or a script as `make_policy` takes it.
        play: on what.
        seeds: training seeds that have finished; of a script (0,).
        runs: measurements by seed.
        learned: whether it is a kind of training.
    """

    name: str
    play: Play
    seeds: Sequence[int]
    runs: Sequence[Measured]
    learned: bool

    def values(self, key: str, seeds: Sequence[int] | None = None) -> FloatArray:
        """(seeds, episodes) of one measurement."""
        chosen = self.seeds if seeds is None or not self.learned else seeds
        return np.array([run[key] for seed, run in zip(self.seeds, self.runs, strict=True) if seed in chosen])

    @property
    def returns(self) -> FloatArray:
        """(seeds, episodes) returns."""
        return self.values("returns")


@dataclass(frozen=True, eq=False)
class Block:
    """Everything measured of one task.

    Attributes:
        task: the task.
        rows: scripts first; a kind of training without a finished run has a row without seeds.
    """

    task: StudyTask
    rows: Sequence[Row]

    def row(self, name: str, play: Play) -> Row | None:
        """A row with at least one finished run; None if there is none."""
        return next((row for row in self.rows if (row.name, row.play) == (name, play) and row.seeds), None)

    def best(self, play: Play, key: str = "returns") -> Row:
        """The script with the largest mean of one measurement, on one thing."""
        names = (FILTER, f"{FILTER}:go_to_goal") if self.navigates else SCRIPTS
        rows = [row for row in self.rows if row.play == play and row.name in names]
        return max(rows, key=lambda row: float(row.values(key).mean()))

    @property
    def navigates(self) -> bool:
        """Whether agents may collide."""
        return self.task.environment == "navigation_v0"


class _Job(NamedTuple):
    root: Path
    task: StudyTask
    name: str  # as `make_policy` takes it
    play: Play
    episodes: tuple[int, ...]
    key: str


def measure(
    root: Path,
    tasks: Sequence[StudyTask],
    seeds: Sequence[int] = SEEDS,
    episodes: Sequence[int] = EPISODES,
    *,
    workers: int = 2,
    say: Callable[[str], None] = print,
) -> tuple[list[Block], list[str]]:
    """Play all scripts and all finished policies over the same episodes.

    What was measured is kept in the folder `measured`, by the contents of the policy's file, and not measured again;
    delete the folder after a change of the environments.

    Args:
        root: folder of the study.
        tasks: blocks of the table.
        seeds: training seeds.
        episodes: seeds of the episodes.
        workers: number of processes; 1 for this one.
        say: called with a line from time to time.

    Returns:
        The blocks, and a line for every trained policy that couldn't be played, whose row goes without it.

    Raises:
        RuntimeError: if a script couldn't be played.
    """
    plan: dict[str, _Job] = {}
    made = []
    for task in tasks:
        rows = []
        for name, play in _scripts(task):
            rows.append((name, play, False, {0: _planned(plan, root, task, name, play, episodes, None)}))
        for name in task.recipes:
            done = [seed for seed in seeds if run_state(Run(task, name, seed), root).kind == "finished"]
            for play in RECIPES[name].plays:
                keys = {}
                for seed in done:
                    folder = Run(task, name, seed).folder(root)
                    spec = f"{play.inside}:ppo:{folder}".removeprefix(":")
                    keys[seed] = _planned(plan, root, task, spec, play, episodes, folder / "best.npz")
                rows.append((name, play, True, keys))
        made.append((task, rows))
    missing = [job for job in plan.values() if _load(root, job.key) is None]
    problems = []
    for count, (number, problem) in enumerate(in_processes(_play, missing, workers), 1):
        if problem:
            problems.append(f"{missing[number].name} on {missing[number].task.label}: {problem}")
            say(problems[-1])
        if count % 20 == 0 or count == len(missing):
            say(f"played {count} of {len(missing)}")
    blocks = []
    for task, rows in made:
        block = []
        for name, play, learned, keys in rows:
            found = {seed: run for seed, key in keys.items() if (run := _load(root, key)) is not None}
            if not learned and not found:
                raise RuntimeError(f"there is no table without its scripts: {'; '.join(problems)}")
            block.append(Row(name, play, tuple(found), tuple(found.values()), learned))
        blocks.append(Block(task, block))
    return blocks, problems


def _scripts(task: StudyTask) -> list[tuple[str, Play]]:
    """The scripts of a task, and on what each is played."""
    if task.environment == "navigation_v0":
        inside = [(name, Play(inside=FILTER)) for name in (FILTER, f"{FILTER}:go_to_goal")]
        return [*inside, ("keep_right", Play()), ("go_to_goal", Play())]
    continuous = [(name, Play(observe)) for observe in OBSERVE for name in SCRIPTS]
    floors = [(name, Play()) for name in FLOORS] if set(task.recipes) & set(CONTINUOUS) else []
    others = [Play(network=network) for network in NETWORKS]
    others += [play for name in task.recipes for play in RECIPES[name].plays if play.rate is not None]
    return [*continuous, *floors, *((name, play) for play in others for name in SCRIPTS)]


def _planned(
    plan: dict[str, _Job],
    root: Path,
    task: StudyTask,
    spec: str,
    play: Play,
    episodes: Sequence[int],
    file: Path | None,
) -> str:
    """Add a job, and return the key of what it measures."""
    about = {
        "policy": spec if file is None else play.inside,
        "file": _digest(TUNED if file is None else file),
        "environment": task.environment,
        "scenario": task.scenario,
        "observe": play.observe,
        "network": play.network,
        "episodes": list(episodes),
        "version": khop_env.__version__,
    } | ({} if play.rate is None else {"rate": play.rate})
    key = hashlib.sha256(json.dumps(about, sort_keys=True).encode()).hexdigest()[:32]
    plan[key] = _Job(root, task, spec, play, tuple(episodes), key)
    return key


def _digest(file: Path) -> str:
    return _digest_of(file, file.stat().st_mtime_ns)


@cache
def _digest_of(file: Path, _: int) -> str:
    return hashlib.sha256(file.read_bytes()).hexdigest()


def _play(job: _Job) -> str:
    """Play one policy, and write what was measured; in words what went wrong, "" if nothing did."""
    networks = None if job.play.network is None else [job.play.network]
    try:
        compared = compare(
            job.task.environment,
            [job.name],
            [job.play.observe],
            scenario=job.task.where(job.play.rate),
            seeds=job.episodes,
            networks=networks,
        )
    except (ValueError, UnfinishedError) as error:
        return f"can't be played on {job.play}: {error}"
    episodes = compared.rows[0].episodes
    values = {key: getattr(episodes, key) for key in KEPT} | dict(episodes.outcomes)
    write_arrays(_path(job.root, job.key), values, compress=False)
    return ""


def _path(root: Path, key: str) -> Path:
    return root / "measured" / f"{key}.npz"


def _load(root: Path, key: str) -> Measured | None:
    """What was measured; None if it wasn't, or its file is damaged."""
    try:
        with np.load(_path(root, key), allow_pickle=False) as file:
            return dict(file) if set(KEPT) <= set(file) else None
    except (OSError, ValueError, EOFError, zipfile.BadZipFile):
        return None
