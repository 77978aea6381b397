"""Residual learning: a network that adds to a script's actions."""

import dataclasses

import numpy as np
import pytest

from agents import make_policy, shielded
from agents.learning import LearnedPolicy, PolicyFileError, TrainingConfig
from agents.learning.checkpoint import read_checkpoint, restored, write_checkpoint
from agents.learning.environment import WHOLE, build, described, training_environment
from agents.learning.policy_file import read_policy, write_policy
from agents.learning.residual import Script
from agents.learning.training import _Run, train
from agents.policies import POLICIES
from agents.policy import by_agent, describe
from tests.agents.training import resumed_as_uninterrupted

TINY = {"num_envs": 4, "timesteps": 1500, "evaluations": 2, "batch_size": 128, "hidden": (16,)}
SHORT = {"max_cycles": 20}


def config(environment="leader_following_v0", residual="leader_following", **settings):
    return TrainingConfig(environment, residual=residual, **{**TINY, "arguments": SHORT, **settings})


def acts_alike(env, first, second, cycles=12):
    """Whether two policies act the same, bit for bit, in all environments of a batch along the first one's way."""
    observations, _ = env.reset(0)
    for policy in (first, second):
        policy.reset(describe(env), range(env.num_envs))
    for _ in range(cycles):
        seen = by_agent(env, observations)
        ours, theirs = (policy.act(seen) for policy in (first, second))
        if not all(np.array_equal(ours[agent], theirs[agent]) for agent in env.agents):
            return False
        observations, *_ = env.step(np.stack([ours[agent] for agent in env.agents], axis=1))
    return True


@pytest.mark.parametrize(
    ("environment", "scenario", "script", "settings"),
    [
        ("consensus_v0", "paper", "tanh", {}),
        ("consensus_v0", "mixed_fleet", "linear:gain=2", {"per_type": True}),
        ("consensus_v0", "mixed_fleet", "zero", {"algorithm": "sac"}),
        ("formation_v0", None, "formation", {"observe": "local"}),
        ("leader_following_v0", "convoy", "leader_following", {"observe": "oracle", "bounds": True}),
        ("leader_following_v0", "mixed_fleet", "leader_following", {"arguments": {"network": "wifi"}}),
        ("navigation_v0", None, "go_to_goal", {"algorithm": "sac"}),
        ("navigation_v0", None, "keep_right", {"shield": "none", "critic": "state"}),
        ("navigation_v0", None, "orca:horizon=1", {"nearest": True}),
        ("navigation_v0", None, "robust_barrier", {"bounds": True}),
    ],
)
def test_before_training_it_acts_as_its_script(environment, scenario, script, settings, tmp_path):
    """To the bit, from its file."""
    chosen = config(environment, script, scenario=scenario, **settings)
    run = _Run(chosen, None, None, None)
    run.policy.save(tmp_path / "policy.npz")
    learned = LearnedPolicy.load(tmp_path / "policy.npz")
    env, same, other = build(chosen, 3), make_policy(script), make_policy("random" if script == "zero" else "zero")
    if chosen.shield is not None:
        learned, same, other = (shielded(policy, chosen.shield) for policy in (learned, same, other))
    assert acts_alike(env, learned, same)
    assert not acts_alike(env, learned, other)


@pytest.mark.parametrize("changes", [{}, {"per_type": True}, {"algorithm": "sac"}], ids=["ppo", "per_type", "sac"])
def test_the_saved_policy_acts_like_script_and_model(changes, tmp_path):
    """NumPy's sum against that of Stable-Baselines3's prediction, which no longer is zero, and the script."""
    chosen = config("consensus_v0", "tanh", scenario="mixed_fleet", **changes)
    run = _Run(chosen, None, None, None)
    run.learn()
    run._exported().save(tmp_path / "policy.npz")
    learned, script = LearnedPolicy.load(tmp_path / "policy.npz"), make_policy("tanh")
    env = build(chosen, 5)
    rows = (len(env.agents) * 5, -1)
    observations, _ = env.reset(0)
    for policy in (learned, script):
        policy.reset(describe(env), range(5))
    before, corrections = None, []
    for _ in range(4):
        features = run.learner.scaler(observations.reshape(rows), before)
        added, _ = run.algorithm.predict(features, deterministic=True)
        seen = by_agent(env, observations)
        found, base = (np.stack(list(policy.act(seen).values()), axis=1) for policy in (learned, script))
        np.testing.assert_allclose(found.reshape(rows), np.clip(base.reshape(rows) + added, -1.0, 1.0), atol=1e-6)
        corrections.append(np.abs(added).max())
        before = observations.reshape(rows)
        observations, *_ = env.step(found)
    assert min(corrections) > 1e-3


def test_a_short_training_does_not_end_worse_than_its_script():
    """Within 10 % of its return, after its exploration has made it worse; the best policy is never worse there."""
    training = train(
        TrainingConfig("leader_following_v0", residual="leader_following", timesteps=120_000, evaluations=1)
    )
    script, last = (point.mean_return for point in training.curve)
    assert last > 1.1 * script  # negative
    assert training.curve[0].timesteps == 0
    assert training.policy.about["trained"] == (training.curve[1].timesteps if last > script else 0)


def test_the_learner_acts_on_top_of_the_script():
    """In the training environment its actions are added, and the sum is clipped; at most it reverses the script."""
    chosen = config()
    env = training_environment(chosen)
    env.reset()
    learner = env.venv
    assert (env.action_space.high == WHOLE).all()
    sent = []
    take, learner.venv.step_async = learner.venv.step_async, lambda actions: (sent.append(actions), take(actions))
    script = make_policy("leader_following")
    script.reset(describe(learner.batched), range(4))
    for added in (0.0, 0.25, -2.0, 2.0):
        seen = learner.before.reshape(4, len(learner.batched.agents), -1)
        acted = script.act({agent: seen[:, number] for number, agent in enumerate(learner.batched.agents)})
        own = np.stack(list(acted.values()), axis=1).reshape(env.num_envs, -1)
        env.step(np.full_like(own, added))
        np.testing.assert_array_equal(sent[-1], np.clip(own + np.float32(added), -1.0, 1.0))


def test_the_script_learns_of_ends_in_training():
    """Of those environments whose episodes have ended, staggered as they are."""
    env = training_environment(config("navigation_v0", "orca", arguments={"max_cycles": 8}))
    env.reset()
    learner, begun, ended = env.venv, [], []
    learner.script.begin = begun.append
    for _ in range(8):
        *_, done, _ = env.step(np.zeros((env.num_envs, 2), np.float32))
        if done.any():
            ended.append(np.unique(np.flatnonzero(done) // len(learner.batched.agents)).tolist())
    assert [ids.tolist() for ids in begun] == ended
    assert sorted(number for each in ended for number in each) == [0, 1, 2, 3]
    assert len(ended) == 4


@pytest.mark.parametrize("script", ["keep_right", "orca", "tanh"])
def test_a_checkpoint_has_what_a_script_remembers(script, tmp_path):
    """Agents that don't move are stuck: `keep_right` then draws detours."""
    chosen = config("consensus_v0" if script == "tanh" else "navigation_v0", script, arguments={"network": "wifi"})
    env = build(chosen, 2)
    rows = env.reset(0)[0].reshape(2 * len(env.agents), -1)
    first, second, other = (Script(script, describe(env), 2) for _ in range(3))
    for each, seed in ((first, 0), (second, 5), (other, 5)):
        each.reset(seed)
    for _ in range(25):
        first.act(rows)
    write_checkpoint(tmp_path / "state.npz", {"script": first.get_state()})
    second.set_state(restored(second.get_state(), read_checkpoint(tmp_path / "state.npz")["script"], "script"))
    ours, theirs, others = (np.stack([each.act(rows) for _ in range(30)]) for each in (first, second, other))
    np.testing.assert_array_equal(ours, theirs)
    assert script != "keep_right" or not np.array_equal(ours, others)
    assert script != "tanh" or first.get_state()["time"].tolist() == pytest.approx([55 * 0.05] * 2)


def test_sac_acts_within_the_limits_in_training():
    """Its actions are stretched to their space, so that with a wider one the saved policy would act otherwise."""
    env = training_environment(config("navigation_v0", None, algorithm="sac", saturation=0.5))
    assert (env.action_space.high == 1.0).all()


@pytest.mark.parametrize("script", ["keep_right", "orca", "tanh"])
def test_an_episode_that_begins_in_a_batch_is_new_to_the_script(script):
    """Each environment's actions are those of a script of its own, which was reset when its episode began."""
    environment = "consensus_v0" if script == "tanh" else "navigation_v0"
    chosen = config(environment, script, arguments={"network": "lossy:loss=0.3"})
    env = build(chosen, 3)
    whole = Script(script, describe(env), 3)
    whole.reset(0)
    alone = [make_policy(script) for _ in range(3)]
    for policy in alone:
        policy.reset(describe(env), [0])
    observations, _ = env.reset(0)
    for cycle in range(12):
        rows = whole.act(observations.reshape(3 * len(env.agents), -1)).reshape(3, len(env.agents), -1)
        for number, policy in enumerate(alone):
            acted = policy.act(_one(env, observations, number))
            np.testing.assert_allclose(rows[number], np.stack(list(acted.values())), atol=1e-6)
        observations, *_ = env.step(rows)
        if cycle in (4, 7):
            ended = np.array([cycle % 3])
            observations, _ = env.reset(env_ids=ended)
            whole.begin(ended)
            alone[cycle % 3].reset(describe(env), [0])
    if script == "keep_right":
        whole.begin(np.array([1]))
        state = whole.get_state()
        for agent in env.agents:
            assert [np.isnan(past[:, 0]).tolist() for past in state["past"][agent][-3:]] == [[False, True, False]] * 3
            assert state["left"][agent][1] == -1.0


def _one(env, observations, number):
    return {agent: observations[number, i] for i, agent in enumerate(env.agents)}


@pytest.mark.parametrize(
    ("environment", "script", "settings"),
    [
        ("leader_following_v0", "leader_following", {}),
        ("navigation_v0", "keep_right", {"shield": "certified"}),
        ("navigation_v0", "orca", {"arguments": {**SHORT, "network": "lossy:loss=0.3"}}),
    ],
)
def test_resumed_it_goes_on_as_if_nothing_had_happened(environment, script, settings, tmp_path):
    chosen = config(environment, script, **settings)
    resumed_as_uninterrupted(chosen, tmp_path)
    with pytest.raises(ValueError, match=r"residual = '.*' there and None here; resume with the same"):
        train(dataclasses.replace(chosen, residual=None), tmp_path / "cut", resume=True)


def test_other_tuned_parameters_are_another_run(tmp_path, monkeypatch):
    chosen = config()
    train(chosen, tmp_path)
    monkeypatch.setattr("agents.scripted.tuned_parameters", lambda *_: {"gain": 1.0})
    with pytest.raises(ValueError, match=r"another environment: script is .*gain=.* there and .*gain=1\.0"):
        train(chosen, tmp_path, resume=True)


def test_it_keeps_the_parameters_that_it_was_trained_with():
    """Tuned ones of the scenario and mode of the training, wherever it is played."""
    chosen = config("consensus_v0", "tanh", scenario="paper")
    learned = _Run(chosen, None, None, None).policy
    assert learned.about["residual"] == "tanh:gain=6.73"
    elsewhere = build(dataclasses.replace(chosen, observe="local"), 2)
    assert acts_alike(elsewhere, learned, make_policy("tanh:gain=6.73"))
    assert not acts_alike(elsewhere, learned, make_policy("tanh"))


@pytest.mark.parametrize(
    ("script", "said"),
    [
        ("leader_folowing", "no scripted policy 'leader_folowing' to learn on top of; did you mean 'leader_following'"),
        ("random", "no scripted policy 'random' to learn on top of"),
        ("ppo:pretrained", "no scripted policy 'ppo' to learn on top of; known: tanh"),
        ("mine.py:Policy", r"no scripted policy 'mine\.py' to learn on top of; known: tanh"),
        ("tanh:gian=2", "residual 'tanh:gian=2': .*did you mean 'gain'"),
        ("tanh:gain=-1", "residual 'tanh:gain=-1': .*gain must be positive"),
        ("robust_barrier", r"residual 'robust_barrier' reads the guaranteed bounds: .* bounds=True or --bounds"),
        (3, "residual must be the name of a scripted policy; got 3"),
    ],
)
def test_scripts_that_there_are_not(script, said):
    with pytest.raises(ValueError, match=said):
        config(residual=script)


@pytest.mark.parametrize(
    ("environment", "script", "said"),
    [
        ("navigation_v0", "tanh", "residual 'tanh': tanh acts along task edges, and agents of navigation_v0 have none"),
        ("consensus_v0", "keep_right", "residual 'keep_right': .* needs an environment with goals"),
    ],
)
def test_scripts_that_an_environment_does_not_suit(environment, script, said, tmp_path):
    with pytest.raises(ValueError, match=said):
        train(config(environment, script), tmp_path / "run")
    assert not (tmp_path / "run" / "config.toml").exists()


def test_networks_of_another_script_are_not_taken_on(tmp_path):
    chosen = config()
    train(chosen, tmp_path)
    begun = _Run(dataclasses.replace(chosen, initial=str(tmp_path), seed=3), None, None, None)
    last = LearnedPolicy.load(tmp_path / "last.npz")
    assert np.array_equal(begun.policy.networks[""].layers[-1][0], last.networks[""].layers[-1][0])
    assert np.abs(last.networks[""].layers[-1][0]).max() > 0.0
    for other in (None, "tanh"):
        with pytest.raises(ValueError, match=r"can't begin from .*: it was trained with residual = 'leader_following:"):
            _Run(dataclasses.replace(chosen, initial=str(tmp_path), residual=other), None, None, None)


def test_a_file_names_no_code(tmp_path, monkeypatch):
    """A policy's file may be from somebody else: it can't have other files run."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "evil.py").write_text("open('was-run', 'w').close()\nclass Policy: ...\n")
    _Run(config(), None, None, None).policy.save(tmp_path / "policy.npz")
    fields = read_policy(tmp_path / "policy.npz")
    for residual in ("evil.py:Policy", "evil:Policy", 5, "tanh:gain=evil"):
        write_policy(tmp_path / "spoilt.npz", {**fields, "about": {**fields["about"], "residual": residual}})
        with pytest.raises(PolicyFileError, match=r"spoilt\.npz can't be played: residual"):
            LearnedPolicy.load(tmp_path / "spoilt.npz")
    assert not (tmp_path / "was-run").exists()


def test_every_script_is_one_or_said_not_to_be():
    """So that a new one is thought of: whether it remembers anything, it may be learnt on top of."""
    goals = {"go_to_goal", "keep_right", "orca", "robust_barrier"}
    edges = {"tanh", "linear", "formation", "leader_following"}
    assert set(POLICIES) == goals | edges | {"zero", "random", "bang_bang"}
    for name in goals:
        chosen = config("navigation_v0", name, bounds=True)
        found = described(build(chosen, 1), chosen)
        assert (Script(name, found, 1).get_state() == {}) == (name == "go_to_goal")
