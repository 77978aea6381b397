"""The published study of learning: which policies are trained, on what they are played, and the trainings themselves.

Every run has a folder of its own; finished runs aren't repeated, and one that was cut is continued.
"""

from __future__ import annotations

import json
import time
import warnings
from collections.abc import Callable, Iterable, Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, NamedTuple

from agents.learning.config import TrainingConfig
from agents.learning.config_file import read_config
from agents.learning.run_folder import CHECKPOINT, write
from agents.workers import run_in_processes
from khop_env.simulation import Observe

SEEDS = range(5)
DONE = "finished"  # file in the folder of a finished run
CORE_HOURS = 8.0  # budget of all trainings: four hours of two cores
SCRIPTS = ("tanh", "linear", "formation", "leader_following")
LOSSY = "lossy:loss=0.3,burst=5"
NETWORKS = ("ideal", "wifi", LOSSY)
RANDOM = "random"  # networks that are drawn anew in every episode
SHIELD = "certified,announce=true"
FILTER = "filter:announce=true"  # the same filter around a policy that is played


class Play(NamedTuple):
    """On what a policy is played.

    Attributes:
        observe: observation mode.
        network: None for the environment's own, which is continuous exchange but in navigation.
        inside: name of a safety filter around it; "" for none.
    """

    observe: Observe = "estimate"
    network: str | None = None
    inside: str = ""


@dataclass(frozen=True)
class Recipe:
    """One kind of training.

    Attributes:
        plays: on what its policies are played; the first is what they were trained on.
        settings: of `TrainingConfig`, where they aren't those that `khop train` uses by itself.
        network: over which it is trained; None for the environment's own.
        seeds: training seeds.
    """

    plays: Sequence[Play] = (Play(),)
    settings: Mapping[str, Any] = field(default_factory=dict)
    network: str | None = None
    seeds: Sequence[int] = SEEDS


def _over(*networks: str) -> tuple[Play, ...]:
    return tuple(Play(network=network) for network in networks)


CONTINUOUS: Mapping[str, Recipe] = {
    "estimate": Recipe(),
    "oracle": Recipe((Play("oracle"), Play("estimate")), {"observe": "oracle"}),
    "local": Recipe((Play("local"),), {"observe": "local"}),
    "estimate + bounds": Recipe(settings={"bounds": True}),
    "residual": Recipe(settings={"residual": "leader_following"}),  # the best tuned script on all four tasks
}
NETWORKED: Mapping[str, Recipe] = {
    "ideal": Recipe(_over(*NETWORKS), {}, "ideal"),
    "wifi": Recipe(_over("wifi"), {}, "wifi"),
    "lossy": Recipe(_over(LOSSY), {}, LOSSY),
    "lossy + bounds": Recipe(_over(LOSSY), {"bounds": True}, LOSSY),
    "lossy attention": Recipe(_over(LOSSY), {"policy": "attention"}, LOSSY),
    "lossy attention + bounds": Recipe(_over(LOSSY), {"policy": "attention", "bounds": True}, LOSSY),
    "random": Recipe(_over(*NETWORKS), {}, RANDOM),
}
CAREFUL: Mapping[str, Any] = {"residual": "keep_right", "log_std": -1.5, "log_std_end": -3.0, "entropy": 0.0} | {
    "gamma": 0.9925, "learning_rate": 3e-4, "n_steps": 32, "batch_size": 4096, "intervention": 0.0, "saturation": 0.0
}  # small steps away from a script that solves the task  # fmt: skip
NAVIGATION: Mapping[str, Recipe] = {
    "shielded": Recipe((Play(inside=FILTER),), {"shield": SHIELD}),
    "shielded residual": Recipe((Play(inside=FILTER),), {"shield": SHIELD, **CAREFUL}),
    "not shielded": Recipe((Play(), Play(inside=FILTER))),
}
FREE: Mapping[str, Any] = {"log_std_end": 100.0, "explore": 0.0, "reward_memory": 0}
EXPLORATION: Mapping[str, Recipe] = {  # beside "estimate"; their learning curves are what is of interest
    "free exploration": Recipe((), FREE, seeds=SEEDS[:3]),
    "exploration ends": Recipe((), {**FREE, "log_std_end": -3.0}, seeds=SEEDS[:3]),
}
RECIPES: Mapping[str, Recipe] = {**CONTINUOUS, **NETWORKED, **NAVIGATION, **EXPLORATION}
"""All kinds of trainings by name."""


@dataclass(frozen=True)
class StudyTask:
    """One block of the table.

    Attributes:
        environment: name of the environment.
        scenario: name of the scenario.
        timesteps: agent-steps of each training.
        recipes: names of its trainings.
    """

    environment: str
    scenario: str
    timesteps: int
    recipes: Sequence[str] = (*CONTINUOUS, *NETWORKED, *EXPLORATION)

    @property
    def label(self) -> str:
        """Name in titles."""
        return f"{self.environment} on {self.scenario}"

    @property
    def short(self) -> str:
        """Name in the summary: the environment's, or the scenario's where that says more."""
        leader = self.environment == "leader_following_v0"
        return self.scenario.partition(":")[0] if leader else self.environment.removesuffix("_v0")


TASKS = (
    StudyTask("consensus_v0", "paper", 1_000_000),
    StudyTask("formation_v0", "random_geometric:agents=12", 1_000_000),
    StudyTask("leader_following_v0", "convoy", 1_500_000),
    StudyTask("leader_following_v0", "mixed_fleet", 1_500_000),
    StudyTask("navigation_v0", "crossing", 2_000_000, tuple(NAVIGATION)),
)

ORDER: Sequence[tuple[str | None, Sequence[str]]] = (
    (None, ("estimate", "oracle")),
    ("crossing", ("shielded residual", "shielded")),
    ("convoy", ("lossy attention", "lossy attention + bounds")),
    (None, ("residual", "ideal", "lossy", "random")),
    (None, tuple(RECIPES)),
)
"""What is trained first: scenarios (None: all) and trainings, each with all seeds before the next."""


class Run(NamedTuple):
    """One training.

    Attributes:
        task: what is to be done.
        recipe: name of the kind of training.
        seed: training seed.
    """

    task: StudyTask
    recipe: str
    seed: int

    @property
    def label(self) -> str:
        """Name in messages."""
        return f"{self.task.label}, {self.recipe}, seed {self.seed}"

    def folder(self, root: Path) -> Path:
        """Its folder in that of the study."""
        scenario = self.task.scenario.replace(":", "-").replace(",", "-").replace("=", "")
        recipe = self.recipe.replace(" + ", "-").replace(" ", "-")
        return root / f"{self.task.environment}-{scenario}" / f"{recipe}-{self.seed}"

    def config(self) -> TrainingConfig:
        """Its settings: those that `khop train` uses by itself, with the recipe's.

        Raises:
            TypeError: if this version of the library lacks a setting.
            ValueError: if a value is invalid.
        """
        recipe = RECIPES[self.recipe]
        settings = {**recipe.settings, "scenario": self.task.scenario, "timesteps": self.task.timesteps}
        if recipe.network is not None:
            settings["arguments"] = {"network": recipe.network}
        return TrainingConfig.suited(self.task.environment, seed=self.seed, **settings)


def runs(
    tasks: Sequence[StudyTask] = TASKS, seeds: Sequence[int] = SEEDS, recipes: Iterable[str] = RECIPES
) -> list[Run]:
    """All trainings, the most important first.

    Args:
        tasks: blocks of the table.
        seeds: training seeds.
        recipes: names of kinds of trainings.
    """
    chosen = set(recipes)
    found = (
        Run(task, name, seed)
        for scenario, names in ORDER
        for seed in seeds
        for task in tasks
        if scenario in (None, task.scenario)
        for name in names
        if name in task.recipes and name in chosen and seed in RECIPES[name].seeds
    )
    return list(dict.fromkeys(found))


class Finished(NamedTuple):
    """What is written down when a training has finished.

    Attributes:
        seconds: wall time of the training.
        commit: of the code that trained it, in words.
    """

    seconds: float
    commit: str


def finished(folder: Path) -> Finished | None:
    """What a finished training has written down; None if it hasn't finished, or its mark is damaged.

    Args:
        folder: folder of a run.
    """
    try:
        found = json.loads((folder / DONE).read_text(encoding="utf-8"))
        return Finished(float(found["seconds"]), str(found["commit"]))
    except (OSError, ValueError, KeyError, TypeError):
        return None


class State(NamedTuple):
    """Where a run stands.

    Attributes:
        kind: "finished"; "missing", also if it has only begun; "other" if its folder has other settings than today's;
            "impossible" if this version of the library lacks its settings.
        text: why it is one of the last two.
    """

    kind: Literal["finished", "missing", "other", "impossible"]
    text: str = ""


def state_of(run: Run, root: Path) -> State:
    """Whether a run has finished with today's settings."""
    folder = run.folder(root)
    try:
        wanted = run.config().as_dict()
    except (TypeError, ValueError) as error:
        return State("impossible", f"this version can't train it: {error}")
    if not (folder / "config.toml").exists():
        return State("missing")
    try:
        there = TrainingConfig(**read_config(folder / "config.toml")).as_dict()
        differs = [f"{key} = {there[key]!r} and not {value!r}" for key, value in wanted.items() if there[key] != value]
    except (TypeError, ValueError) as error:
        differs = [str(error)]
    if differs:
        why = f"{folder} was trained with other settings than today's ({'; '.join(differs)})"
        return State("other", f"{why}: it isn't used; move it away to train it again")
    return State("missing" if finished(folder) is None else "finished")


_INTERRUPTED = "interrupted"


class _Job(NamedTuple):
    run: Run
    root: Path
    until: float  # no training begins after this time
    commit: str


def train_all(
    chosen: Sequence[Run],
    root: Path,
    *,
    workers: int = 2,
    until: float = float("inf"),
    commit: str = "",
    say: Callable[[str], None] = print,
) -> list[str]:
    """Run the missing trainings.

    Args:
        chosen: in this order.
        root: folder of the study.
        workers: number of processes; 1 for this one.
        until: time (`time.time()`) after which no training begins.
        commit: of the code, in words.
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
    jobs = [_Job(run, root, until, commit) for run, state in states.items() if state.kind == "missing"]
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


def _train(job: _Job) -> tuple[bool, str] | None:
    """Whether it went well, and in words what came out; None if it wasn't begun. One failure doesn't end the others."""
    from agents.learning.training import train

    if time.time() > job.until:
        return None
    folder = job.run.folder(job.root)
    with warnings.catch_warnings():
        warnings.simplefilter("ignore")
        try:
            training = train(job.run.config(), folder, resume=(folder / CHECKPOINT).exists())
        except Exception as error:
            return False, f"failed: {type(error).__name__}: {error}"
    if not training.finished:
        return False, _INTERRUPTED
    write(folder / DONE, json.dumps({"seconds": round(training.seconds, 1), "commit": job.commit}) + "\n")
    best = max(point.mean_return for point in training.curve)
    return True, f"{best:.4g} in {training.seconds:.0f} s"
