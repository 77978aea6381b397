import importlib
import inspect
import pkgutil
import re
import subprocess
import sys

import pytest

import khop_env
import khop_env.scenarios
from khop_env.registry import SCENARIOS, describe, make_sb3_vec, make_vec, scenario, scenarios
from khop_env.scenarios import Scenario
from khop_env.scenarios.files import ScenarioFileError, write_scenario


def test_the_registry_equals_the_files():
    found = set()
    for module in pkgutil.iter_modules(khop_env.scenarios.__path__):
        content = importlib.import_module(f"khop_env.scenarios.{module.name}")
        if callable(getattr(content, module.name, None)):
            found.add(module.name)
    assert set(SCENARIOS) == found
    assert set(SCENARIOS) == {"paper", "convoy", "mixed_fleet", "random_geometric", "swap", "crossing", "corridor"}
    assert scenarios() == tuple(SCENARIOS)


@pytest.mark.parametrize("name", scenarios())
def test_every_scenario_is_complete(name):
    made = scenario(name)
    assert isinstance(made, Scenario)
    assert made.name.partition(":")[0] == name
    again = scenario(made.name)  # a name says how to make it
    assert again.name == made.name
    assert set(again.task.edges) == set(made.task.edges)
    assert made.description
    assert "\n" not in made.description
    assert made.design.states.layout.pairs > 0


def test_descriptions_are_those_of_the_functions():
    """They are read from files, without importing them."""
    assert describe() == [
        {
            "name": name,
            "description": inspect.getdoc(factory).partition("\n")[0],
            "parameters": {key: each.default for key, each in inspect.signature(factory).parameters.items()},
        }
        for name, factory in SCENARIOS.items()
    ]
    assert all(each["description"] for each in describe())


def test_parameters_of_a_family():
    by_text = scenario("random_geometric:agents=12, k=3,seed=4")
    by_keyword = scenario("random_geometric", agents=12, k=3, seed=4)
    assert len(by_text.models) == 12
    assert by_text.k == 3
    assert by_text.communication.edges == by_keyword.communication.edges
    assert len(scenario("random_geometric:agents=12", agents=8).models) == 8  # keywords win
    assert len(scenario("random_geometric:").models) == 100


def test_a_file(tmp_path):
    path = tmp_path / "mine.toml"
    path.write_text(write_scenario(scenario("paper").replace(name="mine")))
    assert scenario(path).name == "mine"
    assert scenario(str(path)).name == "mine"


@pytest.mark.parametrize(
    ("name", "parameters", "said"),
    [
        ("papr", {}, "no scenario 'papr'; did you mean 'paper'?"),
        ("zzz", {}, "known: paper, convoy, mixed_fleet, random_geometric, swap, crossing, corridor"),
        ("random_geometric:agnts=3", {}, "no parameter 'agnts'; did you mean 'agents'?"),
        ("random_geometric", {"agnts": 3}, "no parameter 'agnts'; did you mean 'agents'?"),
        ("random_geometric:agents=many", {}, "agents must be of type int; got 'many'"),
        ("random_geometric:agents", {}, "expected parameter=value after the colon; got 'agents'"),
        ("random_geometric:agents=3", {}, "agents must be at least 4; got agents=3"),
        ("random_geometric:seed=-1", {}, "seed must be at least 0; got seed=-1"),
        ("mine.TOML", {}, "no scenario 'mine.TOML'; if it is a scenario file, rename it: such a name ends in .toml"),
        (__file__, {}, "should be a Scenario or a function that returns one, e.g. my_file.py:my_scenario; got module"),
        ("paper:k=2", {}, "scenario 'paper' has no parameter 'k'; it has none"),
        ("mine.toml", {"k": 2}, "a scenario file takes no parameters; got k"),
    ],
)
def test_refusals(name, parameters, said):
    with pytest.raises(ValueError, match=re.escape(said)):
        scenario(name, **parameters)


def test_a_missing_file():
    with pytest.raises(ScenarioFileError, match="can't be read"):
        scenario("nowhere.toml")


@pytest.mark.parametrize("make", [make_vec, make_sb3_vec])
def test_batches(make):
    """Misspelt arguments, and render modes of batches."""
    with pytest.raises(TypeError, match="got an unexpected keyword argument 'num_env'; did you mean 'num_envs'"):
        make("consensus_v0", num_env=3)
    with pytest.raises(TypeError, match="unexpected keyword argument 'render_mode': batches aren't rendered"):
        make("consensus_v0", render_mode="rgb_array")


def test_the_package_exports_lazily():
    assert khop_env.scenario is scenario
    assert set(khop_env.__all__) <= set(dir(khop_env))
    with pytest.raises(AttributeError, match="no attribute 'scenaria'"):
        khop_env.scenaria  # noqa: B018


def test_heavy_imports_wait():
    script = """
import sys
import khop_env
heavy = {"numba", "polars", "matplotlib", "rich", "typer", "tomlkit", "networkx"}
assert not heavy & set(sys.modules), heavy & set(sys.modules)
khop_env.scenario("paper")
import khop_env.results, khop_env.cli, khop_env.registry
late = {"polars", "matplotlib", "tomlkit"}
assert not late & set(sys.modules), late & set(sys.modules)
"""
    subprocess.run([sys.executable, "-c", script], check=True)
