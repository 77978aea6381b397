"""The published table: policies trained on estimates, the truth, and neighbours only, beside tuned scripts.

Every run has a folder of its own, and finished runs aren't repeated, so that an interrupted study can be continued.
"""

from __future__ import annotations

import time
import warnings
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from agents.comparison import Comparison, Row, compare, interval95
from agents.learning.config import TrainingConfig
from agents.workers import run_in_processes
from khop_env.observers import Exponential, FloatArray
from khop_env.registry import scenario
from khop_env.simulation import OBSERVE, Observe

SCRIPTS = ("tanh", "linear", "formation", "leader_following")
SEEDS = range(5)
EPISODES = range(100)
DONE = "finished"
WITHIN = 3.0  # percent: aim for the difference between policies trained on estimates and on true states


@dataclass(frozen=True)
class StudyTask:
    """One block of the table.

    Attributes:
        environment: name of the environment.
        scenario: name of the scenario.
        timesteps: agent-steps of each training.
    """

    environment: str
    scenario: str
    timesteps: int

    @property
    def label(self) -> str:
        """Name in titles."""
        return f"{self.environment} on {self.scenario}"


TASKS = (
    StudyTask("consensus_v0", "paper", 1_000_000),
    StudyTask("leader_following_v0", "convoy", 1_500_000),
    StudyTask("leader_following_v0", "mixed_fleet", 1_500_000),
    StudyTask("formation_v0", "random_geometric:agents=12", 1_000_000),
    StudyTask("formation_v0", "random_geometric:agents=12,rate=15", 1_000_000),
)

VARIANTS: dict[str, dict[str, Any]] = {
    "estimate": {"observe": "estimate"},
    "oracle": {"observe": "oracle"},
    "local": {"observe": "local"},
    "estimate + bounds": {"observe": "estimate", "bounds": True},
}
"""Observations of the trainings, by name of the variant."""


@dataclass(frozen=True)
class Learned:
    """One variant's policies, played on one kind of observation.

    Attributes:
        variant: name of the observations in training.
        observe: observation mode in the evaluation.
        returns: (seeds, episodes) returns.
        rows: results per training seed.
    """

    variant: str
    observe: Observe
    returns: FloatArray
    rows: list[Row]

    @property
    def label(self) -> str:
        """Name in the table, e.g. "PPO trained on oracle, on estimate"."""
        if self.variant in (self.observe, f"{self.observe} + bounds"):
            return f"PPO on {self.variant}"
        return f"PPO trained on {self.variant}, on {self.observe}"


@dataclass(frozen=True)
class Block:
    """Everything measured of one task.

    Attributes:
        task: the task.
        scripts: rows of the scripted policies under all observation modes, and of bang-bang adversaries.
        learned: results of the learned policies.
        curves: {variant: (seeds, evaluations)} learning curves, mean returns.
        timesteps: (evaluations,) of the curves.
        seconds: time of training in s, sum of all runs.
    """

    task: StudyTask
    scripts: Comparison
    learned: list[Learned]
    curves: dict[str, FloatArray]
    timesteps: FloatArray
    seconds: float


def folder_of(root: Path, task: StudyTask, variant: str, seed: int) -> Path:
    """Folder of a run."""
    scenario = task.scenario.replace(":", "-").replace("=", "")
    return root / f"{task.environment}-{scenario}" / f"{variant.replace(' + ', '-')}-{seed}"


def seconds_of(folder: Path) -> float | None:
    """Duration of the finished training of a folder in s; None if it hasn't finished, or its mark is damaged.

    Args:
        folder: folder of a run.
    """
    try:
        return float((folder / DONE).read_text())
    except (OSError, ValueError):
        return None


def train_all(
    root: Path,
    tasks: Sequence[StudyTask] = TASKS,
    seeds: Sequence[int] = SEEDS,
    *,
    workers: int = 2,
    say: Callable[[str], None] = print,
) -> None:
    """Run the missing trainings in several processes.

    Args:
        root: folder of the study.
        tasks: blocks of the table.
        seeds: training seeds.
        workers: number of processes.
        say: called with a line after every run.
    """
    jobs = [
        (root, task, variant, seed)
        for seed in seeds
        for task in tasks
        for variant in VARIANTS
        if seconds_of(folder_of(root, task, variant, seed)) is None
    ]
    start = time.perf_counter()
    for done, (_, text) in enumerate(run_in_processes(_train, jobs, workers), 1):
        left = (time.perf_counter() - start) / done * (len(jobs) - done)
        say(f"{done} of {len(jobs)}: {text}; about {left / 60:.0f} min left")


def measure(
    root: Path, task: StudyTask, seeds: Sequence[int] = SEEDS, episodes: Sequence[int] = EPISODES, *, workers: int = 2
) -> Block:
    """Evaluate all policies of one task over the same episodes.

    Args:
        root: folder of the study.
        task: the task.
        seeds: training seeds.
        episodes: seeds of the episodes.
        workers: number of processes.
    """

    def played(policies: Sequence[str], observe: Sequence[Observe]) -> Comparison:
        return compare(
            task.environment,
            policies,
            observe,
            scenario=task.scenario,
            seeds=episodes,
            workers=workers,
        )

    scripts = played([*SCRIPTS, "bang_bang", "zero", "random"], OBSERVE)
    learned = []
    plays: list[tuple[str, Observe]] = [(name, chosen["observe"]) for name, chosen in VARIANTS.items()]
    for variant, observe in [*plays, ("oracle", "estimate")]:
        specs = [f"ppo:{folder_of(root, task, variant, seed)}" for seed in seeds]
        rows = played(specs, (observe,)).rows
        learned.append(Learned(variant, observe, np.array([row.episodes.returns for row in rows]), rows))
    curves, seconds = {}, 0.0
    for variant in VARIANTS:
        found = []
        for seed in seeds:
            folder = folder_of(root, task, variant, seed)
            found.append(np.loadtxt(folder / "curve.csv", delimiter=",", skiprows=1))
            seconds += seconds_of(folder) or 0.0
        shortest = min(map(len, found))
        curves[variant] = np.array([curve[:shortest, 1] for curve in found])
        steps = found[0][:shortest, 0]
    return Block(task, scripts, learned, curves, steps, seconds)


def table(block: Block) -> Iterator[str]:
    """The block in Markdown: means, intervals over episodes, spread over seeds, and the guarantee."""
    yield f"## {block.task.label}\n"
    yield f"Bounds on estimates fall at {rates_of(block.task.scenario)} 1/s.\n"
    yield "| policy | return | spread over seeds | error at the end (m) | largest \\|e\\| | after the transient |"
    yield "|---|---|---|---|---|---|"
    best = {
        mode: max(
            (row for row in block.scripts.rows if row.observe == mode and row.policy in SCRIPTS),
            key=lambda row: float(row.episodes.returns.mean()),
        )
        for mode in OBSERVE
    }
    for row in block.scripts.rows:
        is_best, floor = row is best[row.observe], row.policy not in SCRIPTS and row.observe == "estimate"
        if is_best or floor or row.policy in ("tanh", "linear"):
            name = row.policy if floor else f"{row.policy}, tuned, on {row.observe}"
            yield _line(name + " (best script)" * is_best, row.episodes.returns[None], [row])
    for learned in block.learned:
        yield _line(learned.label, learned.returns, learned.rows)
    yield ""
    for text in comparisons(block, best["estimate"], best["local"]):
        yield f"- {text}"
    yield ""


def rates_of(name: str) -> str:
    """The rates at which a scenario's bounds on state estimates fall, in 1/s."""
    bounds = scenario(name).design.states.bounds
    return " to ".join(
        f"{rate:g}" for rate in sorted({bound.rate for bound in bounds if isinstance(bound, Exponential)})
    )


def comparisons(block: Block, script: Row, local_script: Row) -> Iterator[str]:
    """Comparisons of observation modes and policies; differences are paired by episode and training seed."""
    by = {(learned.variant, learned.observe): learned for learned in block.learned}
    estimate, transferred = by["estimate", "estimate"], by["oracle", "estimate"]
    against = _paired("learned on estimates, against learned on the truth", estimate, by["oracle", "oracle"])
    percent = _percent(estimate, by["oracle", "oracle"])
    low, high = (percent.mean() + sign * float(interval95(percent) or 0.0) for sign in (-1.0, 1.0))
    aim = "reached" if low > -WITHIN else "missed" if high < -WITHIN else "open, the interval is wider than the aim"
    yield f"{against} (aim: within {WITHIN:g} %: {aim})"
    yield _paired("trained on the truth but played on estimates, against trained on estimates", transferred, estimate)
    yield _paired("with the guaranteed bounds, against without", by["estimate + bounds", "estimate"], estimate)
    tanh, linear = (
        next(row for row in block.scripts.rows if (row.policy, row.observe) == (policy, "estimate"))
        for policy in ("tanh", "linear")
    )
    for reference, returns in (
        (f"the best tuned script on estimates ({script.policy})", script.episodes.returns[None]),
        ("the tuned proportional law on estimates (linear)", linear.episodes.returns[None]),
        ("the paper's law on estimates, tuned (tanh)", tanh.episodes.returns[None]),
        (f"the best tuned script on neighbours only ({local_script.policy})", local_script.episodes.returns[None]),
        ("learned on neighbours only", by["local", "local"].returns),
    ):
        yield f"learned on estimates, against {reference}: {_verdict(estimate.returns, returns)}"


def largest_ratio(block: Block) -> tuple[float, float, float]:
    """Largest |e| over all rows and episodes, after the transient, and largest error over its bound."""
    rows = [*block.scripts.rows, *(row for learned in block.learned for row in learned.rows)]
    results = [row.episodes for row in rows]
    return (
        max(float(episodes.max_normalized_disagreement.max()) for episodes in results),
        max(float(episodes.late_normalized_disagreement.max()) for episodes in results),
        max(float(episodes.max_error_to_bound.max()) for episodes in results),
    )


def _line(name: str, returns: FloatArray, rows: Sequence[Row]) -> str:
    mean, interval = returns.mean(), interval95(returns.mean(axis=0))
    spread = f"{returns.mean(axis=1).std(ddof=1):.3g}" if len(returns) > 1 else ""
    results = [row.episodes for row in rows]
    error = np.mean([episodes.final_task_error.mean() for episodes in results])
    worst = max(float(episodes.max_normalized_disagreement.max()) for episodes in results)
    late = max(float(episodes.late_normalized_disagreement.max()) for episodes in results)
    return f"| {name} | {mean:.4g} ± {interval:.2g} | {spread} | {error:.3g} | {worst:.3f} | {late:.3f} |"


def _percent(learned: Learned, reference: Learned) -> FloatArray:
    """(seeds,) difference of returns in percent of the reference's absolute return, by training seed."""
    return 100.0 * (learned.returns - reference.returns).mean(axis=1) / np.abs(reference.returns.mean(axis=1))


def _paired(title: str, learned: Learned, reference: Learned) -> str:
    """Difference relative to the reference by training seed, and paired by episode."""
    percent, more = _percent(learned, reference), (learned.returns - reference.returns).mean(axis=0)
    interval = interval95(percent)
    over_seeds = "" if interval is None else f" ± {interval:.2g} % over training seeds"
    return (
        f"{title}: {percent.mean():+.2g} %{over_seeds}; paired by episode {more.mean():+.3g} ± {interval95(more):.2g}"
    )


def _verdict(ours: FloatArray, theirs: FloatArray) -> str:
    """The difference of returns (seeds, episodes); better or worse only where intervals over both exclude 0."""
    more = ours - theirs
    mean = float(more.mean())
    over_episodes = float(interval95(more.mean(axis=0)) or 0.0)
    over_seeds = float(interval95(more.mean(axis=1)) or 0.0)
    clear = abs(mean) > max(over_episodes, over_seeds)
    verdict = ("better" if mean > 0.0 else "worse") if clear else "no clear difference"
    relative = f"{100.0 * mean / abs(float(theirs.mean())):+.2g} %"
    intervals = f"± {over_episodes:.2g} over episodes, ± {over_seeds:.2g} over training seeds"
    return f"{mean:+.3g} {intervals} ({relative}): {verdict}"


def _train(job: tuple[Path, StudyTask, str, int]) -> str:
    from agents.learning.run_folder import CHECKPOINT
    from agents.learning.training import train

    root, task, variant, seed = job
    folder = folder_of(root, task, variant, seed)
    config = TrainingConfig(task.environment, task.scenario, timesteps=task.timesteps, seed=seed, **VARIANTS[variant])
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        training = train(config, folder, resume=(folder / CHECKPOINT).exists())
    if training.finished:
        (folder / DONE).write_text(f"{training.seconds:.1f}")
    best = max(point.mean_return for point in training.curve)
    return f"{task.label}, {variant}, seed {seed}: {best:.3f} in {training.seconds:.0f} s"
