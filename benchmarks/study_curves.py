"""Learning curves of the study: their figures, and what the schedule of exploration does to them."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path

import numpy as np

from benchmarks.study import CONTINUOUS, EXPLORATION, NAVIGATION, NETWORKED, RECIPES, Run, StudyTask, state_of
from khop_env.observers import FloatArray
from khop_env.results import learning_curves

EXPLORING = (*EXPLORATION, "estimate")
_DRAWN = [name for name in CONTINUOUS if name not in ("faster bounds", "critic on the state")]  # they look the same
FIGURES = {
    "learning.png": ("", (*_DRAWN, *NAVIGATION)),
    "learning_networks.png": (" over networks", tuple(NETWORKED)),
    "learning_exploration.png": (" with and without a schedule of exploration", EXPLORING),
}


def draw(root: Path, tasks: Sequence[StudyTask], images: Path) -> Iterator[tuple[str, str]]:
    """Write the figures: what each shows beside learning curves, and its file.

    Args:
        root: folder of the study.
        tasks: blocks of the table, a panel each.
        images: folder of the figures.
    """
    for file, (title, names) in FIGURES.items():
        curves: dict[str, Mapping[str, tuple[FloatArray, FloatArray]]] = {}
        for task in tasks:
            named = {name: found for name in names if (found := curve(root, task, name)) is not None}
            if len(named) > (names == EXPLORING):  # one curve alone says nothing of exploration
                curves[task.label] = named
        if curves:
            learning_curves(curves, images / file)
            yield title, file


def exploration(root: Path, tasks: Sequence[StudyTask]) -> Iterator[str]:
    """A table of returns with three settings of exploration, at the best evaluation and at the last one."""
    yield "| task | training | seeds | best evaluation | last evaluation |"
    yield "|---|---|---|---|---|"
    for task in tasks:
        for name in EXPLORING:
            found = curve(root, task, name, RECIPES[EXPLORING[0]].seeds)
            if found is None:
                continue
            returns = found[1]
            cells = (_cell(returns.max(axis=1)), _cell(returns[:, -1]))
            yield f"| {task.label} | {name} | {len(returns)}/{len(RECIPES[EXPLORING[0]].seeds)} | {' | '.join(cells)} |"
    yield ""


def curve(
    root: Path, task: StudyTask, name: str, seeds: Sequence[int] | None = None
) -> tuple[FloatArray, FloatArray] | None:
    """Agent-steps (T,) and mean returns (seeds, T) of the finished trainings of a kind; None if there is none."""
    if name not in task.recipes:
        return None
    chosen = RECIPES[name].seeds if seeds is None else seeds
    made = [run for seed in chosen if state_of(run := Run(task, name, seed), root).kind == "finished"]
    found = [
        np.loadtxt(run.folder(root) / "curve.csv", delimiter=",", skiprows=1, usecols=(0, 1), ndmin=2) for run in made
    ]
    if not found:
        return None
    shortest = min(map(len, found))
    return found[0][:shortest, 0], np.array([each[:shortest, 1] for each in found])


def _cell(returns: FloatArray) -> str:
    """Mean over seeds, and the extremes."""
    return f"{returns.mean():.4g} [{returns.min():.4g}, {returns.max():.4g}]"
