"""A task of a user's own works wherever a built-in one does, without a line of the library."""

import functools
import pydoc
import runpy
from pathlib import Path

import numpy as np
import pytest
from stable_baselines3 import PPO

import khop_env
from agents import evaluate, make_policy
from agents.comparison import compare
from agents.evaluation import play
from agents.learning import TrainingConfig
from agents.learning.training import train
from khop_env.registry import make_aec, make_batched, make_joint
from khop_env.tasks.base import directed
from khop_env.testing import check_environment

ROOT = Path(__file__).parents[2]
EXAMPLE = ROOT / "examples" / "06_your_own_task.py"
OWN = runpy.run_path(str(EXAMPLE))
KeepApart, GoToGoal = OWN["KeepApart"], OWN["GoToGoal"]
NAME = f"{EXAMPLE}:KeepApart"


def test_no_file_of_the_library_knows_it():
    """The example is the one file that the task touches."""
    library = [*(ROOT / "khop_env").rglob("*.py"), *(ROOT / "agents").rglob("*.py")]
    touched = [path for path in library if "KeepApart" in (text := path.read_text()) or "keep_apart" in text]
    assert len(library) > 100
    assert touched == []


@pytest.mark.parametrize("scenario", ["paper", "mixed_fleet"])
def test_it_keeps_the_contract(scenario):
    """Spaces, seeds, copies, pickles, vector rows, leaks, and the checks of PettingZoo, Gymnasium and SB3."""
    report = check_environment(functools.partial(khop_env.make, NAME, scenario, max_cycles=40), steps=60)
    report.raise_if_failed()
    assert {check.status for check in report.checks} == {"passed"}


def test_observations_rewards_and_infos_are_the_task_s():
    env = make_batched(KeepApart(radius=0.8, penalty=2.0), "paper", num_envs=3)
    observations, _ = env.reset(seed=1)
    observations, reward, terminated, _, infos = env.step(np.zeros((3, 8, 2)))
    positions, goal = env.world.positions(), env.task.memory["goal"]
    columns = env.layouts[2].columns("goal")
    np.testing.assert_allclose(observations[:, 2, columns], (goal[2] - positions[2]).T, atol=1e-6)
    np.testing.assert_allclose(infos["task_error"], np.linalg.norm(goal - positions, axis=1).T)
    np.testing.assert_allclose(reward, -0.05 * (infos["task_error"] + 2.0 * infos["too_close"]))
    assert not terminated.any()
    assert len({goal[0, 0, b] for b in range(3)}) == 3  # drawn for each episode


def test_its_memory_is_saved_and_restored():
    env = make_batched(KeepApart(), "paper", num_envs=2)
    env.reset(seed=0)
    saved = env.get_state()
    first = env.step(np.zeros((2, 8, 2)))
    env.reset(seed=5)
    env.set_state(saved)
    again = env.step(np.zeros((2, 8, 2)))
    for ours, theirs in zip(first[:4], again[:4], strict=True):
        np.testing.assert_array_equal(ours, theirs)


def changed(**parts):
    """A task that returns another outcome, by part."""

    class Wrong(KeepApart):
        def evaluate(self, world):
            outcome = super().evaluate(world)
            return outcome._replace(**{name: change(getattr(outcome, name)) for name, change in parts.items()})

    return Wrong


@pytest.mark.parametrize(
    ("parts", "message"),
    [
        ({"reward": np.transpose}, r"reward must be an array of shape \(1, 8\), .*; got shape \(8, 1\) of float64"),
        ({"reward": lambda _: 0.0}, r"reward must be an array of shape \(1, 8\), .*; got 0\.0"),
        ({"terminated": lambda _: False}, r"terminated must be an array of 1 bools, .*; got False"),
        ({"terminated": lambda old: 1.0 * old}, r"terminated must .*; got shape \(1,\) of float64"),
        ({"infos": lambda old: {"too_close": old["too_close"]}}, "infos must have 'task_error', .* got 'too_close'"),
        ({"infos": lambda old: old | {"more": np.zeros(8)}}, r"the info more must be .* got shape \(8,\)"),
        ({"infos": lambda old: list(old)}, r"must return Outcome\(reward, terminated, infos\), infos by name; got"),
    ],
)
def test_a_wrong_outcome_is_named(parts, message):
    env = khop_env.make(changed(**parts), "paper")
    with pytest.raises(ValueError, match=rf"Wrong\.evaluate\(\).*{message}"):
        env.reset(seed=0)


def test_a_later_outcome_is_checked_as_well():
    """Every step's, not the first one's alone."""
    task = KeepApart()
    env = make_batched(task, "paper", num_envs=2)
    env.reset(seed=0)
    env.step(np.zeros((2, 8, 2)))
    right = env.task.evaluate(env.world)
    for wrong, message in (
        (right._replace(reward=right.reward[0]), r"reward must be an array of shape \(2, 8\).*got shape \(8,\)"),
        (right._replace(terminated=right.terminated.astype(int)), "terminated must be an array of 2 bools"),
        (right._replace(infos={"cost": right.reward}), "infos must have 'task_error'"),
        (right._replace(infos={**right.infos, "extra": [0.0]}), "the info extra must be an array"),
    ):
        env.task.evaluate = lambda world, wrong=wrong: wrong
        with pytest.raises(ValueError, match=message):
            env.step(np.zeros((2, 8, 2)))


def test_columns_need_a_writer_and_names_of_their_own():
    class Silent(KeepApart):
        observe = khop_env.Task.observe

    class Twice(KeepApart):
        def columns(self, world, agent):
            return [*super().columns(world, agent), khop_env.Column("own.x1", "m", -1.0, 1.0)]

    with pytest.raises(ValueError, match=r"'silent' has columns with a row, and no observe\(world, out\)"):
        khop_env.make(Silent, "paper")
    with pytest.raises(ValueError, match=r"'twice': the observation of 'drifter_0' has two columns 'own\.x1'"):
        khop_env.make(Twice, "paper")


def test_a_task_without_memory_needs_none():
    class Plain(KeepApart):
        def bind(self, world):
            """Nothing to prepare, and no call of the method above."""

        reset = khop_env.Task.reset
        columns = khop_env.Task.columns

        def evaluate(self, world):
            distance = np.linalg.norm(world.positions(), axis=1).T
            return khop_env.Outcome(-distance, np.zeros(world.num_envs, bool), {"task_error": distance})

    env = khop_env.make(Plain, "paper")
    env.reset(seed=0)
    assert env.get_state().task == {}


def test_every_kind_of_environment():
    """Parallel, AEC, vector, SB3, joint; a frame that shows the goals."""
    aec = make_aec(KeepApart, "paper")
    aec.reset(seed=0)
    assert aec.last()[0].shape == aec.observation_space(aec.agent_selection).shape
    vec = khop_env.make_vec(KeepApart, num_envs=2, radius=0.3)
    assert vec.reset(seed=0)[0].shape == (16, vec.single_observation_space.shape[0])
    assert make_joint(KeepApart).reset(seed=0)[0].ndim == 1
    sb3 = khop_env.make_sb3_vec(KeepApart, num_envs=2, max_cycles=10)
    PPO("MlpPolicy", sb3, n_steps=16, batch_size=64, seed=0, device="cpu").learn(256)
    frames = []
    for task in (KeepApart, "consensus_v0"):
        env = khop_env.make(task, "paper", render_mode="rgb_array")
        env.reset(seed=0)
        frames.append(env.render())
    assert (frames[0] != frames[1]).any(axis=-1).sum() > 100


def test_evaluation_and_training():
    """By object, by class and by name; a policy that knows the task beats doing nothing."""
    env = make_batched(KeepApart(), "paper", num_envs=4, max_cycles=60)
    frame = evaluate(env, {"own": GoToGoal(), "idle": make_policy("zero")}, seeds=range(4))
    means = {name: rows["return"].mean() for (name,), rows in frame.group_by("policy")}
    assert means["own"] > 0.3 * means["idle"]
    table = compare(NAME, ["zero", f"{EXAMPLE}:GoToGoal"], seeds=range(2), arguments={"max_cycles": 20})
    assert table.environment == "keep_apart_v0"
    assert [row.policy for row in table.rows] == ["zero", f"{EXAMPLE}:GoToGoal"]
    trained = train(TrainingConfig(KeepApart(), timesteps=2000, num_envs=2, evaluations=1))
    assert trained.policy.environment == "keep_apart_v0"
    assert np.isfinite(trained.curve[-1].mean_return)


def test_its_help_is_about_tasks():
    """Not about the arrays of NumPy that a task begins with."""
    said = pydoc.render_doc(khop_env.Task, renderer=pydoc.plaintext)
    assert "ndarray" not in said
    assert "multidimensional" not in said


def test_mistakes_are_refused():
    class Uneven(KeepApart):
        def columns(self, world, agent):
            return super().columns(world, agent)[: 1 + agent % 2]

    with pytest.raises(ValueError, match=r"task 'uneven': uniform observations need as many columns for every agent"):
        make_batched(Uneven(), "paper")
    with pytest.raises(TypeError, match=r"expected an environment's name or a Task; got 3"):
        make_batched(3)
    with pytest.raises(TypeError, match=r"got an unexpected keyword argument 'radios'; did you mean 'radius'"):
        make_batched(KeepApart, radios=1.0)


class Meet(khop_env.Task):
    """Edges of its own, from the task graph, and no columns in its slots."""

    extra: tuple[str, ...] = ()

    def bind(self, world):
        super().bind(world)
        self.edges = directed(world.graph)

    def slot_columns(self, world, agent, other):
        return [khop_env.Column(name, "m", -9.0, 9.0, 0.5) for name in self.extra]

    def evaluate(self, world):
        error = np.zeros((world.num_envs, len(world.fleet)))
        return khop_env.Outcome(error, np.zeros(world.num_envs, bool), {"task_error": error})


def effort(law, task):
    env = make_batched(task, "paper", num_envs=2, max_cycles=20)
    return play(env, make_policy(law), range(2)).effort


# all parameters, since some are tuned for consensus
@pytest.mark.parametrize(
    "law", ["tanh:gain=2", "linear:gain=2", "formation:gain=2,speed=3", "leader_following:gain=3,shrink=0.9"]
)
def test_laws_take_a_displacement_that_the_slots_lack_as_zero(law):
    np.testing.assert_array_equal(effort(law, Meet), effort(law, "consensus_v0"))
    assert effort(law, Meet).all()


def test_laws_take_a_displacement_that_the_slots_have():
    class Apart(Meet):
        extra = ("displacement.x", "displacement.y")

    assert (effort("linear:gain=2", Apart) != effort("linear:gain=2", Meet)).all()


def test_a_displacement_of_another_size_is_refused():
    class Odd(Meet):
        extra = ("displacement.x",)

    with pytest.raises(ValueError, match=r"'slot0.displacement' .* 2 columns; 'drifter_0' has 1: add as many"):
        effort("tanh", Odd)
