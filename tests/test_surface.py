"""The public surface: names of `khop_env`, signatures, and what a type checker finds in a user's file."""

import dataclasses
import importlib
import inspect
import os
import pydoc
import shutil
import subprocess
import sys
import tomllib
import typing
import venv
from pathlib import Path
from site import getsitepackages as site_packages

import numpy as np
import pytest

import khop_env
from agents import compare, describe
from khop_env import consensus_v0, formation_v0, leader_following_v0, navigation_v0
from khop_env.catalog import ENVIRONMENTS
from khop_env.env import Settings, SettingsArguments
from khop_env.physics import Sinusoid
from khop_env.results import record
from khop_env.tasks import (
    Consensus,
    EdgeArguments,
    EdgeTask,
    Formation,
    LeaderFollowing,
    Navigation,
    NavigationArguments,
)

ROOT = Path(__file__).parents[1]
USER_FILE = '''
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

import khop_env
from agents import EnvDescription, evaluate, make_law, make_policy
from khop_env import AgentModel, Column, EdgeTask, Exponential, Outcome, Scenario, Sinusoid, Task, World, consensus_v0

Array = NDArray[np.float64]


class Buoy(AgentModel):
    """Drifts with the current."""

    type = "buoy"
    states = {"x": "m", "y": "m"}
    inputs = {"vx": "m/s", "vy": "m/s"}
    position = ("x", "y")
    input_limit = 2.0

    def drift(self, t: Array, x: Array) -> Array:
        return -0.1 * x

    def input_map(self, t: Array, x: Array, u: Array) -> Array:
        return u


class Gather(Task):
    """Gather at the origin."""

    def columns(self, world: World, agent: int) -> Sequence[Column]:
        return [Column("agents", "", 0.0, 100.0, float(len(world.fleet)))]

    def evaluate(self, world: World) -> Outcome:
        error = np.linalg.norm(world.positions(), axis=1).T
        return Outcome(-error, np.zeros(world.num_envs, bool), {"task_error": error})


class Still:
    """Does nothing."""

    def reset(self, env: EnvDescription, seeds: Sequence[int]) -> None:
        self.sizes = env.action_sizes

    def act(self, observations: Mapping[str, Any]) -> dict[str, NDArray[Any]]:
        return {agent: np.zeros((*seen.shape[:-1], self.sizes[agent])) for agent, seen in observations.items()}


paper = khop_env.scenario("paper")
khop_env.VELOCITY_CONTROLLERS["buoy"] = lambda model, x, velocity: velocity
bounds = Exponential(20.0, 1.0, 1.0)
scenario: Scenario = paper.replace(models=(Buoy(),) * 8, delta=bounds, theta=bounds, disturbance=Sinusoid(0.1)).sized()
simulator = scenario.build(law=make_law("tanh"), observers=khop_env.Proximal(1), num_envs=2)
simulator.reset(seed=0)
simulator.step(0.05)
env = consensus_v0.parallel_env(scenario, observe="oracle", max_cycles=20, effort=0.2)
observations, infos = env.reset(seed=0)
vec = khop_env.make_vec(Gather, num_envs=2, scenario=scenario, max_cycles=20)
rows, _ = vec.reset(seed=0)
team = khop_env.make_batched(Gather, scenario, num_envs=2)
frame = evaluate(team, {"still": Still(), "zero": make_policy("zero")}, range(2))
print(frame["return"].mean(), rows.shape, len(observations))
'''
WRONG = {  # what a checker has to find, and part of what it says: otherwise the file above would be clean for nothing
    "khop_env.Scenaro": '"Scenaro"',
    'khop_env.consensus_v0.parallel_env(observe="estimated")': '"observe"',
    "khop_env.consensus_v0.parallel_env(max_cycle=3)": '"max_cycle"',
    'khop_env.leader_following_v0.env(spacing="wide")': '"spacing"',
    "khop_env.make_vec(3)": '"make_vec"',
}


def test_dir_shows_the_names_of_the_surface_and_nothing_else():
    assert dir(khop_env) == sorted(khop_env.__all__)
    importlib.import_module("khop_env.results")
    assert "results" not in dir(khop_env)


@pytest.mark.parametrize("name", khop_env.__all__)
def test_every_name_is_the_object_that_it_names(name):
    """In a process of its own nothing else has imported it; and it isn't a module of the same name by accident."""
    found = getattr(khop_env, name)
    assert inspect.ismodule(found) == (name in ENVIRONMENTS)
    if inspect.isclass(found) or inspect.isfunction(found):
        assert found.__name__ == name
        assert getattr(importlib.import_module(found.__module__), name) is found


def test_a_checker_s_imports_are_the_names():
    tree = importlib.import_module("ast").parse(inspect.getsource(khop_env))
    imported = [
        alias.name
        for node in tree.body
        if getattr(getattr(node, "test", None), "id", "") == "TYPE_CHECKING"
        for line in node.body
        for alias in line.names
    ]
    assert sorted([*imported, "__version__"]) == sorted(khop_env.__all__)


def test_names_that_there_are_not():
    with pytest.raises(AttributeError, match="no attribute 'scenaria'"):
        khop_env.scenaria  # noqa: B018


def test_scenarios_is_the_package_and_its_names_are_functions():
    import khop_env.scenarios

    assert inspect.ismodule(khop_env.scenarios)
    code = "import khop_env; khop_env.make; from khop_env.scenarios import convoy; assert convoy().name == 'convoy'"
    subprocess.run([sys.executable, "-c", code], check=True)


def test_one_name_imports_no_more_than_it_needs():
    code = "import sys, khop_env; khop_env.AgentModel; print(*sys.modules)"
    loaded = subprocess.run([sys.executable, "-c", code], check=True, capture_output=True, text=True).stdout.split()
    assert "khop_env.physics" in loaded
    assert not {"khop_env.observers", "khop_env.env", "matplotlib", "polars"} & set(loaded)


# -- arguments -----------------------------------------------------------------------------------------------------


def typed(arguments):
    """Names and types of a TypedDict, which has no defaults."""
    assert not arguments.__required_keys__
    return typing.get_type_hints(arguments)


def fields(cls):
    hints = typing.get_type_hints(cls)
    return {field.name: hints[field.name] for field in dataclasses.fields(cls)}


@pytest.mark.parametrize(
    ("arguments", "cls"),
    [
        (SettingsArguments, Settings),
        (EdgeArguments, EdgeTask),
        (consensus_v0.Arguments, (Settings, Consensus)),
        (formation_v0.Arguments, (Settings, Formation)),
        (leader_following_v0.Arguments, (Settings, LeaderFollowing)),
        (NavigationArguments, Navigation),
        (navigation_v0.Arguments, (Settings, Navigation)),
    ],
)
def test_typed_dictionaries_equal_the_dataclasses(arguments, cls):
    several = cls if isinstance(cls, tuple) else (cls,)
    assert typed(arguments) == {name: hint for each in several for name, hint in fields(each).items()}


@pytest.mark.parametrize("module", [consensus_v0, formation_v0, leader_following_v0, navigation_v0])
@pytest.mark.parametrize("name", ["parallel_env", "env", "batched_env"])
def test_signatures_show_every_argument_with_its_type_in_few_words(module, name):
    function = getattr(module, name)
    parameters = inspect.signature(function).parameters
    expected = {"scenario", "num_envs" if name == "batched_env" else "render_mode", *typed(module.Arguments)}
    assert set(parameters) == expected
    for parameter in parameters.values():
        assert parameter.default is not parameter.empty
        assert not isinstance(parameter.annotation, str)  # which would be printed in quotes
        assert len(str(parameter)) < 120
    help_text = pydoc.plain(pydoc.render_doc(function))
    for parameter in parameters.values():
        line = next(n for n, line in enumerate(help_text.splitlines()) if line.strip() == str(parameter))
        assert len(help_text.splitlines()[line + 1].strip()) > 5
    assert "_array_like" not in help_text  # NumPy's ArrayLike is a line of private names


# -- what is printed of an object ----------------------------------------------------------------------------------


def printed():
    """Objects of the surface, and those that hold arrays, with parts of what they say."""
    scenario = khop_env.scenario("random_geometric:agents=200").replace(disturbance=Sinusoid(0.1))
    simulator = khop_env.scenario("mixed_fleet").build(num_envs=300)
    simulator.reset(seed=0, env_ids=[1])
    simulator.step(0.25)
    simulator.reset(seed=0, env_ids=[1])
    views = []
    run = khop_env.scenario("paper").build(law=lambda t, view: views.append(view) or np.zeros((1, 16)))
    batched = khop_env.make_batched("leader_following_v0", num_envs=300)
    comparison = compare("consensus_v0", ["zero"], ["estimate"], seeds=range(2))
    consensus = "consensus_v0 on 'paper': 8 drifter; k=3"
    design, vec = scenario.design, khop_env.make_vec("consensus_v0", 2, autoreset_mode="same_step")
    return [
        (scenario, "Scenario('random_geometric:agents=200,k=2,seed=0': 200 integrator; k=2, ", "law 'tanh', 10 s in"),
        (design, "ObserverDesign(200 integrator; k=2, ", f"{design.states.layout.pairs} state and "),
        (design.states, "Funnels(layout=PairLayout("),
        (design.links, "Links(agents=200, sender=int64["),
        (scenario.initial, "InitialSet(center=float64[400], radius=float64[400]"),
        (simulator, "Simulator(3 integrator, 3 cart, 3 unicycle, 3 vessel; k=3", "num_envs=300, t = 0 to 0.25 s)"),
        (simulator, "Proximal(order=2, threads=1), no law"),
        (simulator.save(), "SimulatorState(t=float64[300], x=float64["),
        (run, "law <lambda>, num_envs=1, t = 0.1 s"),
        (views[0], "View(fleet=Fleet(8 drifter), x=float64[1, 16]"),
        (record(run, 0.1, 0.01), "Recording(8 drifter; k=3, ", "11 samples of 10 steps to t = 0.1 s"),
        (
            batched,
            "BatchedEnv(leader_following_v0 on 'convoy', of which 5 act: 8 drifter; k=3",
            "num_envs=300, t = 0 s",
        ),
        (batched.world, "World(design=ObserverDesign(8 drifter"),
        (batched.get_state(), "EnvState(simulator=SimulatorState("),
        (khop_env.make("consensus_v0", observe="oracle"), f"KHopEnv({consensus}", "observe='oracle', num_envs=1"),
        (
            vec,
            f"KHopVectorEnv(16 rows, autoreset same_step; {consensus}",
            "num_envs=2",
        ),
        (khop_env.make_joint("consensus_v0"), f"JointEnv({consensus}"),
        (describe(batched), "EnvDescription(environment='leader_following_v0', scenario='convoy'"),
        (comparison, "Comparison(environment='consensus_v0', scenario='paper', planned=2"),
        (comparison.rows[0].episodes, "Episodes(seed=int64[2]"),
    ]


def test_objects_say_in_a_line_what_they_are():
    for found, *parts in printed():
        text = repr(found)
        assert "\n" not in text
        assert len(text) < 400, text
        for part in parts:
            assert part in text


def test_the_sb3_environment_says_what_it_is():
    pytest.importorskip("stable_baselines3")
    text = repr(khop_env.make_sb3_vec("formation_v0", 2))
    assert text.startswith("KHopSB3VecEnv(16 rows; formation_v0 on 'paper': 8 drifter; k=3, ")


# -- type checkers -------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def installed(tmp_path_factory):
    """A folder with what the wheel holds, as it would be installed."""
    folder = tmp_path_factory.mktemp("site")
    packages = tomllib.loads((ROOT / "pyproject.toml").read_text())["tool"]["hatch"]["build"]["targets"]["wheel"]
    for package in packages["packages"]:
        shutil.copytree(ROOT / package, folder / package, ignore=shutil.ignore_patterns("__pycache__"))
    return folder


@pytest.fixture(scope="module")
def python(installed):
    """An interpreter with our packages as installed ones, and with everything else that this one has."""
    folder = installed / "environment"
    venv.create(folder, with_pip=False)
    site = next(folder.glob("[lL]ib*/**/site-packages"))
    others = [path for path in site_packages() if Path(path).is_dir()]
    (site / "found.pth").write_text("\n".join([str(installed), *others]))
    return next(folder.glob("[bS]*/python*"))


UNUSED = "torch", "stable_baselines3", "numba", "gymnasium.wrappers", "hypothesis", "PIL", "pydantic", "pygame", "rich"


def complaints(text, python, folder):
    """Mypy's lines on a user's file, strict; libraries whose types aren't in it would take most of the time."""
    (folder / "mine.py").write_text(text)
    unused = ",".join(f"mypy-{name}.*" for name in UNUSED)
    (folder / "mypy.ini").write_text(f"[mypy]\n[{unused}]\nfollow_imports = skip\n")
    cache = python.parents[1] / "cache"
    command = ["-m", "mypy", "--strict", "--python-executable", str(python), "--cache-dir", str(cache), "mine.py"]
    environment = {name: value for name, value in os.environ.items() if name not in ("PYTHONPATH", "MYPYPATH")}
    done = subprocess.run([sys.executable, *command], cwd=folder, env=environment, capture_output=True, text=True)
    assert not done.stderr
    return [line for line in done.stdout.splitlines() if " error: " in line]


def test_a_user_s_file_is_clean_for_a_strict_type_checker_and_runs(python, tmp_path):
    pytest.importorskip("mypy", reason="the dev extra has it")
    assert complaints(USER_FILE, python, tmp_path) == []
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}  # where compiled kernels are kept
    subprocess.run([sys.executable, "mine.py"], cwd=tmp_path, check=True, env=environment)
    found = complaints("import khop_env\n" + "".join(f"{line}\n" for line in WRONG), python, tmp_path)
    assert len(found) == len(WRONG), found
    for number, (line, part) in enumerate(zip(found, WRONG.values(), strict=True)):
        assert line.startswith(f"mine.py:{number + 2}: error: ")
        assert part in line
