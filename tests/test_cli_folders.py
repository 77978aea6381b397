"""Folders of runs: named after what was run, and never overwritten by another run."""

import json
import sys

import pytest
from test_cli import khop, only_json, refused

from khop_env.commands.folders import digest, folder_name
from khop_env.registry import scenario

pytestmark = pytest.mark.usefixtures("without_figures")

SHORT = ("--duration", "0.05")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


@pytest.mark.parametrize(
    ("arguments", "name"),
    [
        (("paper",), "paper-tanh-estimate-seed0"),
        (("paper", "--observe", "local", "--seed", "4"), "paper-tanh-local-seed4"),
        (("paper", "--controller", "linear:gain=2"), "paper-linear-estimate-seed0"),
        (("paper", "--integrator", "explicit", "--dt", "1e-4"), "paper-tanh-estimate-explicit-seed0"),
        (("consensus_v0", "--controller", "zero"), "consensus_v0-paper-zero-estimate-seed0"),
        (("random_geometric:agents=12",), "random_geometric_agents_12_k_2_seed_0-tanh-estimate-seed0"),
    ],
)
def test_names(arguments, name, folder):
    khop("run", *arguments, *SHORT)
    assert [path.name for path in (folder / "runs").iterdir()] == [name]


def test_the_same_run_takes_its_place_and_others_get_a_number(folder):
    first = only_json(khop("run", "paper", *SHORT, "--json"))
    again = khop("run", "paper", *SHORT, "--json")
    assert again.stderr == ""
    assert only_json(again)["files"] == first["files"]
    longer = khop("run", "paper", "--duration", "0.1")
    assert (
        "khop: runs/paper-tanh-estimate-seed0 holds another run (duration is 0.05 there and 0.1 here)" in longer.stderr
    )
    assert "the files go to runs/paper-tanh-estimate-seed0-2" in longer.stderr
    assert "figure: runs/paper-tanh-estimate-seed0-2/figure.png" in longer.stdout
    kept = json.loads((folder / "runs" / "paper-tanh-estimate-seed0" / "summary.json").read_text())
    assert kept["duration"] == 0.05
    khop("run", "paper", *SHORT, "--controller", "tanh:gain=3")
    assert len(list((folder / "runs").iterdir())) == 3
    khop("run", "paper", "--duration", "0.1")  # the second one's
    assert len(list((folder / "runs").iterdir())) == 3


def test_an_edited_scenario_is_another_run(folder):
    text = khop("export", "paper").stdout
    for number, radius in enumerate(("1.5", "1.4")):
        (folder / "mine.toml").write_text(text.replace("initial_radius = 1.5", f"initial_radius = {radius}"))
        khop("run", "mine.toml", *SHORT)
        assert len(list((folder / "runs").iterdir())) == number + 1


POLICY = """
import numpy as np

class Mine:
    def reset(self, env, seeds):
        self.sizes = env.action_sizes

    def act(self, observations):
        return {agent: np.full(size, VALUE, np.float32) for agent, size in self.sizes.items()}
"""


def test_an_edited_policy_is_another_run(folder):
    for value, folders in (("0.1", 1), ("0.1", 1), ("0.2", 2)):
        sys.modules.pop("mine_policy", None)  # each command is a process of its own
        (folder / "mine_policy.py").write_text(POLICY.replace("VALUE", value))
        khop("run", "paper", "--controller", "mine_policy.py:Mine", *SHORT)
        assert len(list((folder / "runs").iterdir())) == folders
    sys.modules.pop("mine_policy")


def test_a_folder_of_the_users_own_is_left_alone_if_another_run_is_there(folder):
    khop("run", "paper", *SHORT, "--out", "out")
    before = (folder / "out" / "summary.json").read_bytes()
    said = refused("run", "paper", *SHORT, "--out", "out", "--seed", "1")
    assert (
        said
        == "khop: --out out: another run is there (seed is 0 there and 1 here); choose another folder, or delete it"
    )
    assert (folder / "out" / "summary.json").read_bytes() == before
    khop("run", "paper", *SHORT, "--out", "out")
    for text, why in (('{"seed": 0}', "of an earlier version"), ("{", "its summary.json can't be read")):
        (folder / "out" / "summary.json").write_text(text)
        assert f"another run is there ({why})" in refused("run", "paper", *SHORT, "--out", "out")


def test_iss(folder):
    arguments = ("iss", "paper", "--episodes", "1", "--duration", "0.2")
    first = only_json(khop(*arguments, "--json"))
    assert first["files"]["swept"] == "runs/iss/paper-tanh-seed0/swept.csv"
    assert first["position_unit"] == "m"
    assert khop(*arguments).stderr == ""
    other = khop(*arguments[:-1], "0.3")
    assert "runs/iss/paper-tanh-seed0 holds another run (duration is 0.2 there and 0.3 here" in other.stderr
    assert "swept: runs/iss/paper-tanh-seed0-2/swept.csv" in other.stdout


def test_names_of_anything():
    assert folder_name("..", "a: b", ".hidden") == "scenario-a_b-hidden"
    long = folder_name("x" * 300, "y" * 300)
    assert len(long) == 121
    assert folder_name("x" * 299, "y" * 300) != long


def test_a_digest_changes_with_every_part():
    paper = scenario("paper")
    assert digest(paper) == digest(scenario("paper"))
    changed = [paper.replace(radius=1.4), paper.replace(k=4), paper.replace(relay=False), paper.replace(dt=0.02)]
    assert len({digest(each) for each in (paper, *changed)}) == 5
