"""Other packages called `agents`: khop's processes have their own, environments need none, and nothing is silent."""

import os
import shutil
import subprocess
import sys
from pathlib import Path

import pytest

from khop_env.own_agents import FOLDER, _is_ours

ROOT = Path(__file__).parents[1]
FOREIGN = 'raise RuntimeError("another agents was run")\n'
WHERES = ["folder", "file", "path", "loaded", "overwritten"]


@pytest.fixture(scope="module", params=WHERES)
def python(request, tmp_path_factory):
    """Runs Python in a folder where another package `agents` would be found before ours."""
    folder, places = tmp_path_factory.mktemp(request.param), [ROOT]
    other = folder / "other"
    (other / "agents").mkdir(parents=True)
    (other / "agents" / "__init__.py").write_text("" if request.param == "loaded" else FOREIGN)
    if request.param == "folder":
        shutil.copytree(other / "agents", folder / "agents")
    elif request.param == "file":
        (folder / "agents.py").write_text(FOREIGN)
    elif request.param == "path":
        places = [other, ROOT]
    elif request.param == "loaded":
        (other / "sitecustomize.py").write_text("import agents\n")
        places = [other, ROOT]
    else:
        for package in ("khop_env", "agents"):
            shutil.copytree(ROOT / package, folder / "site" / package)
        shutil.copy(other / "agents" / "__init__.py", folder / "site" / "agents")
        places = [folder / "site"]
    environment = {**os.environ, "PYTHONPATH": os.pathsep.join(map(str, places))}

    def run(*arguments: str) -> subprocess.CompletedProcess:
        return subprocess.run([sys.executable, *arguments], cwd=folder, env=environment, capture_output=True, text=True)

    run.where = request.param
    return run


def test_ours_is_known_by_its_first_line(tmp_path):
    assert FOLDER == ROOT / "agents"
    assert _is_ours(FOLDER / "__init__.py")
    assert not _is_ours(tmp_path / "__init__.py")


def test_another_one_would_come_first(python):
    if python.where != "loaded":
        assert "another agents was run" in python("-c", "import agents").stderr
    else:
        assert "ImportError" in python("-c", "from agents import make_law").stderr


def test_commands_work_all_the_same(python):
    """Also where workers unpickle classes of ours; all commands find `agents` in the same way."""
    command = "evaluate consensus_v0 --policies tanh --observe estimate --episodes 30 --workers 2 --env max_cycles=9"
    done = python("-m", "khop_env", *command.split())
    assert done.returncode == 0, done.stderr
    assert done.stdout
    warned = "__init__.py isn't khop_env's: another package 'agents' has overwritten it" in done.stderr
    assert warned == (python.where == "overwritten")


def test_environments_simulators_and_scenarios_need_no_agents(python):
    code = (
        "import sys; before = sys.modules.get('agents'); from khop_env import consensus_v0, scenario, testing\n"
        "env = consensus_v0.parallel_env(); env.reset(seed=0); scenario('paper').build().step(0.01)\n"
        "assert sys.modules.get('agents') is before"
    )
    done = python("-c", code)
    assert done.returncode == 0, done.stderr


@pytest.mark.parametrize("python", ["folder"], indirect=True)
def test_what_a_user_s_file_wants_of_another_one_is_refused_in_one_line(python, tmp_path):
    (tmp_path / "mine.py").write_text("from agents.parts import Part\n")
    for name in ("agents.parts:Part", f"{tmp_path / 'mine.py'}:make"):
        done = python("-m", "khop_env", "test", name)
        assert done.returncode == 2
        assert f"no 'agents.parts': in khop's processes 'agents' is khop_env's own package, in {FOLDER}" in done.stderr
        assert done.stderr.count("\n") == 1


@pytest.mark.parametrize("python", ["overwritten"], indirect=True)
def test_a_module_of_ours_that_is_gone_is_named_in_one_line(python):
    code = "from khop_env.own_agents import FOLDER; (FOLDER / 'comparison.py').unlink(missing_ok=True)"
    assert python("-c", code).returncode == 0
    done = python("-m", "khop_env", "evaluate", "consensus_v0", "--policies", "zero", "--episodes", "2")
    assert done.returncode == 2
    assert "khop: no 'agents.comparison': in khop's processes" in done.stderr
    assert "Traceback" not in done.stderr
