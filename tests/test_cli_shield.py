"""--shield of `khop run` and `khop evaluate`, as their users call it."""

import pytest
from test_cli import khop, only_json, refused

pytestmark = pytest.mark.usefixtures("without_figures")

FILE = """
import networkx as nx
import numpy as np

from khop_env.observers import Exponential, TargetObservers
from khop_env.physics import SingleIntegrator
from khop_env.scenarios import Scenario
from khop_env.tasks import Column, Consensus

row = Scenario(
    name="row",
    description="three in a row",
    models=(SingleIntegrator(),) * 3,
    communication=nx.path_graph(3),
    task=nx.path_graph(3),
    k=2,
    delta=Exponential(1.0, 0.1, 5.0),
    observers=(TargetObservers(input_observer=False),) * 3,
    center=np.array([0.0, 0.0, 1.0, 0.0, 2.0, 0.0]),
    radius=0.1,
    network="wifi",
    estimator="relay",
).sized()


class Bodies(Consensus):
    def columns(self, world, agent):
        return [Column("radius", "m", 0.0, 1.0, 0.2)]
"""


@pytest.fixture(scope="module")
def file(tmp_path_factory):
    """One for all tests: a process imports a file by name once."""
    path = tmp_path_factory.mktemp("shield") / "rows_of_bodies.py"
    path.write_text(FILE)
    return path


@pytest.fixture
def folder(file, monkeypatch):
    monkeypatch.chdir(file.parent)


PLAYED = ("rows_of_bodies.py:Bodies", "--scenario", "rows_of_bodies.py:row")


def test_bounds_are_switched_on_for_the_filter_that_needs_them(folder):
    """And the controller's name says which filter it was in."""
    options = "--controller", "linear:gain=0.5", "--duration", "4", "--json"
    found = only_json(khop("run", *PLAYED, *options, "--shield", "certified"))
    assert found["controller"] == "filter:linear:gain=0.5"
    assert found["configuration"]["settings"]["bounds"] is True
    plain = only_json(khop("run", *PLAYED, *options))
    assert plain["configuration"]["settings"]["bounds"] is False
    assert plain["final_consensus_error"] < 0.9 * found["final_consensus_error"]  # nobody can be where another is


def test_every_policy_of_an_evaluation_is_shielded(folder):
    """By the option, or one by one by name."""
    options = "--episodes", "2", "--observe", "estimate", "--env", "max_cycles=20", "--json"
    found = only_json(khop("evaluate", *PLAYED, "--policies", "linear:gain=1,zero", "--shield", "0.1", *options))
    assert [row["policy"] for row in found["rows"]] == ["filter:margin=0.1:linear:gain=1", "filter:margin=0.1:zero"]
    found = only_json(
        khop("evaluate", *PLAYED, "--policies", "zero,filter:margin=none,gamma=0.5:linear:gain=1", *options)
    )
    assert [row["policy"] for row in found["rows"]] == ["zero", "filter:margin=none,gamma=0.5:linear:gain=1"]


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (("run", *PLAYED, "--shield", "safe"), "--shield: margin must be 'certified', 'none' or a number of metres"),
        (
            ("run", "rows_of_bodies.py:row", "--shield", "certified"),
            "observations of consensus_v0 have no column 'radius'",
        ),
        (("run", "mixed_fleet", "--shield", "none"), "the safety filter can't hold 'vessel_0'"),
        (("evaluate", *PLAYED, "--policies", "filter:margin=none:"), "expected filter:OPTION=VALUE,...:POLICY"),
        (("run", *PLAYED, "--shield", "certified", "--env", "bounds=false"), "with bounds=True"),
        (("train", *PLAYED, "--shield", "safe"), "margin must be 'certified', 'none' or a number of metres"),
        (("train", *PLAYED, "--shield", "certified,gama=1"), "no option 'gama'; did you mean 'gamma'?"),
        (("run", *PLAYED, "--shield", "certified,gama=1"), "--shield: 'certified,gama=1': no option 'gama'; did you"),
        (
            ("evaluate", *PLAYED, "--policies", "zero,filter:tanh", "--shield", "0.3"),
            "--shield 0.3: 'filter:tanh' is in a safety filter already: leave one of them out",
        ),
        (
            ("evaluate", *PLAYED, "--policies", "filter:announce=true:zero", "--network", "none"),
            "announce=true sends anchors in messages, and without a network there are none",
        ),
        (
            ("run", *PLAYED, "--shield", "certified,announce=true", "--network", "none"),
            "announce=true sends anchors in messages, and without a network there are none",
        ),
        (
            ("train", *PLAYED, "--shield", "certified,announce=true", "--network", "none"),
            "announce=true sends anchors in messages, and without a network there are none",
        ),
        (("train", *PLAYED, "--from", "nowhere"), "can't begin from nowhere: no policy file nowhere"),
    ],
)
def test_what_is_wrong_is_named(folder, arguments, message):
    """In one paragraph."""
    assert message in refused(*arguments)
