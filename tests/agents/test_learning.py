"""Training: it learns, it is reproducible, it survives being killed, and what it saves acts as it did."""

import dataclasses
import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest
import torch

from agents import describe, make_policy, play
from agents.learning import LearnedPolicy, ObservationScaler, PolicyFileError, TrainingConfig
from agents.learning.environment import training_environment
from agents.learning.networks import make_model
from agents.learning.training import CHECKPOINT, train
from agents.policy import by_agent
from tests.env.playing import batched

SMALL = TrainingConfig("consensus_v0", "mixed_fleet", timesteps=15_000, num_envs=16, evaluations=3, batch_size=512)


@pytest.fixture(scope="module")
def trained(tmp_path_factory):
    """A short run, and its folder."""
    folder = tmp_path_factory.mktemp("run")
    return train(SMALL, folder), folder


def test_a_short_training_beats_random_and_zero():
    config = TrainingConfig("leader_following_v0", timesteps=150_000, evaluations=3)
    training = train(config)
    env = batched("leader_following_v0", "convoy", num_envs=32)
    learned, random, zero = (
        play(env, policy, range(32)).returns for policy in (training.policy, make_policy("random"), make_policy("zero"))
    )
    assert learned.mean() > 0.2 * max(random.mean(), zero.mean())  # returns are negative
    assert np.all(learned > np.maximum(random, zero))
    assert training.curve[-1].mean_return > training.curve[0].mean_return
    assert max(one.max_normalized_disagreement for one in training.curve) < 1.0


def test_the_same_seed_gives_the_same_curve(trained):
    assert train(SMALL).curve == trained[0].curve
    assert train(dataclasses.replace(SMALL, seed=1)).curve != trained[0].curve


def test_what_a_run_leaves(trained):
    training, folder = trained
    assert training.finished
    assert [one.timesteps for one in training.curve][-1] >= SMALL.timesteps
    config = json.loads((folder / "config.json").read_text())
    assert (config["environment"], config["scenario"], config["seed"]) == ("consensus_v0", "mixed_fleet", 0)
    assert {"khop_env", "stable_baselines3", "torch", "numpy", "python"} <= set(config["versions"])
    assert len((folder / "curve.csv").read_text().splitlines()) == 1 + len(training.curve)
    assert list((folder / "tensorboard").rglob("events*"))
    for name in ("best.npz", "last.npz"):
        assert LearnedPolicy.load(folder / name).about["seed"] == 0
    with pytest.raises(FileExistsError, match="holds a training run; continue it with --resume"):
        train(SMALL, folder)
    with pytest.raises(ValueError, match=r"gamma = 0\.95 there and 0\.9 here; resume with the same"):
        train(dataclasses.replace(SMALL, gamma=0.9), folder, resume=True)
    with pytest.raises(FileNotFoundError, match="nothing to resume"):
        train(SMALL, folder / "elsewhere", resume=True)
    assert train(SMALL, folder, resume=True).curve == training.curve  # it is at its end already


TRAIN = """
import sys
from agents.learning import TrainingConfig
from agents.learning.training import train
config = TrainingConfig("consensus_v0", "mixed_fleet", timesteps=15_000, num_envs=16, evaluations=3, batch_size=512)
train(config, sys.argv[1], resume="resume" in sys.argv, told=lambda part, found: print(part, flush=True))
"""


def start(folder, *more):
    command = [sys.executable, "-W", "ignore", "-c", TRAIN, str(folder), *more]
    return subprocess.Popen(command, cwd=Path(__file__).parents[2], stdout=subprocess.PIPE, text=True)


@pytest.mark.parametrize("how", [signal.SIGKILL, signal.SIGINT])
def test_killed_and_resumed_it_goes_on_as_if_nothing_had_happened(trained, tmp_path, how):
    process = start(tmp_path / "run")
    for line in process.stdout:  # somewhere after the first evaluation, in the middle of an update
        if float(line) > 0.45:
            break
    process.send_signal(how)
    process.communicate(timeout=60)
    assert process.returncode == (0 if how == signal.SIGINT else -how)
    assert (tmp_path / "run" / CHECKPOINT).exists()
    policy = LearnedPolicy.load(tmp_path / "run" / "last.npz")  # usable as it is
    play(batched("consensus_v0", "mixed_fleet", num_envs=2, max_cycles=3), policy, range(2))
    resumed = start(tmp_path / "run", "resume")
    resumed.communicate(timeout=120)
    assert resumed.returncode == 0
    assert (tmp_path / "run" / "curve.csv").read_text() == (trained[1] / "curve.csv").read_text()


def test_the_horizon_is_bootstrapped():
    """At a truncation PPO adds gamma times the value of the last observation; without the flag it wouldn't."""
    config = dataclasses.replace(SMALL, num_envs=8, n_steps=30, gamma=0.9)
    env = training_environment(config)
    model = make_model(config, env, [], None)
    given, step = [], env.step_wait

    def recorded():
        observations, rewards, dones, infos = step()
        given.append((rewards.copy(), dones.copy(), infos))
        return observations, rewards, dones, infos

    env.step_wait = recorded
    model.learn(30 * env.num_envs)
    ended = 0
    for number, (rewards, dones, infos) in enumerate(given):
        expected = rewards.astype(np.float64)
        for row in np.flatnonzero(dones):
            assert infos[row]["TimeLimit.truncated"]
            ended += 1
        plain = ~dones
        np.testing.assert_allclose(model.rollout_buffer.rewards[number][plain], expected[plain], rtol=1e-6)
        if dones.any():
            assert np.all(np.abs(model.rollout_buffer.rewards[number][dones] - expected[dones]) > 1e-6)
    assert ended


def test_the_last_observation_is_scaled_like_the_others():
    env = training_environment(dataclasses.replace(SMALL, num_envs=4))
    env.reset()
    inner = env.venv.venv
    scaler = ObservationScaler.of(inner.batched.layouts, 0.05, rates=True)
    assert np.unique(inner.batched.get_state().cycles).size == 4  # staggered
    for _ in range(60):
        _, _, dones, infos = env.step(np.zeros((env.num_envs, env.action_space.shape[0]), np.float32))
        if dones.any():
            break
    row = int(np.flatnonzero(dones)[0])
    assert np.abs(infos[row]["terminal_observation"]).max() <= 10.0
    assert infos[row]["terminal_observation"].shape == (scaler.size,)


def test_agents_with_a_heading_see_others_in_their_own_frame():
    """Turned by their heading; integrators and carts as they stand."""
    env = batched("formation_v0", "mixed_fleet", num_envs=3)
    observations, _ = env.reset(0)
    features = ObservationScaler.of(env.layouts, 0.05, rates=True)(observations, observations)
    for number, layout in enumerate(env.layouts):
        seen, found = observations[:, number], features[:, number]
        cos, sin = 1.0, 0.0
        if "own.heading.cos" in layout.names:
            cos, sin = seen[:, layout.index("own.heading.cos")], seen[:, layout.index("own.heading.sin")]
        for what in ("position", "displacement"):
            columns = layout.columns(f"slot0.{what}")
            x, y = 0.5 * seen[:, columns].T
            np.testing.assert_allclose(found[:, columns[0]], cos * x + sin * y, atol=1e-6)
            np.testing.assert_allclose(found[:, columns[1]], cos * y - sin * x, atol=1e-6)
        np.testing.assert_allclose(found[:, :2], 0.5 * seen[:, :2], atol=1e-6)


def test_huber_bounds_the_slope_of_the_reward():
    """Far away the training reward is linear in the error, near the goal it is the environment's."""
    config = dataclasses.replace(SMALL, environment="consensus_v0", scenario="paper", huber=1.0)
    env = training_environment(config)
    env.training, env.norm_reward = False, False
    env.reset()
    inner = env.venv.venv
    for _ in range(3):
        _, reward, _, _ = env.step(np.zeros((env.num_envs, 2), np.float32))
        error = inner.infos["task_error"].reshape(-1)
        expected = -0.05 * np.where(error < 1.0, error**2, 2.0 * error - 1.0)
        np.testing.assert_allclose(reward, expected, rtol=1e-5)
        assert (error > 1.0).any()


@pytest.mark.parametrize(
    "changes", [{}, {"per_type": True}, {"algorithm": "sac", "batch_size": 64}], ids=["ppo", "per_type", "sac"]
)
def test_the_saved_policy_acts_like_the_model(changes, tmp_path):
    """NumPy's forward pass against Stable-Baselines3's deterministic prediction, for every agent type."""
    config = dataclasses.replace(SMALL, timesteps=2_000, num_envs=4, evaluations=1, **changes)
    from agents.learning.training import _Run

    run = _Run(config, None, False, None)
    policy = run.learn().policy
    last = run._exported()
    last.save(tmp_path / "policy.npz")
    loaded = LearnedPolicy.load(tmp_path / "policy.npz")
    env = batched("consensus_v0", "mixed_fleet", num_envs=5)
    observations, _ = env.reset(0)
    scaler = ObservationScaler.of(env.layouts, 0.05, rates=True)
    loaded.reset(describe(env), range(5))
    before = None
    for _ in range(3):
        features = scaler(observations.reshape(60, -1), before)
        expected, _ = run.algorithm.predict(features, deterministic=True)
        actions = loaded.act(by_agent(env, observations))
        found = np.stack([actions[agent] for agent in env.agents], axis=1)
        np.testing.assert_allclose(found.reshape(60, -1), np.clip(expected, -1.0, 1.0), atol=2e-5)
        before = observations.reshape(60, -1)
        observations, *_ = env.step(found)
    assert set(policy.networks) == ({"integrator", "cart", "unicycle", "vessel"} if config.per_type else {""})


def test_types_have_networks_of_their_own():
    """With one network per type, the loss of one type's rows leaves the others' parameters alone."""
    config = dataclasses.replace(SMALL, per_type=True, num_envs=4)
    env = training_environment(config)
    layout = env.venv.venv.batched.layouts[0]
    columns = [layout.index(f"own.type.{kind}") for kind in ("integrator", "cart", "unicycle", "vessel")]
    model = make_model(config, env, columns, None)
    observations = torch.as_tensor(env.reset())
    carts = observations[observations[:, columns[1]] > 0.5]
    model.policy.get_distribution(carts).distribution.mean.sum().backward()
    for number, network in enumerate(model.policy.mlp_extractor.actors):
        moved = any(p.grad is not None and bool(p.grad.abs().sum() > 0) for p in network.parameters())
        assert moved is (number == 1)


def test_padded_slots_do_not_matter():
    """Whatever stands in a slot that isn't valid, the scaled observation and so the action stay the same."""
    env = batched("consensus_v0", "mixed_fleet", num_envs=2)
    observations, _ = env.reset(0)
    scaler = ObservationScaler.of(env.layouts, 0.05, rates=True)
    rng, checked = np.random.default_rng(0), 0
    for number, layout in enumerate(env.layouts):
        spoilt = observations[:, number].copy()
        for column, name in enumerate(layout.names):
            slot, _, rest = name.partition(".")
            if slot.startswith("slot") and int(slot[4:]) >= len(layout.slots) and rest != "valid":
                spoilt[:, column] = rng.normal(size=2)
                checked += 1
        mine = observations[:, number]
        np.testing.assert_array_equal(scaler(spoilt, mine), scaler(mine, mine))
    assert checked
    heard = observations[:, 0].copy()
    heard[:, env.layouts[0].index("slot0.position.x")] += 1.0
    assert not np.array_equal(scaler(heard, None), scaler(observations[:, 0], None))


def test_features_hold_how_fast_positions_change():
    """Own and others' velocities of drifters, whose state has none; zero in an episode's first observation."""
    config = dataclasses.replace(SMALL, scenario="paper", num_envs=4)
    env = training_environment(config)
    first = env.reset()
    scaler, inner = env.venv.scaler, env.venv.venv
    layout = inner.batched.layouts[0]
    columns = len(layout)
    assert not first[:, columns:].any()
    before = env.venv.before
    positions = inner.batched.simulator.x.copy()
    features, *_ = env.step(np.ones((env.num_envs, 2), np.float32))
    own = (inner.batched.simulator.x - positions).reshape(-1, 2) / 0.05
    np.testing.assert_allclose(features[:, columns : columns + 2], 0.25 * own, atol=1e-4)
    assert np.all(scaler(env.venv.before, before) == features)
    for _ in range(200):
        features, _, dones, infos = env.step(np.zeros((env.num_envs, 2), np.float32))
        if dones.any():
            assert not features[dones, columns:].any()
            assert all(infos[row]["terminal_observation"][columns:].any() for row in np.flatnonzero(dones))
            return
    raise AssertionError("no episode ended")


def test_a_policy_that_does_not_fit_is_refused(trained, tmp_path):
    policy = trained[0].policy
    for environment, scenario, arguments, said in (
        ("formation_v0", "mixed_fleet", {}, "it was trained for consensus_v0, not for formation_v0"),
        ("consensus_v0", "paper", {}, "it needs uniform observations and 3 entries per action; the environment has"),
        (
            "consensus_v0",
            "mixed_fleet",
            {"bounds": True},
            "trained on mixed_fleet with .* columns of observations, here",
        ),
        ("consensus_v0", "mixed_fleet", {"uniform": False}, "needs uniform observations"),
    ):
        with pytest.raises(PolicyFileError, match=said):
            policy.reset(describe(batched(environment, scenario, num_envs=1, **arguments)), [0])
    with pytest.raises(PolicyFileError, match="there is no policy"):
        make_policy(f"ppo:{tmp_path / 'nothing'}")
    (tmp_path / "text.npz").write_text("no policy")
    with pytest.raises(PolicyFileError, match="isn't a policy that khop train wrote"):
        make_policy(f"ppo:{tmp_path / 'text.npz'}")
    with pytest.raises(ValueError, match="say which, ppo:FOLDER or ppo:pretrained"):
        make_policy("ppo")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"algorithm": "dqn"}, "algorithm must be 'ppo' or 'sac'; got 'dqn'"),
        ({"observe": "truth"}, "observe must be one of"),
        ({"timesteps": 0}, "timesteps must be a positive integer; got 0"),
        ({"seed": -1}, "seed must be an integer that isn't negative"),
        ({"gamma": 1.5}, "gamma must be from 0 to 1; got 1.5"),
        ({"learning_rate": 0.0}, "learning_rate must be positive"),
        ({"hidden": ()}, "hidden must be the widths"),
        ({"algorithm": "sac", "per_type": True}, "per_type is for 'ppo'"),
    ],
)
def test_settings_are_checked(changes, said):
    with pytest.raises(ValueError, match=said):
        TrainingConfig("consensus_v0", **changes)


class BangBang:
    """Full inputs of changing sign: every agent at once, or each at random."""

    def __init__(self, together):
        self.together = together

    def reset(self, env, seeds):
        self.sizes, self.rng = env.action_sizes, np.random.default_rng(0)

    def act(self, observations):
        shape = next(iter(observations.values())).shape[:-1]
        sign = self.rng.choice([-1.0, 1.0], (*shape, 1))
        return {
            agent: np.broadcast_to(
                sign if self.together else self.rng.choice([-1.0, 1.0], (*shape, size)), (*shape, size)
            )
            for agent, size in self.sizes.items()
        }


@pytest.mark.parametrize("environment", ["consensus_v0", "formation_v0", "leader_following_v0"])
@pytest.mark.parametrize("scenario", ["paper", "convoy", "mixed_fleet", "random_geometric:agents=12"])
def test_no_policy_breaks_the_guarantee(environment, scenario):
    """Adversaries included, over all time and after the transient."""
    env = batched(environment, scenario, num_envs=8)
    for policy in (BangBang(True), BangBang(False)):
        episodes = play(env, policy, range(8))
        assert episodes.max_normalized_disagreement.max() < 1.0
        assert episodes.late_normalized_disagreement.max() <= episodes.max_normalized_disagreement.max()
        assert episodes.max_error_to_bound.max() < 1.0


def test_ctrl_c_on_the_command_line(tmp_path):
    command = [sys.executable, "-W", "ignore", "-m", "khop_env", "train", "consensus_v0", "--timesteps", "5000000"]
    command += ["--num-envs", "8", "--out", str(tmp_path / "run")]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    while not (tmp_path / "run" / CHECKPOINT).exists():
        assert process.poll() is None, process.communicate()
        time.sleep(0.1)
    time.sleep(1.0)
    process.send_signal(signal.SIGINT)
    stdout, stderr = process.communicate(timeout=60)
    assert process.returncode == 0, stderr
    assert "interrupted; the same command with --resume goes on" in stderr
    assert f"play it: khop evaluate consensus_v0 --scenario paper --policies ppo:{tmp_path / 'run'}" in stdout
    assert LearnedPolicy.load(tmp_path / "run").about["observe"] == "estimate"
