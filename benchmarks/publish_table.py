"""Train what is missing, measure, and write docs/benchmarks/learning.md and its figures.

    .venv/bin/python -m benchmarks.publish_table                # four hours on two cores
    .venv/bin/python -m benchmarks.publish_table --hours 0      # with the trainings that there are

Everything can be interrupted: the same command continues. Trainings are in runs/study, one folder each, measurements
in runs/study/measured. What is trained in one call can be restricted; the page always has all that there is.
"""

from __future__ import annotations

import argparse
import math
import os
import platform
import sys
import time
from collections import Counter
from collections.abc import Iterable, Iterator, Mapping, Sequence
from datetime import date
from pathlib import Path
from typing import Any, get_args

from agents.learning import TrainingConfig
from agents.learning.config import Backend
from agents.learning.run_folder import write
from agents.tuned import OVER
from agents.workers import Interrupted
from benchmarks.publish import commit
from benchmarks.study import (
    CORE_HOURS,
    EXPLORATION,
    NAVIGATION,
    NETWORKS,
    RANDOM,
    RECIPES,
    SEEDS,
    TASKS,
    StudyTask,
    finished,
    runs,
    state_of,
)
from benchmarks.study_curves import FIGURES, draw, exploration
from benchmarks.study_measured import EPISODES, Block, measure
from benchmarks.study_table import largest_ratios, summary, table
from benchmarks.study_training import train_all
from khop_env.network import PROFILES, Network
from khop_env.physics import did_you_mean
from khop_env.registry import make_batched

AIMED = (
    "Differences in percent, with the wider of the intervals over episodes and over training seeds. *Open*: the "
    "interval is wider than the aim, or trainings are missing. *Within 3 % of the truth*: learned on estimates, "
    "against learned on true states. *Level with the best script*: learned on estimates is at least level with the "
    "best of the tuned scripts on estimates; *better on three tasks*: clearly better. The same for *residual* "
    "policies, which act on top of `leader_following`. *Bounds pay*: over a lossy network, certificates in the "
    "observation, beside the ages that are there in any case, make returns better. *Shielded*: trained and played in "
    "the certified filter, against the better of `keep_right` and `go_to_goal` in the same filter. [What the misses "
    "come from](#what-the-misses-come-from) is at the end.\n"
)
EXPLORING_FIGURE = [*FIGURES][-1]
EXPLORING = """## Exploration and the unit of rewards

PPO adds noise to its actions, and an entropy bonus keeps it from becoming small. With `free exploration` the noise is
the learner's. `exploration ends` limits the logarithm of its standard deviation to a value that falls from `log_std` to
-3, and the bonus to 0. `and recent rewards` also divides rewards by the deviation of the latest returns only
(`reward_memory`): those of the first policies are hundreds of times larger. `estimate` is what `khop train` does by
itself: exploration that ends and recent rewards in consensus and formation, free exploration and all rewards in leader
following. Returns on the 32 episodes that select policies, without noise: mean over training seeds, and the extremes.
"""

BY_HAND = "<!-- what follows is written by hand -->"


def main(arguments: Sequence[str] | None = None, tasks: Sequence[StudyTask] = TASKS) -> int:
    """Train, measure and write.

    Args:
        arguments: of the command; None for the process's own.
        tasks: blocks of the table.

    Returns:
        The exit status: 0, 1 if a training failed or couldn't be used, 130 after an interrupt.
    """
    start, options = time.time(), _options(arguments, tasks)
    chosen = runs(options.only, options.seeds, options.trainings)
    every = [run for run in runs(tasks) if run not in set(chosen)]
    try:
        until = start + 3600.0 * options.hours
        problems = train_all(
            chosen,
            options.root,
            workers=options.workers,
            until=until,
            commit=commit(),
            backend=options.backend,
            say=_say,
        )
        problems += [f"{run.label}: {state.text}" for run in every if (state := state_of(run, options.root)).text]
        blocks, unplayed = measure(options.root, tasks, episodes=options.episodes, workers=options.workers, say=_say)
        problems += unplayed
    except (KeyboardInterrupt, Interrupted):
        _say(
            "interrupted: finished trainings and measurements are kept, others go on from their last evaluation with "
            "the same command; the page wasn't changed"
        )
        return 130
    page = options.docs / "benchmarks" / "learning.md"
    images = options.docs / "images"
    for folder in (page.parent, images):
        folder.mkdir(parents=True, exist_ok=True)
    figures = dict(draw(options.root, tasks, images))
    text = "\n".join(_page(options, tasks, blocks, figures, problems)).rstrip() + "\n"
    written = page.read_text(encoding="utf-8") if page.exists() else ""
    by_hand = "".join(written.partition(f"\n{BY_HAND}")[1:])  # stays
    write(page, text + by_hand)
    _say(f"wrote {page}")
    for line, count in _counted(problems):
        _say(f"not in it: {line}{f' ({count} trainings)' if count > 1 else ''}")
    return 1 if problems else 0


def _options(arguments: Sequence[str] | None, tasks: Sequence[StudyTask]) -> argparse.Namespace:
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--root", type=Path, default=Path("runs/study"), help="folder of the runs")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--backend", choices=get_args(Backend), default="torch", help="of trainings that can have it")
    parser.add_argument("--docs", type=Path, default=Path("docs"), help="folder of the page and the figures")
    parser.add_argument("--hours", type=float, default=math.inf, help="begin no training after this time")
    parser.add_argument("--only", default="", help="train only these tasks: environments or scenarios, with commas")
    parser.add_argument("--trainings", default="", help=f"train only these kinds: {', '.join(RECIPES)}")
    parser.add_argument("--seeds", type=int, default=len(SEEDS), help="train only the first seeds")
    parser.add_argument("--episodes", type=int, default=len(EPISODES), help="episodes of each measurement")
    options = parser.parse_args(arguments)
    names = {
        name: [task for task in tasks if name in (task.environment, task.scenario.partition(":")[0])]
        for each in tasks
        for name in (each.environment, each.scenario.partition(":")[0])
    }
    try:
        only = [task for name in _names(options.only, names) for task in names[name]]
        options.only = [task for task in tasks if task in only] if only else list(tasks)
        options.trainings = _names(options.trainings, RECIPES) or list(RECIPES)
        for name, least in (("workers", 1), ("seeds", 0), ("episodes", 2), ("hours", 0)):
            if not getattr(options, name) >= least:
                raise ValueError(f"--{name} must be at least {least}; got {getattr(options, name)}")
    except ValueError as error:
        parser.error(str(error))
    options.seeds, options.episodes = SEEDS[: options.seeds], range(options.episodes)
    return options


def _names(text: str, known: Iterable[str]) -> list[str]:
    """Names between commas.

    Raises:
        ValueError: for one that isn't known.
    """
    found = [name.strip() for name in text.split(",") if name.strip()]
    for name in found:
        if name not in known:
            raise ValueError(f"there is no {name!r} in the study; {did_you_mean(name, list(known))}")
    return found


def _page(
    options: argparse.Namespace,
    tasks: Sequence[StudyTask],
    blocks: Sequence[Block],
    figures: Mapping[str, str],
    problems: Sequence[str],
) -> Iterator[str]:
    """The page but for its end, which is written by hand."""
    states = {run: state_of(run, options.root).kind for run in runs(tasks)}
    done = [run for run, state in states.items() if state == "finished"]
    marks = [mark for run in done if (mark := finished(run.folder(options.root))) is not None]
    hours = sum(mark.seconds for mark in marks) / 3600.0
    commits = ", ".join(
        f"{name or 'unknown'} ({count})" for name, count in Counter(mark.commit for mark in marks).items()
    )
    steps = ", ".join(f"{task.timesteps / 1e6:g} million on {task.label}" for task in tasks)
    missing = (
        f"**{len(states) - len(done)} of {len(states)} trainings are missing**"
        if len(done) < len(states)
        else (f"All {len(states)} trainings have finished")
    )
    other = sum(state == "other" for state in states.values())
    unused = f"; {other} have other settings than today's, and aren't counted" if other else ""
    few = len(RECIPES[next(iter(EXPLORATION))].seeds)
    yield "# Learned policies, measured\n"
    yield (
        f"Written by `python -m benchmarks.publish_table` on {date.today().isoformat()}, {commit()}. "
        f"{missing}{unused}: {len(SEEDS)} training seeds of each kind, {few} where exploration "
        f"is compared. The trainings took {hours:.1f} hours of the "
        f"{CORE_HOURS:g} core hours that were planned (four hours of two cores), each on one of {os.cpu_count()} "
        f"shared cores ({platform.machine()}, no GPU), by the code of {commits or 'no commit yet'}. Agent-steps of "
        f"each: {steps}.\n"
    )
    worst, late, bound = largest_ratios(blocks)
    held = worst < 1.0 and bound <= 1.0
    kept = "**The guarantee held in every episode**" if held else "**THE GUARANTEE WAS BROKEN**"
    yield (
        f"{kept}, of learned, scripted, random and bang-bang policies alike: in continuous exchange the largest |e| "
        f"was {worst:.4f}, {late:.4f} after the first quarter of an episode; the guarantee is that it is below 1. "
        f"The largest error over its bound, or over its certificate where there is a network, was {bound:.4f}; it is "
        "guaranteed not to be above 1.\n"
    )
    yield "## What was aimed at\n"
    yield from summary(blocks)
    yield "\n" + AIMED
    yield "\n## How it was measured\n"
    yield from _method(tasks, len(options.episodes))
    for name, figure in figures.items():
        if figure != EXPLORING_FIGURE:
            yield f"![Learning curves{name}](../images/{figure})\n"
    if EXPLORING_FIGURE in figures.values():
        yield EXPLORING
        yield f"![Learning curves with and without a schedule of exploration](../images/{EXPLORING_FIGURE})\n"
        yield from exploration(options.root, tasks)
    for block in blocks:
        yield from table(block)
    if problems:
        yield "Not in the table:\n"
        for line, count in _counted(problems):
            yield f"- {line}{f' ({count} trainings)' if count > 1 else ''}"


def _method(tasks: Sequence[StudyTask], episodes: int) -> Iterator[str]:
    """Trainings, settings and statistics."""
    yield "| training | settings beside those of `khop train` | trained over | tasks |"
    yield "|---|---|---|---|"
    for name, recipe in RECIPES.items():
        settings = ", ".join(f"`{key}={value}`" for key, value in recipe.settings.items())
        settings += "".join(f"bounds fall at {play.rate:g} 1/s" for play in recipe.plays if play.rate is not None)
        having = [task.short for task in tasks if name in task.recipes]
        where = "all but navigation" if len(having) == len(tasks) - 1 else ", ".join(having)
        network = f"`{recipe.network}`" if recipe.network else "its scenario's network" if name in NAVIGATION else ""
        yield f"| {name} | {settings} | {network or 'continuous exchange'} | {where} |"
    yield f"\n{_networks()}\n"
    for task in tasks:
        yield f"- `khop train {task.environment} --scenario {task.scenario}`: {_own_settings(task)}"
    yield (
        "\nThe policy of each run is the best of its evaluations on episodes of their own. Every row is played on the "
        f"same {episodes} episodes, on which nothing was trained, selected or tuned. Returns are means over agents of "
        "an episode's sum. ± beside a return is the 95 % interval over episodes, after averaging over training seeds; "
        "`over seeds` is that over training seeds. IQM is the interquartile mean over seeds and episodes, with the "
        "95 % interval of a bootstrap over both ([Agarwal et al., 2021](https://arxiv.org/abs/2108.13264)). Errors are "
        "in m, means over agents; |e| and error over bound are the largest of all episodes and seeds, `late` those "
        "after the first quarter of an episode.\n"
    )
    yield (
        "Scripts, of which the best is in bold, have the parameters that `khop tune` found for environment and "
        "scenario: in continuous exchange on estimates (used on true states, too), on neighbours only, and on "
        f"estimates over `{OVER}` networks, used over all three. Differences are paired by episode and seed: better "
        "or worse is said only where the intervals over episodes and over training seeds both exclude 0, level where "
        "they don't "
        f"but stay within 3 %. The wider of both is in the summary. {_estimators(tasks)}\n"
    )
    yield (
        "In consensus an agent can meet the others without communication: it goes to the origin, where initial sets "
        "are centred. The script `leader_following` does so on neighbours only, and a network can learn it; in plain "
        "consensus estimates aren't decisive. They are where an agent follows a moving reference that isn't its "
        "neighbour.\n"
    )


def _networks() -> str:
    """The networks in words."""
    names = (*NETWORKS, RANDOM)
    known = {name: Network.of(name) for name in names if name.partition(":")[0] in PROFILES}
    described = (f"`{name}`, {network.described()}" for name, network in known.items() if network is not None)
    return f"Networks: {'; '.join(described)}."


def _own_settings(task: StudyTask) -> str:
    """Settings that `khop train` chooses for a task, in words."""
    plain = TrainingConfig(task.environment, task.scenario).as_dict()
    own = TrainingConfig.suited(task.environment, scenario=task.scenario).as_dict()
    differs = [f"`{key}={value}`" for key, value in own.items() if plain[key] != value]
    return ", ".join(differs) or "the defaults of `TrainingConfig`"


def _estimators(tasks: Sequence[StudyTask]) -> str:
    """A sentence on the estimators over networks."""
    found: dict[str, list[str]] = {}
    for task in tasks:
        arguments: dict[str, Any] = {} if set(task.recipes) <= set(NAVIGATION) else {"network": "ideal"}
        observers: Any = make_batched(task.environment, task.scenario, **arguments).simulator.observers
        found.setdefault(observers.estimator.name, []).append(task.label)
    if len(found) == 1:
        return f"The estimator over networks is `{next(iter(found))}`."
    return (
        "Estimators over networks: "
        + ", ".join(f"`{name}` ({', '.join(where)})" for name, where in found.items())
        + "."
    )


def _counted(problems: Sequence[str]) -> Iterator[tuple[str, int]]:
    """The first line of those that say the same of several runs, and how many do."""
    by_reason: dict[str, list[str]] = {}
    for line in problems:
        by_reason.setdefault(line.partition(": ")[2], []).append(line)
    yield from ((lines[0], len(lines)) for lines in by_reason.values())


def _say(text: str) -> None:
    print(text, flush=True)


if __name__ == "__main__":
    sys.exit(main())
