"""Commands of the README and docs/guides/commands.md in the core installation: each works, or names its extra."""

import json
import os
import re
import shlex
import subprocess
import sys
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]
EXTRAS = ("scipy", "torch", "tensorboard", "stable_baselines3", "supersuit", "pygame", "imageio_ffmpeg", "ray", "zenoh")
EXTRAS += ("minari", "sb3_contrib")
SHORTER = {  # what makes a command take seconds; the code that it runs is the same
    "khop run": "--duration 0.05",
    "khop run paper --integrator explicit": "--duration 0.0005",
    "khop evaluate": "--episodes 2",
    "khop tune": "--policies tanh --observe estimate",
    "khop deploy": "--duration 1",
    "khop network": "--networks wifi --episodes 1 --duration 1",
    "khop iss": "--episodes 1 --duration 0.5",
    "khop test": "--steps 20",
    "khop bench": "--quick --only solve,scipy,training",
}
NEEDS = {  # what is refused, and the extra that the refusal names
    "khop train": "rl",
    "--video": "render",
}


def commands() -> list[str]:
    """The commands of both pages, in code blocks and in backquotes, ENV being one of the environments."""
    text = "".join((ROOT / page).read_text(encoding="utf-8") for page in ("README.md", "docs/guides/commands.md"))
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


def test_the_pages_name_every_command():
    named = {one.split()[1] for one in commands()}
    rest = {"evaluate", "train", "tune", "iss", "network", "deploy", "test", "bench"}
    assert named == {"list", "check", "run", "export", *rest}


def test_extras_cannot_be_imported_here(core):
    code = "import importlib, sys\nfor name in sys.argv[1:]:\n try: importlib.import_module(name)\n"
    said = core("-c", f"{code} except ModuleNotFoundError: print(name)", *EXTRAS).stdout
    assert said.split() == list(EXTRAS)


ALL = """
import json, sys
from typer.testing import CliRunner
from khop_env.cli import app
for arguments in json.loads(sys.argv[1]):
    done = CliRunner().invoke(app, arguments)
    fault = None if isinstance(done.exception, SystemExit | None) else repr(done.exception)
    print(json.dumps([done.exit_code, done.stdout, done.stderr, fault]))
"""


def test_a_command_works_or_names_what_to_install(core):
    """All of them in one process; the extras are out of reach in it all the time."""
    asked = [command.partition(" > ")[::2] for command in commands()]
    longest = [max((one for one in SHORTER if name.startswith(one)), key=len, default="") for name, _ in asked]
    arguments = [shlex.split(f"{name} {SHORTER.get(at, '')}")[1:] for (name, _), at in zip(asked, longest, strict=True)]
    done = core("-c", ALL, json.dumps(arguments))
    assert done.returncode == 0, done.stderr
    for (command, written), line in zip(asked, done.stdout.splitlines(), strict=True):
        status, stdout, stderr, fault = json.loads(line)
        assert fault is None, command
        extra = next((name for part, name in NEEDS.items() if part in command), None)
        if extra is not None:
            assert status == 2, command
            assert f"pip install -c constraints.txt -e '.[{extra}]'" in stderr, command
            continue
        assert status == 0, (command, stderr)
        assert stdout, command
        assert not written or stdout.startswith("# A scenario for khop_env")
