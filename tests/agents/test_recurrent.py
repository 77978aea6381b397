"""Recurrent policies: their memory in play, in training, in checkpoints and in files."""

import dataclasses
import json
import sys

import numpy as np
import pytest
import torch
from sb3_contrib.common.recurrent.policies import RecurrentActorCriticPolicy
from typer.testing import CliRunner

from agents import describe, play
from agents.learning import LearnedPolicy, PolicyFileError, TrainingConfig
from agents.learning.archive import read_arrays, write_arrays
from agents.learning.curve import EVALUATION_SEEDS
from agents.learning.environment import build
from agents.learning.recurrent import RecurrentPolicy
from agents.learning.training import _Run, train
from agents.policy import by_agent
from khop_env.cli import app
from khop_env.network import Network
from tests.agents.training import resumed_as_uninterrupted
from tests.deploy.test_policies import test_lockstep_equals_the_environment as lockstep

torch.set_num_threads(1)  # as `train` does
TINY = {"num_envs": 4, "timesteps": 1500, "evaluations": 2, "batch_size": 64, "hidden": (16, 12)}
LOSSY = "lossy:loss=0.3,burst=5"


def config(environment="leader_following_v0", cycles=25, **settings):
    arguments = {"max_cycles": cycles, "network": LOSSY}
    return TrainingConfig(environment, **{"policy": "recurrent", **TINY, "arguments": arguments, **settings})


def strong(chosen):
    """A run whose policy hasn't been trained, but chooses actions that depend on its memory."""
    run = _Run(chosen, None, None, None)
    with torch.no_grad():
        run.algorithm.policy.action_net.weight.mul_(50.0)
        run.algorithm.policy.lstm_actor.weight_hh_l0.mul_(3.0)
    run.policy = run._exported()
    return run


def acted(policy, env, observations):
    return np.stack(list(policy.act(by_agent(env, observations)).values()), axis=1)


@pytest.mark.parametrize("hidden", [(16, 12), (12,), (16, 8, 12)])
def test_it_acts_like_the_model_over_an_episode(hidden, tmp_path):
    """NumPy against sb3-contrib's prediction, over 150 steps, and memory matters all the time."""
    chosen = config(cycles=150, hidden=hidden)
    run = strong(chosen)
    run.policy.save(tmp_path / "policy.npz")
    policy, forgetful = (LearnedPolicy.load(tmp_path / "policy.npz") for _ in range(2))
    env = build(chosen, 3)
    observations, _ = env.reset(0)
    for each in (policy, forgetful):
        each.reset(describe(env), range(3))
    before, state, rows = None, None, 3 * len(env.agents)
    missing, spread = [], []
    for cycle in range(150):
        features = run.learner.scaler(observations.reshape(rows, -1), before)
        begins = np.full(rows, cycle == 0)
        expected, state = run.algorithm.predict(features, state, begins, deterministic=True)
        found = acted(policy, env, observations)
        np.testing.assert_allclose(found.reshape(rows, -1), np.clip(expected, -1.0, 1.0), rtol=0.0, atol=1e-6)
        forgetful._memories = {}
        missing.append(np.abs(acted(forgetful, env, observations) - found).mean())
        spread.append(np.abs(found).mean())
        before = observations.reshape(rows, -1)
        observations, *_ = env.step(found)
    assert missing[0] == 0.0
    assert min(missing[1:]) > 0.01
    assert 0.05 < np.mean(spread) < 0.95


@pytest.mark.parametrize(
    ("environment", "settings"),
    [("leader_following_v0", {}), ("consensus_v0", {"residual": "tanh"}), ("navigation_v0", {"nearest": True})],
)
def test_an_episode_that_begins_in_a_batch_is_new_to_it(environment, settings):
    """Each environment's actions are those of a policy of its own, reset when its episode began."""
    chosen = config(environment, **settings)
    whole = strong(chosen).policy
    fields = {each.name: getattr(whole, each.name) for each in dataclasses.fields(whole) if each.init}
    alone, saved = [LearnedPolicy(**fields) for _ in range(3)], LearnedPolicy(**fields)
    env = build(chosen, 3)
    for policy in (whole, saved, *alone):
        policy.reset(describe(env), range(3))
    observations, _ = env.reset(0)
    for cycle in range(12):
        saved.set_state(whole.get_state())
        rows = acted(whole, env, observations)
        np.testing.assert_array_equal(acted(saved, env, observations), rows)
        for number, policy in enumerate(alone):
            own = policy.act({agent: observations[number, i] for i, agent in enumerate(env.agents)})
            np.testing.assert_allclose(rows[number], np.stack(list(own.values())), rtol=0.0, atol=1e-6)
        observations, *_ = env.step(rows)
        if cycle in (3, 7):
            ended = np.array([cycle % 3])
            observations, _ = env.reset(env_ids=ended)
            whole.begin(3, ended)
            alone[cycle % 3].begin(1, np.array([0]))
    whole.begin(3)
    alone[0].reset(describe(env), range(3))
    np.testing.assert_array_equal(acted(whole, env, observations), acted(alone[0], env, observations))


def test_the_lstm_in_training_is_that_of_sb3_contrib():
    """Outputs and memory, with episodes that begin anywhere in the sequences, and gradients."""
    torch.manual_seed(0)
    lstm = torch.nn.LSTM(5, 7)
    for share in (0.0, 0.2, 1.0):
        features = torch.randn(4 * 9, 5)
        memory = torch.randn(1, 4, 7), torch.randn(1, 4, 7)
        starts = (torch.rand(4 * 9) < share).float()
        found = []
        for policy in (RecurrentPolicy, RecurrentActorCriticPolicy):
            lstm.zero_grad()
            outputs, states = policy._process_sequence(features, memory, starts, lstm)
            outputs.square().sum().backward()
            found.append([outputs, *states, *(parameter.grad.clone() for parameter in lstm.parameters())])
        for ours, theirs in zip(*found, strict=True):
            torch.testing.assert_close(ours, theirs, rtol=1e-5, atol=1e-6)


def test_exploration_ends_on_schedule():
    """As with PPO."""
    run = _Run(config(timesteps=600, log_std=0.0, log_std_end=-2.0, explore=0.5), None, None, None)
    run.learn()
    assert run.algorithm.policy.log_std.max() < -1.0
    assert run.algorithm.ent_coef < 0.01


@pytest.mark.parametrize(
    ("environment", "settings"),
    [
        ("leader_following_v0", {"residual": "leader_following", "n_steps": 7}),
        ("navigation_v0", {"shield": "certified", "arguments": {"max_cycles": 15, "network": LOSSY}}),
    ],
)
def test_resumed_it_goes_on_as_if_nothing_had_happened(environment, settings, tmp_path):
    chosen = config(environment, **settings)
    whole, last = resumed_as_uninterrupted(chosen, tmp_path)
    assert set(last.networks[""].arrays()) >= {"lstm/from_inputs", "lstm/from_before", "lstm/bias"}
    if chosen.shield is None:  # the last evaluation begins without any memory
        again = play(build(chosen, len(EVALUATION_SEEDS)), last, EVALUATION_SEEDS)
        assert again.returns.mean() == whole.curve[-1].mean_return


def test_it_begins_from_another_run(tmp_path):
    """Its folder or its file; not from networks of another kind."""
    chosen = config(timesteps=200, evaluations=1)
    train(chosen, tmp_path / "run")
    last = LearnedPolicy.load(tmp_path / "run" / "last.npz").networks[""].arrays()
    for source in ("run", "run/last.npz"):
        begun = _Run(dataclasses.replace(chosen, initial=str(tmp_path / source), seed=3), None, None, None)
        taken = begun.policy.networks[""].arrays()
        assert all(np.array_equal(taken[name], last[name]) for name in last)
    with pytest.raises(ValueError, match="it was trained with policy = 'recurrent', and this run has policy = 'mlp'"):
        _Run(dataclasses.replace(chosen, policy="mlp", initial=str(tmp_path / "run")), None, None, None)


@pytest.mark.parametrize(
    ("name", "change", "said"),
    [
        ("/lstm/bias", lambda array: array[:-4], r"/lstm/bias has shape \(44,\); expected \(48,\)"),
        ("/lstm/from_before", lambda array: array.T.copy(), r"/lstm/from_before has shape \(12, 48\)"),
        ("/lstm/from_inputs", lambda array: array * np.nan, "/lstm/from_inputs isn't finite"),
        ("/1/weight", lambda array: array[:, :-1], r"/lstm/from_inputs has shape \(48, 16\); expected \(44, 16\)"),
        ("/lstm/from_inputs", None, "it has no '/lstm/from_inputs'"),
    ],
)
def test_crafted_files_are_refused(name, change, said, tmp_path):
    path = tmp_path / "policy.npz"
    _Run(config(), None, None, None).policy.save(path)
    arrays = read_arrays(path, 2**24)
    array = arrays.pop(name)
    write_arrays(path, arrays if change is None else {**arrays, name: change(array)}, compress=True)
    with pytest.raises(PolicyFileError, match=rf"policy\.npz isn't a policy that khop train wrote \({said}"):
        LearnedPolicy.load(path)


@pytest.mark.parametrize("settings", [{"algorithm": "sac"}, {"per_type": True}])
def test_what_it_does_not_go_with_is_refused(settings):
    with pytest.raises(ValueError, match="policy 'recurrent' is trained by 'ppo', one network for all agents, without"):
        config(**settings)


def test_without_sb3_contrib_everything_else_is_there(tmp_path, monkeypatch):
    """A policy that was trained plays; training says what to install before there is a folder."""
    _Run(config(), None, None, None).policy.save(tmp_path / "policy.npz")
    monkeypatch.setitem(sys.modules, "sb3_contrib", None)
    env = build(config(), 2)
    assert np.isfinite(play(env, LearnedPolicy.load(tmp_path / "policy.npz"), [0, 1]).returns).all()
    assert train(config(policy="mlp", timesteps=100, evaluations=1)).finished
    with pytest.raises(ModuleNotFoundError, match=r"trained with sb3_contrib: in a clone .*-e '\.\[rl\]'"):
        train(config(), tmp_path / "run")
    assert not (tmp_path / "run").exists()


def test_the_commands_train_and_play_it(tmp_path):
    out = str(tmp_path / "run")
    settings = ("--timesteps", "200", "--num-envs", "2", "--set", "hidden=8+8", "--set", "evaluations=1")
    short = ("--env", "max_cycles=20", "--network", LOSSY)
    khop = CliRunner().invoke
    trained = khop(app, ["train", "leader_following_v0", "--policy", "recurrent", *settings, *short, "--out", out])
    assert trained.exit_code == 0, trained.stderr
    arguments = ["leader_following_v0", "--policies", f"ppo:{out}", "--episodes", "3", *short, "--json"]
    found = khop(app, ["evaluate", *arguments])
    assert found.exit_code == 0, found.stderr
    assert np.isfinite(json.loads(found.stdout)["rows"][0]["mean_return"])
    run = ["run", "convoy", "--controller", f"ppo:{out}", "--network", LOSSY, "--out", str(tmp_path / "played")]
    assert khop(app, run).exit_code == 0


def test_processes_play_it(tmp_path, monkeypatch):
    """One agent's process, which knows no other's observations, acts as the agent does in the environment."""
    chosen = config("navigation_v0", scenario="swap:agents=4", residual="go_to_goal", arguments={"network": LOSSY})
    strong(chosen).policy.save(tmp_path / "policy.npz")
    spec = f"filter:ppo:{tmp_path / 'policy.npz'}"
    lockstep("swap:agents=4", spec, Network(0.05, loss=0.3, burst=5.0), tmp_path, monkeypatch)
