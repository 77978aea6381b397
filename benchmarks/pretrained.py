"""The policies that come with the library: train them again, exchange them, and write their cards.

    python -m benchmarks.pretrained                            # measures those without a card, and writes the cards
    python -m benchmarks.pretrained --train NAME ...           # runs their `khop train` commands, and takes the results
    python -m benchmarks.pretrained --take NAME=FOLDER ...     # takes the best policy of a run; NAME may be new

Cards (agents/learning/pretrained/README.md, docs/pretrained.md) belong to the files that they were measured with, by
their hashes: after a file was exchanged its card has to be written again (half a minute each), and so do the films of
`docs/gallery.md`. What index.toml says is written into the cards without measuring again; an exchanged file begins
without a word on where it fails, which a test misses.
"""

from __future__ import annotations

import argparse
import datetime
import re
import shlex
import shutil
import subprocess
import sys
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import Any

import tomlkit

from agents.learning.config import TrainingConfig
from agents.learning.learned import LearnedPolicy
from agents.learning.pretrained import PRETRAINED, shipped
from benchmarks.cards import write_cards
from khop_env.registry import find_task
from khop_env.terminal import say

INDEX = PRETRAINED / "index.toml"
RUNS = Path("runs/pretrained")
SPOKEN = {"shield": "--shield", "residual": "--residual", "initial": "--from", "num_envs": "--num-envs"}
"""Settings that are options of `khop train` of their own."""
_NAME = re.compile(r"[a-z][a-z0-9_]*")


def command_of(about: Mapping[str, Any], out: Path | str) -> list[str]:
    """The `khop train` command of a run: what differs from the settings that suit its environment, and the seed.

    Args:
        about: of its policy.
        out: folder for the run.
    """
    environment = about["environment"]
    suited = TrainingConfig.suited(environment, algorithm=about["algorithm"]).as_dict()
    command = ["khop", "train", environment]
    if about["scenario"] != find_task(environment).default_scenario:
        command += ["--scenario", about["scenario"]]
    arguments = dict(about.get("arguments", {}))
    for name in ("network", "estimator"):
        if (value := arguments.pop(name, None)) is not None:
            command += [f"--{name}", _network(value)]
    command += ["--timesteps", str(about["timesteps"]), "--seed", str(about["seed"])]
    for name, default in suited.items():
        value = about.get(name, default)
        if name in ("environment", "scenario", "arguments", "timesteps", "seed") or value == default or value is None:
            continue
        if name in SPOKEN:
            command += [SPOKEN[name], str(value)]
        else:
            command += ["--set", f"{name}={_spelled(value)}"]
    for name, value in arguments.items():
        if suited["arguments"].get(name) != value:
            command += ["--env", f"{name}={_spelled(value)}"]
    return [*command, "--out", str(out)]


def _network(value: str | Mapping[str, Any]) -> str:
    """A network or estimator as the command line takes it."""
    if isinstance(value, str):
        return value
    ranges = {key: "..".join(map(str, each)) if isinstance(each, list) else each for key, each in value.items()}
    return "ideal:" + ",".join(f"{key}={each}" for key, each in ranges.items())


def _spelled(value: Any) -> str:
    if isinstance(value, list | tuple):
        return "+".join(map(_spelled, value))
    return str(value).lower() if isinstance(value, bool) else str(value)


def take(name: str, source: Path, *, keep_commands: bool = False) -> None:
    """Exchange a shipped policy for the best one of a run, and write down how it was trained.

    Args:
        name: of the policy; a new one is added.
        source: folder of the run, or a policy's file.
        keep_commands: whether the commands in the index stay as they are.

    Raises:
        ValueError: if there is no policy in `source`, or the name isn't of letters, digits and underscores.
    """
    if not _NAME.fullmatch(name):
        raise ValueError(f"a policy's name is of small letters, digits and underscores; got {name!r}")
    file = source / "best.npz" if source.is_dir() else source
    about = LearnedPolicy.load(file).about
    document = tomlkit.parse(INDEX.read_text(encoding="utf-8"))
    entry = document.setdefault(name, tomlkit.table())
    entry["environment"], entry["scenario"] = about["environment"], about["scenario"]
    for key in ("network", "estimator"):
        if (value := about.get("arguments", {}).get(key)) is not None:
            entry[key] = _network(value)
        elif key in entry:
            del entry[key]
    if not keep_commands:
        commands = [command_of(about, RUNS / name)]
        while about.get("initial"):
            before = Path(about["initial"])
            if not (before if before.is_file() else before / "last.npz").exists():
                say(f"{name} began with {before}, which isn't here: write its commands into {INDEX.name} by hand")
                break
            about = LearnedPolicy.load(before if before.is_file() else before / "last.npz").about
            commands.insert(0, command_of(about, before if not before.suffix else before.parent))
        lines = tomlkit.array()
        lines.extend(shlex.join(command) for command in commands)
        entry["train"] = lines.multiline(True)
    target = PRETRAINED / f"{name}.npz"
    if not target.exists() or target.read_bytes() != file.read_bytes():
        shutil.copyfile(file, target)
        entry["trained"] = datetime.date.fromtimestamp(file.stat().st_mtime)
        entry["fails"] = ""  # was said of another file
        say(f"{name}: another file than before; measure it, and say in {INDEX.name} where it fails")
    INDEX.write_text(tomlkit.dumps(document), encoding="utf-8")
    say(f"{name}: taken from {file}")


def train(name: str) -> None:
    """Run the commands of a shipped policy, those that are interrupted from where they were, and take its result.

    Raises:
        subprocess.CalledProcessError: if one fails.
    """
    folder = Path()
    for line in shipped()[name].train:
        say(line)
        arguments = shlex.split(line)[1:]
        folder = Path(arguments[arguments.index("--out") + 1])
        resume = ["--resume"] if (folder / "checkpoint.npz").exists() else []
        subprocess.run([sys.executable, "-m", "khop_env", *arguments, *resume], check=True)
    take(name, folder, keep_commands=True)


def _names(chosen: Sequence[str]) -> Iterator[str]:
    for name in chosen:
        if name not in shipped():
            raise ValueError(f"no pretrained policy {name!r}; there are {', '.join(shipped())}")
        yield name


def main() -> None:
    """Do what was asked for."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("--train", nargs="*", metavar="NAME", help="train these again, or all")
    parser.add_argument("--take", nargs="+", metavar="NAME=RUN", help="exchange them for the best policies of runs")
    parser.add_argument("--episodes", type=int, default=100, help="of each row of a card; 100 by default")
    parser.add_argument("--again", action="store_true", help="measure those that have a card, too")
    parser.add_argument(
        "--workers", type=int, default=1, help="processes; 1 by default, which is faster for 100 episodes"
    )
    chosen = parser.parse_args()
    try:
        for pair in chosen.take or ():
            name, _, source = pair.partition("=")
            take(name, Path(source))
        if chosen.train is not None:
            for name in list(_names(chosen.train or list(shipped()))):
                train(name)
        if chosen.take is None and chosen.train is None:
            write_cards(PRETRAINED / "README.md", chosen.episodes, chosen.workers, again=chosen.again)
    except (ValueError, subprocess.CalledProcessError) as error:
        parser.error(str(error))


if __name__ == "__main__":
    main()
