"""Write the tables of docs/benchmarks, each with its command, date, machine and commit.

    .venv/bin/python -m benchmarks.publish networks safety     # half an hour on two cores
    .venv/bin/python -m benchmarks.publish speed --peers .peers
    OPENBLAS_NUM_THREADS=1 .venv/bin/python -m benchmarks.publish precision    # three minutes

The tables on learning are written by `benchmarks.publish_table`.
"""

from __future__ import annotations

import argparse
import os
import platform
import subprocess
from collections.abc import Callable, Iterable, Sequence
from datetime import date
from importlib.metadata import version
from pathlib import Path
from typing import Any

from agents import make_law
from agents.workers import Interrupted
from benchmarks.benchmark import benchmark
from benchmarks.precision import figure, work_precision
from benchmarks.safety_table import table
from khop_env.network import PROFILES
from khop_env.registry import scenario
from khop_env.results.networks import NetworkRow, measure_networks
from khop_env.terminal import Progress, say

ROOT = Path(__file__).resolve().parents[1]
EPISODES = 16  # of each row on networks
SAFETY_EPISODES = 100  # of each cell on safety
NOISY: Sequence[tuple[str, str, float, float]] = (
    ("paper", "ideal", 0.1, 0.05),
    ("paper", "ideal", 0.1, 0.01),
    ("paper", "ideal", 0.5, 0.05),
    ("paper", "wifi", 0.1, 0.05),
    ("paper", "wifi", 0.5, 0.05),
    ("mixed_fleet", "ideal", 0.1, 0.05),
    ("mixed_fleet", "wifi", 0.1, 0.05),
)
"""Scenario, network, noise in m, and period in s."""


def stamp(command: str) -> str:
    """A line on how, when and where a table was made.

    Args:
        command: that makes it again.
    """
    packages = ", ".join(f"{name} {version(name)}" for name in ("numpy", "numba"))
    machine = f"{platform.system()} {platform.machine()}, {os.cpu_count()} shared cores"
    python = f"Python {platform.python_version()}, {packages}"
    return f"*`{command}` on {date.today().isoformat()}, {commit()}; {machine}; {python}.*"


def commit() -> str:
    """The repository's commit, and whether code differs from it."""
    code = ("khop_env", "agents", "benchmarks", ":(exclude)agents/learning/pretrained")  # cards name policies by hash
    changed = _git("status", "--porcelain", "--", *code)
    return f"commit {_git('rev-parse', '--short=10', 'HEAD') or 'unknown'}{', with changes' if changed else ''}"


def _git(*arguments: str) -> str:
    """Output of a git command in the repository; empty where there is none."""
    done = subprocess.run(["git", "-C", str(ROOT), *arguments], capture_output=True, text=True, check=False)
    return done.stdout.strip()


def speed(options: argparse.Namespace) -> Iterable[str]:
    """`khop bench`, whole."""
    yield stamp(f"khop bench{' --peers .peers' if options.peers else ''}")
    found = benchmark(progress=say, peers=options.peers)
    yield from ("", "| row | value | target | what is measured |", "|---|---|---|---|")
    for row in found["rows"]:
        value = f"{row['value']:.3g} {row['unit']}" if row["skipped"] is None else f"skipped: {row['skipped']}"
        target = f"**missed:** {row['target']}" if row["met"] is False else row["target"]
        yield f"| `{row['name']}` | {value} | {target} | {row['explanation']} |"
    if found["interrupted"]:
        raise KeyboardInterrupt


def precision(options: argparse.Namespace) -> Iterable[str]:
    """Time against error, and its figure."""
    yield stamp("OPENBLAS_NUM_THREADS=1 python -m benchmarks.publish precision")
    points = {name: work_precision(name, say) for name in ("paper", "mixed_fleet")}
    figure(points, options.docs / "images" / "work_precision.png")
    yield from ("", "| scenario, method | largest error, and time for 10 s (ms) |", "|---|---|")
    for name, methods in points.items():
        for method, values in methods.items():
            listed = "; ".join(f"{error:.1e}: {1e3 * seconds:.3g}" for error, seconds in values)
            yield f"| `{name}`, {method} | {listed} |"


def networks(options: argparse.Namespace) -> Iterable[str]:
    """Every profile, both estimators, on true states so that all rows have the same motion."""
    yield stamp("khop network paper --observe oracle")
    found = _rows("paper", [name for name, network in PROFILES.items() if not network.ranges], None, EPISODES)
    yield from (
        "",
        "| network | loss | latency (ms) | ppso: mean error (m) | relay | certified bound, ppso | relay "
        "| relay, over the information limit |",
        "|---|---|---|---|---|---|---|---|",
    )
    for ppso, relay in zip(found[::2], found[1::2], strict=True):
        profile = PROFILES[ppso.network]
        latency = 1e3 * profile.bounds("latency")[1]
        yield (
            f"| `{ppso.network}` | {ppso.loss:.3g} | {latency:.3g} | {ppso.mean_error:.3g} | {relay.mean_error:.3g} "
            f"| {ppso.mean_bound:.3g} | {relay.mean_bound:.3g} | {relay.bound_to_limit:.2f} |"
        )


def noise(options: argparse.Namespace) -> Iterable[str]:
    """Measurement noise, by which the paper's observers are ahead."""
    yield stamp("khop network SCENARIO --networks NETWORK:noise=... --periods ... --observe oracle --episodes 8")
    yield from (
        "",
        "| scenario, network | messages a second | noise (m) | ppso: mean error (m) | relay | ratio |",
        "|---|---|---|---|---|---|",
    )
    with Progress("noise") as progress:
        for number, (name, network, amount, period) in enumerate(NOISY):
            ppso, relay = _rows(name, [f"{network}:noise={amount:g}"], [period], 8)
            errors = [row.mean_error or float("nan") for row in (ppso, relay)]
            yield (
                f"| `{name}`, `{network}` | {1.0 / period:.0f} | {amount:g} | {errors[0]:.3g} | {errors[1]:.3g} "
                f"| {errors[0] / errors[1]:.2g} |"
            )
            progress((number + 1) / len(NOISY))


def safety(options: argparse.Namespace) -> Iterable[str]:
    """Ways to keep apart."""
    yield stamp(f"python -m benchmarks.safety_table crossing swap --episodes {SAFETY_EPISODES}")
    for name in ("crossing", "swap"):
        yield ""
        yield from table(name, range(SAFETY_EPISODES), options.workers)


def _rows(name: str, chosen: Sequence[Any], periods: Sequence[float] | None, episodes: int) -> list[NetworkRow]:
    made = scenario(name)
    return list(
        measure_networks(made, make_law(made.law), chosen, periods=periods, observe="oracle", episodes=episodes)
    )


TABLES: dict[str, Callable[[argparse.Namespace], Iterable[str]]] = {
    "speed": speed,
    "precision": precision,
    "networks": networks,
    "noise": noise,
    "safety": safety,
}


def main() -> None:
    """Write the tables; each file is replaced once its table is complete."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("tables", nargs="+", choices=TABLES)
    parser.add_argument("--peers", type=Path, help="folder of other libraries' environments, see `khop bench`")
    parser.add_argument("--workers", type=int, default=2, help="processes")
    parser.add_argument("--docs", type=Path, default=ROOT / "docs", help="folder of the documentation")
    options = parser.parse_args()
    folder = options.docs / "benchmarks" / "tables"
    folder.mkdir(parents=True, exist_ok=True)
    for name in options.tables:
        say(name)
        lines: list[str] = []
        try:
            lines.extend(TABLES[name](options))
        except (KeyboardInterrupt, Interrupted):
            print("\n".join(lines))
            say(f"interrupted: {name} isn't complete, and its file wasn't changed")
            raise SystemExit(130) from None
        (folder / f"{name}.md").write_text("\n".join(lines) + "\n", encoding="utf-8")


if __name__ == "__main__":
    main()
