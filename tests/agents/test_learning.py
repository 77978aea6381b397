"""Training: it learns, is reproducible, survives a kill, and its saved policy acts as the trained model."""

import dataclasses
import json
import signal
import subprocess
import sys
import time
from pathlib import Path

import numpy as np
import pytest

from agents import make_policy, play
from agents.learning import LearnedPolicy, TrainingConfig, train
from agents.learning.environment import training_environment
from agents.learning.networks import make_model
from agents.learning.run_folder import CHECKPOINT
from tests.agents.training import SMALL
from tests.env.playing import batched


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
    assert max(point.max_normalized_disagreement for point in training.curve) < 1.0


def test_the_same_seed_gives_the_same_curve(trained):
    assert train(SMALL).curve == trained[0].curve
    assert train(dataclasses.replace(SMALL, seed=1)).curve != trained[0].curve


def test_what_a_run_leaves(trained):
    training, folder = trained
    assert training.finished
    assert training.curve[-1].timesteps >= SMALL.timesteps
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
train(config, sys.argv[1], on_progress=lambda part, found: print(part, flush=True))
"""


def start(folder):
    command = [sys.executable, "-W", "ignore", "-c", TRAIN, str(folder)]
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
    assert train(SMALL, tmp_path / "run", resume=True).finished
    assert (tmp_path / "run" / "curve.csv").read_text() == (trained[1] / "curve.csv").read_text()


def test_the_horizon_is_bootstrapped():
    """At a truncation PPO adds gamma times the value of the last observation; without the flag it wouldn't."""
    config = dataclasses.replace(SMALL, num_envs=8, n_steps=30, gamma=0.9)
    env = training_environment(config)
    model = make_model(config, env, [], None)
    steps, step = [], env.step_wait

    def recorded():
        observations, rewards, dones, infos = step()
        steps.append((rewards.copy(), dones.copy(), infos))
        return observations, rewards, dones, infos

    env.step_wait = recorded
    model.learn(30 * env.num_envs)
    ended = 0
    for number, (rewards, dones, infos) in enumerate(steps):
        expected = rewards.astype(np.float64)
        for row in np.flatnonzero(dones):
            assert infos[row]["TimeLimit.truncated"]
            ended += 1
        plain = ~dones
        np.testing.assert_allclose(model.rollout_buffer.rewards[number][plain], expected[plain], rtol=1e-6)
        if dones.any():
            assert np.all(np.abs(model.rollout_buffer.rewards[number][dones] - expected[dones]) > 1e-6)
    assert ended


def test_huber_bounds_the_slope_of_the_reward():
    """Far from the goal the training reward is linear in the error, near it equals the environment's reward."""
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
    ("changes", "said"),
    [
        ({"algorithm": "dqn"}, "algorithm must be 'ppo' or 'sac'; got 'dqn'"),
        ({"observe": "truth"}, "observe must be one of"),
        ({"timesteps": 0}, "timesteps must be a positive integer; got 0"),
        ({"seed": -1}, "seed must be a non-negative integer"),
        ({"gamma": 1.5}, "gamma must be from 0 to 1; got 1.5"),
        ({"learning_rate": 0.0}, "learning_rate must be positive"),
        ({"hidden": ()}, "hidden must be the positive widths"),
        ({"algorithm": "sac", "per_type": True}, "per_type is for 'ppo'"),
        ({"policy": "transformer"}, "policy must be one of mlp, attention, recurrent; got .transformer."),
    ],
)
def test_settings_are_checked(changes, said):
    with pytest.raises(ValueError, match=said):
        TrainingConfig("consensus_v0", **changes)


def test_what_suits_an_algorithm_wins_over_what_suits_an_environment():
    """Batches of the size that suits PPO in consensus would make each of SAC's gradient steps eight times as long."""
    found = TrainingConfig.suited("consensus_v0", algorithm="sac")
    assert (found.batch_size, found.gamma) == (512, TrainingConfig.suited("consensus_v0").gamma)


def test_ctrl_c_on_the_command_line(tmp_path):
    command = [sys.executable, "-W", "ignore", "-m", "khop_env", "train", "consensus_v0", "--timesteps", "5000000"]
    command += ["--num-envs", "8", "--out", str(tmp_path / "run")]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True)
    while not (tmp_path / "run" / CHECKPOINT).exists():
        assert process.poll() is None, process.communicate()
        time.sleep(0.1)
    process.send_signal(signal.SIGINT)
    stdout, stderr = process.communicate(timeout=60)
    assert process.returncode == 130, stderr
    assert "interrupted; the same command with --resume continues" in stderr
    assert f"play it: khop evaluate consensus_v0 --policies ppo:{tmp_path / 'run'}" in stdout
    assert LearnedPolicy.load(tmp_path / "run").about["observe"] == "estimate"
