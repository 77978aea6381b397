"""`khop test`: names, modules, files, what it prints and its exit status."""

import json
import sys
from pathlib import Path

import pytest
from test_cli import khop, only_json, refused

from khop_env.testing import CHECKS

TESTS = Path(__file__).resolve().parent


@pytest.fixture
def folder(tmp_path, monkeypatch):
    """A working directory with a user's own file."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path, str(TESTS)])
    known = set(sys.modules)
    (tmp_path / "my_env.py").write_text(
        "import walkers\n\n\n"
        "def parallel_env():\n    print('made')\n    return walkers.Walkers()\n\n\n"
        "def broken():\n    return walkers.Terminating()\n\n\n"
        "def failing():\n    raise RuntimeError('no such fleet')\n\n\n"
        "instance = walkers.Walkers()\n"
    )
    yield tmp_path
    for name in set(sys.modules) - known:
        if name in ("my_env", "my_env2"):
            del sys.modules[name]


def test_an_environment_by_name():
    result = khop("test", "consensus_v0", "--scenario", "paper", "--steps", "20")
    assert "consensus_v0: 16 passed, 0 failed, 1 skipped" in result.stdout
    assert max(map(len, result.stdout.splitlines())) <= 80


@pytest.mark.parametrize("name", ["my_env", "my_env.py", "my_env:parallel_env", "my_env.py:instance"])
def test_modules_files_functions_and_objects(name, folder):
    """Prints of the environment stay out of the JSON."""
    found = only_json(khop("test", name, "--json"))
    assert found["ok"]
    assert found["environment"] == "walkers"
    assert [check["name"] for check in found["checks"]] == list(CHECKS)


def test_a_failed_check_is_the_exit_status(folder):
    result = khop("test", "my_env:broken", status=1)
    assert "FAILED   episode_end" in result.stdout
    found = json.loads(khop("test", "my_env.py:broken", "--json", status=1).stdout)
    assert not found["ok"]
    khop("test", "my_env:broken", "--skip", "episode_end,other_seed")


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("consensus_v1",), "no environment 'consensus_v1'; did you mean 'consensus_v0'? And no module 'consensus_v1'"),
        (("consensus_v0", "--scenario", "papr"), "no scenario 'papr'; did you mean 'paper'?"),
        (("my_env:parallel_env", "--scenario", "paper"), "--scenario is for environments that khop list names"),
        (("my_env:failing",), "my_env:failing raised RuntimeError: no such fleet (my_env.py, line 14, in failing)"),
        (("my_env:walkers",), "expected a PettingZoo ParallelEnv, or a function that returns one; got module"),
        (("my_env:broken", "--skip", "spaecs"), "no check 'spaecs'; did you mean 'spaces'?"),
        (("my_env.py:parallel", "--json"), "my_env.py has no 'parallel'; it has "),
    ],
)
def test_mistakes_are_told_in_one_line(arguments, message, folder):
    assert message in refused("test", *arguments)
