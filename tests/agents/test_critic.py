"""A critic that sees the true global state in training, and the actor beside it, which doesn't."""

import dataclasses

import numpy as np
import pytest
import torch

from agents.learning import LearnedPolicy, TrainingConfig, networks, train
from agents.learning.archive import read_arrays
from agents.learning.checkpoint import read_checkpoint
from agents.learning.environment import build, training_environment
from agents.learning.networks import make_model
from agents.learning.run_folder import CHECKPOINT
from agents.learning.training import _Run
from agents.policy import by_agent, describe

torch.set_num_threads(1)  # as `train` does
TINY = {"num_envs": 3, "timesteps": 600, "evaluations": 2, "batch_size": 64, "hidden": (16,), "n_steps": 4}


def config(environment="consensus_v0", scenario="mixed_fleet", critic="state", **settings):
    arguments = {"max_cycles": 7, **settings.pop("arguments", {})}
    return TrainingConfig(environment, scenario, critic=critic, **{**TINY, "arguments": arguments, **settings})


def by_hand(batched, states):
    """Features (B * N, S) of states (B, S), column by column."""
    factors = {"m": 0.5, "m/s": 0.5}
    scaled = [
        [np.clip(value * factors.get(field.unit, 1.0), -10.0, 10.0)]
        for field, value in zip(batched.state_fields, states.T, strict=True)
    ]
    return np.repeat(np.concatenate(scaled).T, len(batched.agents), axis=0)


CASES = [
    ("consensus_v0", "mixed_fleet", {}),
    ("leader_following_v0", "convoy", {"observe": "local", "residual": "leader_following"}),
    ("leader_following_v0", "mixed_fleet", {"arguments": {"network": "wifi"}, "algorithm": "sac"}),
    ("navigation_v0", "crossing", {"shield": "none", "nearest": True}),
]


@pytest.mark.parametrize(("environment", "scenario", "settings"), CASES)
def test_rows_end_with_the_state_of_their_time(environment, scenario, settings):
    """Of the present, of the new episode where one has begun, and of the end in the terminal observation; the rest
    is as without it."""
    env, plain = (training_environment(config(environment, scenario, c, **settings)) for c in ("state", "local"))
    learner, batched, after = env.venv, env.venv.batched, []
    step = batched.step

    def recorded(*arguments):  # the environment resets in the same step
        result = step(*arguments)
        after.append(batched.state())
        return result

    batched.step = recorded
    for each in (env, plain):
        each.seed(0)
    rows, others = env.reset(), plain.reset()
    own, size = plain.observation_space.shape[0], len(batched.state_fields)
    assert rows.shape == (env.num_envs, own + size)
    rng, ends = np.random.default_rng(0), 0
    for _ in range(15):
        np.testing.assert_array_equal(rows[:, :own], others)
        np.testing.assert_allclose(rows[:, own:], by_hand(batched, batched.state()), atol=1e-5)
        actions = rng.uniform(-1.0, 1.0, (env.num_envs, *env.action_space.shape)).astype(np.float32)
        rows, _, dones, infos = env.step(actions)
        others, _, _, plain_infos = plain.step(actions)
        last = by_hand(batched, after[-1])
        for row in np.flatnonzero(dones):
            found = infos[row]["terminal_observation"]
            assert infos[row]["TimeLimit.truncated"]
            np.testing.assert_array_equal(found[:own], plain_infos[row]["terminal_observation"])
            np.testing.assert_allclose(found[own:], last[row], atol=1e-5)
            assert not np.allclose(found[own:], rows[row, own:])
            ends += 1
    assert ends >= 4 * len(batched.agents)
    assert learner.observation_space.contains(rows[0])


SLOTS = {"policy": "attention", "scenario": "paper"}
KINDS = [{}, {"per_type": True}, {"algorithm": "sac"}, SLOTS, {**SLOTS, "algorithm": "sac"}]
NAMES = ["ppo", "per_type", "sac", "attention", "attention by sac"]


@pytest.mark.parametrize("changes", KINDS, ids=NAMES)
def test_the_actor_does_not_see_the_state_and_the_critic_does(changes):
    run = _Run(config(**changes), None, None, None)
    run.learn()
    model = run.algorithm
    own = run.env.observation_space.shape[0] - run.learner.state.size
    rows = run.env.reset()
    other_state, other_own = rows.copy(), rows.copy()
    other_state[:, own:] += 1.0
    other_own[:, :own] += 1.0
    acted, *others = (model.predict(each, deterministic=True)[0] for each in (rows, other_state, other_own))
    np.testing.assert_array_equal(acted, others[0])
    assert (acted != others[1]).any()

    def values(seen):
        seen = torch.as_tensor(seen)
        if changes.get("algorithm") == "sac":
            return model.critic(seen, torch.as_tensor(acted))[0].detach().numpy()
        return model.policy.predict_values(seen).detach().numpy()

    assert (values(rows) != values(other_state)).mean() > 0.9
    assert (values(rows) != values(other_own)).mean() > 0.9
    if "algorithm" not in changes:
        _, _, likelihood = model.policy(torch.as_tensor(rows), deterministic=True)
        _, _, other = model.policy(torch.as_tensor(other_state), deterministic=True)
        np.testing.assert_array_equal(likelihood.detach(), other.detach())


@pytest.mark.parametrize("changes", KINDS, ids=NAMES)
def test_the_saved_policy_has_no_critic(changes, tmp_path):
    """Its file has the same arrays as without one, and acts as the trained actor."""
    chosen = config(**changes)
    run = _Run(chosen, None, None, None)
    run.learn()
    run._exported().save(tmp_path / "policy.npz")
    _Run(dataclasses.replace(chosen, critic="local"), None, None, None)._exported().save(tmp_path / "local.npz")
    ours, theirs = (read_arrays(tmp_path / f"{name}.npz", 2**24) for name in ("policy", "local"))
    assert {key: array.shape for key, array in ours.items()} == {key: array.shape for key, array in theirs.items()}
    learned, env = LearnedPolicy.load(tmp_path / "policy.npz"), build(chosen, 5)
    observations, _ = env.reset(0)
    learned.reset(describe(env), range(5))
    found = np.stack(list(learned.act(by_agent(env, observations)).values()), axis=1)
    features = run.learner.scaler(observations.reshape(found.shape[0] * found.shape[1], -1), None)
    state = np.full((len(features), len(env.state_fields)), 3.0, np.float32)
    acted, _ = run.algorithm.predict(np.hstack([features, state]), deterministic=True)
    np.testing.assert_allclose(found.reshape(acted.shape), np.clip(acted, -1.0, 1.0), atol=1e-6)


@pytest.mark.parametrize(
    ("changes", "replay"),
    [({}, 0), ({"algorithm": "sac"}, 240), ({"algorithm": "sac", "critic": "local"}, 4000)],
    ids=["ppo", "sac with a full buffer", "sac"],
)
def test_a_killed_run_goes_on_bit_for_bit(changes, replay, tmp_path, monkeypatch):
    """Networks, critic, optimizers, and the replay buffer of SAC at the end."""
    monkeypatch.setattr(networks, "REPLAY", replay)
    chosen = config(**changes)
    whole = train(chosen, tmp_path / "whole")

    def kill(part, found):
        if part > 0.8 and found is None:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        train(chosen, tmp_path / "killed", on_progress=kill)
    saved = read_checkpoint(tmp_path / "killed" / CHECKPOINT)["model"]
    assert 0 < saved["counters"]["num_timesteps"] < 0.8 * chosen.timesteps
    if "replay" in saved:
        assert saved["replay"]["full"] is (replay == 240)
    resumed = train(chosen, tmp_path / "killed", resume=True)
    assert resumed.curve == whole.curve
    ours, theirs = (read_arrays(tmp_path / name / CHECKPOINT, 2**26) for name in ("killed", "whole"))
    assert list(ours) == list(theirs)
    assert [key for key in ours if key != "tree" and not _equal(ours[key], theirs[key])] == []


def _equal(first, second):
    return first.dtype == second.dtype and np.array_equal(first, second, equal_nan=first.dtype.kind == "f")


def test_the_buffer_of_a_resumed_run_is_the_whole_one(tmp_path, monkeypatch):
    """What isn't in the checkpoint, as the next transition has it, too; and the next random actions."""
    for size in (200, 4000):
        monkeypatch.setattr(networks, "REPLAY", size)
        folder = tmp_path / str(size)
        folder.mkdir()
        run = _Run(config(algorithm="sac"), folder, None, None)
        run.learn()
        other = _Run(run.config, None, read_checkpoint(folder / CHECKPOINT), None)
        ours, theirs = (each.algorithm.replay_buffer for each in (other, run))
        assert (ours.pos, ours.full) == (theirs.pos, theirs.full)
        assert ours.full == (size == 200)
        assert ours.dones.any()
        for name in ("observations", "next_observations", "actions", "rewards", "dones", "timeouts"):
            np.testing.assert_array_equal(getattr(ours, name), getattr(theirs, name))
        assert (run.algorithm.action_space.sample() == other.algorithm.action_space.sample()).all()


def test_a_checkpoint_without_a_replay_buffer(tmp_path, monkeypatch):
    """Earlier versions wrote such."""
    monkeypatch.setattr(networks, "REPLAY", 4000)
    run = _Run(config(algorithm="sac", critic="local"), tmp_path, None, None)
    run.learn()
    saved = read_checkpoint(tmp_path / CHECKPOINT)
    del saved["model"]["replay"]
    with pytest.warns(UserWarning, match="without SAC's replay buffer: the training goes on with an empty one"):
        other = _Run(run.config, None, saved, None)
    assert other.algorithm.replay_buffer.size() == 0
    assert other.algorithm.num_timesteps == run.algorithm.num_timesteps


def test_a_run_with_another_critic_gives_its_policy_only(tmp_path):
    train(config(), tmp_path)
    chosen = config(critic="local", initial=str(tmp_path))
    said = "its critic is 'state', and this run's is 'local': name .*last.npz, of which the policy alone is taken"
    with pytest.raises(ValueError, match=said):
        _Run(chosen, None, None, None)
    run = _Run(dataclasses.replace(chosen, initial=str(tmp_path / "last.npz")), None, None, None)
    ours, theirs = (each.networks[""].arrays() for each in (run.policy, LearnedPolicy.load(tmp_path / "last.npz")))
    assert ours.keys() == theirs.keys()
    for name, array in ours.items():
        np.testing.assert_array_equal(array, theirs[name])
    whole = _Run(config(initial=str(tmp_path)), None, None, None)
    saved = read_checkpoint(tmp_path / CHECKPOINT)["model"]["parameters"]["policy"]
    for name, values in whole.algorithm.policy.state_dict().items():
        np.testing.assert_array_equal(values.numpy(), saved[name])


def test_settings_are_checked():
    with pytest.raises(ValueError, match="critic must be one of local, state; got 'global'"):
        config(critic="global")
    with pytest.raises(ValueError, match="critic 'state' is for policies 'mlp' and 'attention'; policy is 'recurrent'"):
        config(policy="recurrent")


def test_a_local_critic_is_as_before():
    """No row has more columns."""
    chosen = config(critic="local")
    env = training_environment(chosen)
    model = make_model(chosen, env, [], None)
    assert env.observation_space.shape == (env.venv.scaler.size,)
    assert model.policy.mlp_extractor.value_net[0].in_features == env.venv.scaler.size


def test_a_fleet_of_another_size_takes_the_policy_alone(tmp_path):
    """With attention the policy fits, but not the critic, which sees the state of the whole fleet."""
    small = config("formation_v0", "random_geometric:agents=5", policy="attention", timesteps=100, evaluations=1)
    train(small, tmp_path)
    larger = dataclasses.replace(small, scenario="random_geometric:agents=7", initial=str(tmp_path))
    with pytest.raises(ValueError, match=r"can't begin from .*its networks are of other sizes .*: name .*last\.npz"):
        _Run(larger, None, None, None)
    run = _Run(dataclasses.replace(larger, initial=str(tmp_path / "last.npz")), None, None, None)
    ours, theirs = run.policy.networks[""].arrays(), LearnedPolicy.load(tmp_path / "last.npz").networks[""].arrays()
    assert all(np.array_equal(ours[name], theirs[name]) for name in theirs)
