"""The published study of learning: which policies are trained, on what they are played, and the trainings themselves.

Every run has a folder of its own; finished runs aren't repeated, and one that was cut is continued.
"""

from __future__ import annotations

import json
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, replace
from pathlib import Path
from typing import Any, Literal, NamedTuple

from agents.learning.config import NO_LIMIT, TrainingConfig
from agents.learning.config_file import read_config
from khop_env.registry import scenario as by_name
from khop_env.scenarios import Scenario
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
FAST = 20.0  # 1/s, at which bounds on estimates fall where it is tried whether that pays


class Play(NamedTuple):
    """On what a policy is played.

    Attributes:
        observe: observation mode.
        network: None for the environment's own, which is continuous exchange but in navigation.
        inside: name of a safety filter around it; "" for none.
        rate: at which bounds on estimates fall in 1/s; None for the scenario's.
    """

    observe: Observe = "estimate"
    network: str | None = None
    inside: str = ""
    rate: float | None = None


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
    "faster bounds": Recipe((Play(rate=FAST),)),
    "critic on the state": Recipe(settings={"critic": "state"}),
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
FREE: Mapping[str, Any] = {"log_std_end": NO_LIMIT, "explore": 0.0, "reward_memory": 0}
EXPLORATION: Mapping[str, Recipe] = {  # their learning curves are what is of interest; one of the three is "estimate"
    "free exploration": Recipe((), FREE, seeds=SEEDS[:3]),
    "exploration ends": Recipe((), {**FREE, "log_std_end": -3.0}, seeds=SEEDS[:3]),
    "and recent rewards": Recipe((), {**FREE, "log_std_end": -3.0, "reward_memory": 20_000}, seeds=SEEDS[:3]),
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
    recipes: Sequence[str] = (*CONTINUOUS, *NETWORKED)

    def where(self, rate: float | None) -> str | Scenario:
        """The scenario, its bounds falling at another rate in 1/s, unless that is None."""
        return self.scenario if rate is None else _falling(by_name(self.scenario), rate)

    @property
    def label(self) -> str:
        """Name in titles."""
        return f"{self.environment} on {self.scenario}"

    @property
    def short(self) -> str:
        """Name in the summary: the environment's, or the scenario's where that says more."""
        leader = self.environment == "leader_following_v0"
        return self.scenario.partition(":")[0] if leader else self.environment.removesuffix("_v0")


def _falling(found: Scenario, rate: float) -> Scenario:
    """A scenario whose bounds fall at another rate, with the same final values."""

    def falling(bounds: Any) -> Any:
        if isinstance(bounds, Mapping):
            return {key: falling(value) for key, value in bounds.items()}
        if isinstance(bounds, list | tuple):
            return [falling(value) for value in bounds]
        return bounds and replace(bounds, rate=rate)

    name = f"{found.name}{',' if ':' in found.name else ':'}rate={rate:g}"
    return found.replace(name=name, delta=falling(found.delta), theta=falling(found.theta)).sized()


def _but(*left_out: str) -> tuple[str, ...]:
    return tuple(name for name in (*CONTINUOUS, *NETWORKED) if name not in left_out)


_ENDS, _FREE = ("free exploration", "exploration ends"), ("exploration ends", "and recent rewards")
_CRITIC = "critic on the state"  # tried where learning on estimates loses most against the truth
_MOST = _but(_CRITIC, "lossy attention", "lossy attention + bounds")  # attention: where bounds are hoped to pay
_CONVOY = _but(_CRITIC, "faster bounds")  # they fall at 15 1/s
TASKS = (
    StudyTask("consensus_v0", "paper", 2_000_000, (*_MOST, *_ENDS)),
    StudyTask("formation_v0", "random_geometric:agents=12", 1_000_000, (*_MOST, *_ENDS)),
    StudyTask("leader_following_v0", "convoy", 1_500_000, (*_CONVOY, *_FREE)),
    StudyTask("leader_following_v0", "mixed_fleet", 2_000_000, (*_but(), *_FREE)),
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
        rate = recipe.plays[0].rate if recipe.plays else None
        settings = {**recipe.settings, "scenario": self.task.where(rate), "timesteps": self.task.timesteps}
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
        wanted["backend"] = there["backend"]  # the same results but for rounding
        if all(each["log_std_end"] > each["log_std"] for each in (wanted, there)):
            wanted["log_std_end"] = there["log_std_end"]  # neither is a limit
        differs = [f"{key} = {there[key]!r} and not {value!r}" for key, value in wanted.items() if there[key] != value]
    except (TypeError, ValueError) as error:
        differs = [str(error)]
    if differs:
        why = f"{folder} was trained with other settings than today's ({'; '.join(differs)})"
        return State("other", f"{why}: it isn't used; move it away to train it again")
    return State("missing" if finished(folder) is None else "finished")
