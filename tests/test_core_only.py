"""Every command of the README in the core installation, without any extra: it works, or names what to install."""

import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
EXTRAS = ("scipy", "torch", "tensorboard", "stable_baselines3", "supersuit", "pygame", "imageio_ffmpeg", "ray")
SHORTER = {  # what makes a command take seconds; the code that it runs is the same
    "khop run": "--duration 0.05",
    "khop run paper --integrator explicit": "--duration 0.0005",
    "khop evaluate": "--episodes 2",
    "khop tune": "--policies tanh --observe estimate",
    "khop network": "--networks wifi --episodes 1 --duration 1",
    "khop iss": "--episodes 1 --duration 0.5",
    "khop test": "--steps 20",
    "khop bench": "--quick",
}
NEEDS = {  # what is refused, and the extra that the refusal names
    "khop train": "rl",
    "--video": "render",
}


def commands() -> list[str]:
    """The README's commands, in code blocks and in backquotes, ENV being one of the environments."""
    text = (ROOT / "README.md").read_text()
    lines = re.findall(r"^(?:\.venv/bin/)?(khop [^#\n]*)", text, flags=re.MULTILINE)
    found = [*lines, *re.findall(r"`(khop [a-z]+(?: [^`]+)?)`", text)]
    # a policy has to be trained before it can be played
    found = [re.sub(r"ppo:runs/[^,]*,", "", one.strip()).replace("ENV", "consensus_v0") for one in found]
    return [one for one in dict.fromkeys(found) if one not in ("khop run", "khop tune")]  # named without arguments


@pytest.fixture(scope="module")
def core(tmp_path_factory):
    """Runs Python in a process that can't import any extra, nor can those that it starts."""
    folder = tmp_path_factory.mktemp("core")
    (folder / "sitecustomize.py").write_text(f"import sys\nsys.modules.update(dict.fromkeys({EXTRAS!r}))\n")
    environment = {**os.environ, "PYTHONPATH": f"{folder}{os.pathsep}{ROOT}"}

    def python(*arguments: str) -> subprocess.CompletedProcess:
        return subprocess.run([sys.executable, *arguments], cwd=folder, env=environment, capture_output=True, text=True)

    (folder / "my_file.py").write_text(
        "from khop_env.consensus_v0 import parallel_env as make_env\nfrom khop_env.tasks import Consensus as MyTask\n"
    )
    (folder / "mine.toml").write_text(python("-m", "khop_env", "export", "paper").stdout)
    return python


def test_the_readme_names_every_command():
    named = {one.split()[1] for one in commands()}
    assert named == {"list", "check", "run", "export", "evaluate", "train", "tune", "iss", "network", "test", "bench"}


@pytest.mark.parametrize("name", EXTRAS)
def test_extras_cannot_be_imported_here(name, core):
    assert "ModuleNotFoundError" in core("-c", f"import {name}").stderr


@pytest.mark.parametrize("command", commands())
def test_a_command_works_or_names_what_to_install(command, core):
    command, _, written = command.partition(" > ")
    longest = max((one for one in SHORTER if command.startswith(one)), key=len, default="")
    done = core("-m", "khop_env", *shlex.split(f"{command} {SHORTER.get(longest, '')}")[1:])
    assert "Traceback" not in done.stderr
    extra = next((name for part, name in NEEDS.items() if part in command), None)
    if extra is not None:
        assert done.returncode == 2
        assert f"pip install -c constraints.txt -e '.[{extra}]'" in done.stderr
        return
    assert done.returncode == 0, done.stderr
    assert done.stdout
    assert not written or done.stdout.startswith("# A scenario for khop_env")
