"""Train, measure, write docs/benchmarks/learning.md, its figure and the shipped policies: 1 to 2 hours on two cores.

    .venv/bin/python -m benchmarks.publish_table

Finished runs aren't repeated (runs/study); the pretrained policies are those trained on estimates with seed 0.
"""

import argparse
import os
import platform
import shutil
from datetime import date
from pathlib import Path

from agents.learning import PRETRAINED, TrainingConfig, pretrained_name
from agents.learning.curve import EVALUATION_SEEDS
from agents.policy import describe
from benchmarks.publish import commit
from benchmarks.study import EPISODES, SEEDS, TASKS, folder_of, largest_ratio, measure, table, train_all
from khop_env.registry import make_batched
from khop_env.results import learning_curves

BY_HAND = "<!-- what follows is written by hand -->"
parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
parser.add_argument("--root", type=Path, default=Path("runs/study"), help="folder of the runs")
parser.add_argument("--workers", type=int, default=2, help="processes")
parser.add_argument("--docs", type=Path, default=Path("docs"), help="folder of the table and the figure")


def main() -> None:
    """Run missing trainings, measure, and write the files."""
    options = parser.parse_args()
    train_all(options.root, workers=options.workers, say=lambda text: print(text, flush=True))
    blocks = [measure(options.root, task, workers=options.workers) for task in TASKS]
    hours = sum(block.seconds for block in blocks) / 3600.0
    ratios = [largest_ratio(block) for block in blocks]
    worst, late, bound = (max(column) for column in zip(*ratios, strict=True))
    kept = "**The guarantee held in every episode**" if max(worst, bound) < 1.0 else "**THE GUARANTEE WAS BROKEN**"
    budgets = ", ".join(f"{task.timesteps / 1e6:g} million on {task.label}" for task in TASKS)
    text = [
        "# Learned policies, measured\n",
        f"Written by `python -m benchmarks.publish_table` on {date.today().isoformat()}, {commit()}: {len(SEEDS)} "
        f"training seeds for each kind of observation, {len(EPISODES)} evaluation episodes, the same for every row and "
        f"other than those that policies were trained, selected or tuned on. The trainings took {hours:.1f} hours of "
        f"wall time added up, {options.workers} at a time on {os.cpu_count()} shared cores ({platform.machine()}, no "
        f"GPU); agent-steps of each run: {budgets}. The evaluated policy of each run is the best of "
        f"{TrainingConfig('consensus_v0').evaluations} evaluations on {len(EVALUATION_SEEDS)} further episodes.\n",
        "Returns are means over agents of an episode's sum; ± is the 95 % interval over episodes, of learned policies "
        "after averaging over training seeds. Scripts have the parameters that `khop tune` found for the "
        "environment and the scenario, on estimates (also used on true states) or on neighbours only. A verdict "
        "needs intervals over episodes and over training seeds that both exclude 0.\n",
        f"{kept}, of learned, scripted, random and bang-bang policies alike: largest |e| {worst:.4f} over all time, "
        f"{late:.4f} after the first quarter of an episode, largest error over its bound {bound:.4f}; the guarantee is "
        "that all are below 1.\n",
        "In consensus an agent can meet the others without communication: it goes to the origin, where initial sets "
        "are centred. The script `leader_following` does so on neighbours only, and a network can learn it; in plain "
        "consensus estimates aren't decisive. They are where an agent follows a moving reference that isn't its "
        "neighbour.\n",
        "![Learning curves](../images/learning.png)\n",
    ]
    for block in blocks:
        text += table(block)
    page, figure = options.docs / "benchmarks" / "learning.md", options.docs / "images" / "learning.png"
    for path in (page, figure):
        path.parent.mkdir(parents=True, exist_ok=True)
    written = page.read_text(encoding="utf-8") if page.exists() else ""
    by_hand = "".join(written.partition(f"\n{BY_HAND}")[1:])  # stays
    page.write_text("\n".join(text).rstrip() + "\n" + by_hand, encoding="utf-8")
    curves = {block.task.label: (block.timesteps, block.curves) for block in blocks}
    learning_curves(curves, figure)
    PRETRAINED.mkdir(exist_ok=True)
    for task in TASKS:
        name = describe(make_batched(task.environment, task.scenario)).scenario
        best = folder_of(options.root, task, "estimate", 0) / "best.npz"
        shutil.copyfile(best, PRETRAINED / f"{pretrained_name(task.environment, name)}.npz")
    print("\n".join(text))


if __name__ == "__main__":
    main()
