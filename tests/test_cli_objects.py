"""Python objects where names go, arguments of environments, and environments that are run."""

import json
import sys

import pytest
from test_cli import khop, only_json, refused

from agents import compare
from khop_env import registry

pytestmark = pytest.mark.usefixtures("without_figures")

FILE = """
from dataclasses import dataclass

import numpy as np

from khop_env.scenarios import LawChoice, paper
from khop_env.tasks import Consensus

scenario = paper().replace(name="mine")


def make():
    return scenario


def bad():
    return paper().replace(law=LawChoice("tan"))


def failing():
    raise RuntimeError("no such fleet")


@dataclass(eq=False, kw_only=True)
class MyTask(Consensus):
    goal: float = 1.0
    names: tuple[str, ...] = ()


class MyPolicy:
    def reset(self, env, seeds):
        self.sizes, self.count = env.action_sizes, 0

    def act(self, observations):
        self.count += 1
        return {a: np.full((*o.shape[:-1], self.sizes[a]), 0.1, np.float32) for a, o in observations.items()}


class Failing(MyPolicy):
    def act(self, observations):
        found = super().act(observations)
        return found if self.count < 5 else 1 / 0


class Unread(MyPolicy):
    def act(self, observations):
        self.layout.columns("slot0.positon")

    def reset(self, env, seeds):
        super().reset(env, seeds)
        self.layout = env.layouts[env.agents[0]]


class Misshapen(MyPolicy):
    def act(self, observations):
        return [0.0]
"""
MODELS_FILE = """
import networkx as nx
import numpy as np

from khop_env.physics import SingleIntegrator
from khop_env.observers import Exponential
from khop_env.scenarios import Scenario


class Rover(SingleIntegrator):
    type = "rover"

    def drift(self, t, x):
        return %s



def scenario():
    return Scenario(
        name="rovers",
        description="",
        models=(Rover(input_limit=1.0),) * 3,
        communication=nx.path_graph(3),
        task=nx.path_graph(3),
        k=2,
        delta=Exponential(1.0, 0.1, 2.0),
        theta=Exponential(1.0, 1.0, 2.0),
        radius=1.0,
    ).sized()
"""
TINY = ("--timesteps", "64", "--num-envs", "2", "--set", "n_steps=4", "--set", "batch_size=8", "--set", "evaluations=1")
SHORT = {
    "check": (),
    "export": (),
    "run": ("--duration", "0.05"),
    "iss": ("--episodes", "1", "--duration", "0.2"),
    "evaluate": ("--episodes", "2", "--policies", "zero", "--env", "max_cycles=3"),
    "train": TINY,
    "tune": ("--policies", "tanh", "--observe", "local", "--env", "max_cycles=2"),
    "test": ("--steps", "5"),
}


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    monkeypatch.setattr(sys, "path", [*sys.path])
    (tmp_path / "my_file.py").write_text(FILE)
    yield tmp_path
    sys.modules.pop("my_file", None)


@pytest.mark.parametrize("command", SHORT)
@pytest.mark.parametrize("name", ["my_file.py:scenario", "my_file:make"])
def test_a_scenario_by_object(command, name, folder):
    of_environment = ("consensus_v0", "--scenario") if command in ("evaluate", "train", "tune", "test") else ()
    found = khop(command, *of_environment, name, *SHORT[command])
    assert "mine" in found.stdout or command in ("test", "train")


@pytest.mark.parametrize("command", SHORT)
@pytest.mark.parametrize(
    ("name", "said"),
    [
        ("my_file.py:bad", "my_file.py:bad: law: no law 'tan'; did you mean 'tanh'?"),
        (
            "my_file.py:failing",
            "my_file.py:failing raised RuntimeError: no such fleet (my_file.py, line 21, in failing)",
        ),
        ("my_file.py:MyPolicy", "my_file.py:MyPolicy should be a Scenario or a function that returns one"),
        ("my_file.py:mak", "my_file.py has no 'mak'; it has "),
    ],
)
def test_a_wrong_scenario_by_object(command, name, said, folder):
    of_environment = ("consensus_v0", "--scenario") if command in ("evaluate", "train", "tune", "test") else ()
    result = khop(command, *of_environment, name, *SHORT[command], status=2)
    assert f"khop: {said}" in result.stderr
    assert len(result.stderr.splitlines()) == 1
    assert sorted(path.name for path in folder.iterdir() if path.name != "__pycache__") == ["my_file.py"]


@pytest.mark.parametrize("command", ["evaluate", "train", "tune", "run", "test"])
def test_a_task_by_object(command, folder):
    goal = () if command == "test" else ("--env", "goal=2", "--env", "names=a+b")
    found = khop(command, "my_file.py:MyTask", *SHORT[command], *goal).stdout
    assert "my_task_v0" in found or "my_task" in found
    said = khop(command, "my_file.py:scenario", *SHORT[command], status=0 if command == "run" else 2).stderr
    assert "Traceback" not in said


def test_policies_by_object(folder):
    arguments = ("--env", "max_cycles=4", "--observe", "local", "--episodes", "30")
    names = ("--policies", "my_file.py:MyPolicy,zero")
    alone = only_json(khop("evaluate", "my_file.py:MyTask", *names, *arguments, "--json"))
    assert [row["policy"] for row in alone["rows"]] == ["my_file.py:MyPolicy", "zero"]
    assert alone["rows"][0]["effort"] == pytest.approx(2 * 0.1**2, rel=1e-6)
    assert only_json(khop("evaluate", "my_file.py:MyTask", *names, *arguments, "--json", "--workers", "2")) == alone


class TestArguments:
    def test_they_reach_every_episode(self, folder):
        texts = {"control_period": "0.1", "reward": "team", "max_cycles": "5", "leaders": "drifter_0+drifter_3"}
        options = [part for name, text in texts.items() for part in ("--env", f"{name}={text}")]
        ours = only_json(
            khop("evaluate", "leader_following_v0", "--episodes", "3", "--policies", "tanh", *options, "--json")
        )
        values = {"control_period": 0.1, "reward": "team", "max_cycles": 5, "leaders": ["drifter_0", "drifter_3"]}
        theirs = compare(
            "leader_following_v0", ["tanh"], ["estimate", "oracle", "local"], seeds=range(3), arguments=values
        )
        assert ours == json.loads(json.dumps(theirs.summary()))
        plain = compare("leader_following_v0", ["tanh"], ["estimate"], seeds=range(3))
        assert plain.summary()["rows"][0]["mean_return"] != ours["rows"][0]["mean_return"]

    @pytest.mark.parametrize("command", ["evaluate", "train", "tune", "run"])
    @pytest.mark.parametrize(
        ("text", "said"),
        [
            ("contol_period=1", "--env contol_period=1: no argument 'contol_period'; did you mean 'control_period'?"),
            ("control_period=fast", "--env control_period: expected a number; got 'fast'"),
            ("control_period", "--env takes NAME=VALUE; got 'control_period'"),
            ("reward=tem", "--env reward: expected 'agent' or 'team'; got 'tem'; did you mean 'team'?"),
            ("uniform=yes", "--env uniform: expected true or false; got 'yes'"),
            ("max_cycles=2.5", "--env max_cycles: expected an integer or none; got '2.5'"),
            ("observe=local", "--env observe: this command sets it by --observe"),
            ("dt=-1", "dt must be a positive, finite number of at most 1e30; got -1.0"),
            ("spacing=2", "--env spacing=2: no argument 'spacing'; known: "),
        ],
    )
    def test_wrong_ones(self, command, text, said, folder):
        assert f"khop: {said}" in khop(command, "consensus_v0", "--env", text, status=2).stderr
        assert sorted(path.name for path in folder.iterdir()) == ["my_file.py"]

    def test_twice(self, folder):
        assert refused("evaluate", "consensus_v0", "--env", "order=1", "--env", "order=2") == (
            "khop: --env sets 'order' twice"
        )

    def test_a_scenario_takes_none(self, folder):
        assert "--env is for environments; paper is a scenario" in refused("run", "paper", "--env", "order=2")


class TestRun:
    @pytest.mark.parametrize("controller", ["tanh", "linear:gain=2", "zero", "random", "ppo:pretrained"])
    def test_an_environment_is_played_as_evaluate_plays_it(self, controller, folder):
        arguments = ("--env", "max_cycles=20", "--env", "reward=team", "--seed", "7")
        names = ("leader_following_v0", "--scenario", "convoy")
        ours = only_json(khop("run", *names, "--controller", controller, *arguments, "--json"))
        theirs = only_json(
            khop(
                "evaluate",
                *names,
                "--policies",
                controller,
                "--observe",
                "estimate",
                "--episodes",
                "1",
                *arguments,
                "--json",
            )
        )["rows"][0]
        assert ours["environment"] == "leader_following_v0"
        assert ours["task_error_unit"] == "m"
        assert ours["return"] == pytest.approx(theirs["mean_return"], rel=1e-5)
        assert ours["final_task_error"] == pytest.approx(theirs["final_task_error"], rel=1e-5)
        assert ours["max_error_to_bound"] == pytest.approx(theirs["max_error_to_bound"], rel=1e-5)
        assert (ours["steps"], ours["dt"], ours["duration"]) == (20, 0.05, pytest.approx(1.0))

    @pytest.mark.parametrize(
        ("scenario", "controller", "environment"),
        [
            ("paper", "zero", "consensus_v0"),
            ("random_geometric:agents=12", "random", "consensus_v0"),
            ("mixed_fleet", "ppo:pretrained", "leader_following_v0"),
            ("swap:agents=4", "filter", "navigation_v0"),
            ("my_file.py:scenario", "my_file.py:MyPolicy", "consensus_v0"),
        ],
    )
    def test_a_policy_on_a_scenario_says_its_environment(self, scenario, controller, environment, folder):
        result = khop("run", scenario, "--controller", controller, "--duration", "0.1")
        assert f"khop: {controller} acts in {environment} (khop run ENV --scenario {scenario}" in result.stderr
        assert f"{environment}: return " in result.stdout
        assert "task error at the end" in result.stdout
        assert "consensus error" not in result.stdout

    def test_a_scenario_under_a_law_has_a_consensus_error(self, folder):
        found = " ".join(khop("run", "paper", "--duration", "0.1").stdout.split())
        assert (
            "consensus error at the end: 2.635 m (|Pi p|: distance of all positions together from their mean)" in found
        )
        assert "task error" not in found

    def test_its_film_shows_the_task_error(self, folder, monkeypatch):
        from khop_env.env.rendering.panel import Panel

        labels = []
        draw = Panel.draw

        def drawn(self, canvas, scene, *others):
            labels.append((self._error_label, self._error_unit, scene.task_error))
            draw(self, canvas, scene, *others)

        monkeypatch.setattr(Panel, "draw", drawn)
        options = ("--controller", "zero", "--duration", "0.2", "--video", "film.gif", "--json")
        found = only_json(khop("run", "formation_v0", *options))
        assert labels[-1] == ("task error", "m", pytest.approx(found["final_task_error"]))
        labels.clear()
        found = only_json(khop("run", "paper", *options[2:]))
        assert labels[-1] == ("consensus error", "m", pytest.approx(found["final_consensus_error"]))

    def test_a_task_that_ends_the_episode(self, folder):
        options = ("--controller", "tanh", "--env", "success_radius=1.5", "--json")
        found = only_json(khop("run", "consensus_v0", *options))
        assert found["terminated"] is True
        assert found["final_task_error"] < 1.5
        assert 0.0 < found["duration"] < 2.0
        assert found["funnel_kept"] is True
        shown = khop("run", "consensus_v0", *options[:-1]).stdout
        assert "the task ended the episode, at t = " in shown

    @pytest.mark.parametrize(
        ("controller", "said", "steps"),
        [
            ("Failing", "raised ZeroDivisionError: division by zero (my_file.py, line ", 4),
            ("Misshapen", "raised TypeError: step() takes a mapping with an action for each agent", 0),
        ],
    )
    def test_a_policy_that_fails_loses_nothing(self, controller, said, steps, folder):
        name = f"my_file.py:{controller}"
        result = khop("run", "consensus_v0", "--controller", name, "--duration", "1", "--out", "out", status=2)
        assert f"khop: policy '{name}' {said}" in result.stderr
        assert "guarantee kept" in result.stdout
        assert "the episode stopped early" in result.stdout
        assert json.loads((folder / "out" / "summary.json").read_text())["steps"] == steps
        assert len(list((folder / "out").iterdir())) == 4

    @pytest.mark.parametrize(
        ("arguments", "said"),
        [
            (("paper", "--scenario", "convoy"), "--scenario is for environments, and 'paper' isn't one; known: "),
            (("consensus_v1", "--scenario", "paper"), "'consensus_v1' isn't one; did you mean 'consensus_v0'?"),
            (("consensus_v0", "--dt", "0.01"), "--dt: a policy acts in its environment, which chooses its own steps"),
            (("consensus_v0", "--integrator", "explicit"), "--integrator: a policy acts in its environment"),
            (("consensus_v0", "--duration", "-1"), "duration must be positive"),
            (("consensus_v0", "--duration", "1", "--env", "max_cycles=3"), "--env max_cycles: this command sets it by"),
            (("consensus_v0", "--controller", "ppo:pretrained", "--scenario", "convoy"), "no pretrained policy for"),
        ],
    )
    def test_refusals(self, arguments, said, folder):
        assert said in refused("run", *arguments)
        assert sorted(path.name for path in folder.iterdir()) == ["my_file.py"]


def test_units_come_from_the_model(folder, monkeypatch):
    """Angles are in rad in tables, figures, frames and observations."""
    from dataclasses import dataclass
    from types import MappingProxyType

    import numpy as np
    from matplotlib.axes import Axes

    from khop_env.physics import SingleIntegrator
    from khop_env.results import paper_figure

    monkeypatch.setattr("khop_env.results.writing.paper_figure", paper_figure)

    @dataclass(frozen=True, eq=False)
    class Joint(SingleIntegrator):
        states = property(lambda self: MappingProxyType({"angle": "rad", "lift": "m"}))
        position = property(lambda self: ("angle", "lift"))
        inputs = property(lambda self: MappingProxyType({"turn": "rad/s", "rise": "m/s"}))

    scenario = registry.scenario("random_geometric:agents=12").replace(name="joints", models=(Joint(),) * 12)
    monkeypatch.setitem(registry.SCENARIOS, "joints", lambda: scenario)
    labels = []
    for axis in ("set_xlabel", "set_ylabel"):
        plain = getattr(Axes, axis)
        monkeypatch.setattr(Axes, axis, lambda self, text, plain=plain: (labels.append(text), plain(self, text))[1])
    found = khop("run", "joints", "--duration", "0.1").stdout
    assert " rad or m (|Pi p|" in " ".join(found.split())
    assert {"first coordinate (rad)", "second coordinate (m)"} <= set(labels)
    shown = khop("evaluate", "consensus_v0", "--scenario", "joints", "--episodes", "1", "--policies", "zero").stdout
    assert "(rad or" in shown
    env = registry.make("consensus_v0", scenario)
    layout = env.layout("integrator_0")
    units = {field.name: field.unit for field in layout.fields}
    assert (units["slot0.position.x"], units["slot0.position.y"]) == ("rad", "m")
    assert (units["slot0.displacement.x"], units["slot0.displacement.y"]) == ("rad", "m")
    assert np.isfinite(env.reset(seed=0)[0]["integrator_0"]).all()


@pytest.mark.parametrize("drift", ["np.stack([x[2], x[3]], axis=-1)", "np.stack([x[..., 0], x[..., 1]], axis=0)"])
@pytest.mark.parametrize("command", ["check", "run", "iss"])
def test_a_model_with_a_wrong_drift_is_refused_before_anything_runs(folder, monkeypatch, command, drift):
    monkeypatch.delitem(sys.modules, "rovers", raising=False)
    (folder / "rovers.py").write_text(MODELS_FILE % drift)
    assert "Rover.drift(t, x) " in refused(command, "rovers.py:scenario", *SHORT[command])


def test_a_model_that_stops_a_run_is_named_in_one_line(folder, monkeypatch):
    monkeypatch.delitem(sys.modules, "rovers", raising=False)
    (folder / "rovers.py").write_text(MODELS_FILE % "0.0 * x")
    said = refused("run", "rovers.py:scenario", *SHORT["run"])
    assert said.startswith("khop: no velocity controller for agents of type 'rover'")


class TestAnErrorOfAPolicyNamesItAndItsLine:
    WHY = "'drifter_0' has no field 'slot0.positon'; did you mean 'slot0.position'?"

    @pytest.mark.parametrize("workers", ["1", "2"])
    def test_in_a_comparison(self, folder, workers):
        arguments = "--episodes", "1", "--observe", "local", "--env", "max_cycles=3", "--workers", workers
        said = khop(
            "evaluate", "consensus_v0", "--policies", "zero,my_file.py:Unread", *arguments, status=2
        ).stderr.splitlines()[-1]
        assert said.startswith(f"khop: policy 'my_file.py:Unread' raised KeyError: {self.WHY}")
        assert ("(my_file.py, line " in said) == (workers == "1")  # a traceback doesn't come from other processes

    def test_in_a_run(self, folder):
        options = "--controller", "my_file.py:Unread", "--duration", "0.2"
        said = khop("run", "consensus_v0", *options, status=2).stderr
        assert f"khop: policy 'my_file.py:Unread' raised KeyError: {self.WHY} (my_file.py, line " in said


def test_what_is_played_by_default_on_a_task_without_edges(folder, monkeypatch):
    monkeypatch.delitem(sys.modules, "free", raising=False)
    (folder / "free.py").write_text(
        "import numpy as np\nfrom khop_env import Outcome, Task\n\n\nclass Free(Task):\n"
        "    def evaluate(self, world):\n        error = np.zeros((world.num_envs, len(world.fleet)))\n"
        "        return Outcome(error, np.zeros(world.num_envs, bool), {'task_error': error})\n"
    )
    options = "--episodes", "1", "--observe", "local", "--env", "max_cycles=3", "--json"
    result = khop("evaluate", "free.py:Free", *options)
    assert [row["policy"] for row in only_json(result)["rows"]] == ["zero", "random"]
    assert "khop: free_v0 has no task edges, along which laws act: zero and random play" in result.stderr
    found = only_json(khop("evaluate", "my_file.py:MyTask", *options))["rows"]
    assert [row["policy"] for row in found] == ["tanh", "linear", "zero", "random"]
