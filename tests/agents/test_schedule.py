"""Exploration ends on a schedule, and rewards are divided by the standard deviation of recent returns."""

import dataclasses

import numpy as np
import pytest

from agents.learning import TrainingConfig
from agents.learning.environment import training_environment
from agents.learning.networks import make_model
from agents.learning.schedule import follow_schedule
from tests.agents.training import SMALL

TINY = dataclasses.replace(SMALL, num_envs=2, timesteps=1000, log_std=1.0, log_std_end=-3.0, entropy=0.04)


def scheduled(config, timesteps, count=1.0):
    """(largest log_std, entropy bonus, count of the running statistics) after so many agent-steps."""
    env = training_environment(config)
    model = make_model(config, env, [], None)
    model.num_timesteps, env.ret_rms.count = timesteps, count
    follow_schedule(model, env, config)
    return float(model.policy.log_std.detach().max()), model.ent_coef, env.ret_rms.count


@pytest.mark.parametrize(("done", "limit", "entropy"), [(0, 1.0, 0.04), (250, 0.0, 0.03), (1000, -3.0, 0.0)])
def test_exploration_falls_linearly(done, limit, entropy):
    assert scheduled(TINY, done)[:2] == pytest.approx((limit, entropy))


@pytest.mark.parametrize(("done", "limit"), [(0, 1.0), (600, 1.0), (800, -1.0), (1000, -3.0)])
def test_exploration_may_last_a_while(done, limit):
    assert scheduled(dataclasses.replace(TINY, explore=0.6), done)[0] == pytest.approx(limit)


def test_beyond_the_end_nothing_changes():
    assert scheduled(TINY, 5000)[:2] == pytest.approx((-3.0, 0.0))


def test_a_policy_may_explore_less_than_the_limit():
    config = dataclasses.replace(TINY, timesteps=1000)
    env = training_environment(config)
    model = make_model(config, env, [], None)
    model.policy.log_std.data.fill_(-2.0)
    follow_schedule(model, env, config)
    assert np.allclose(model.policy.log_std.detach(), -2.0)


def test_without_limit_exploration_is_the_learners():
    free = dataclasses.replace(TINY, log_std_end=2.0)
    assert scheduled(free, 900)[:2] == pytest.approx((1.0, 0.04))


def test_rewards_forget_old_returns():
    assert scheduled(TINY, 0, count=1e6)[2] == TINY.reward_memory
    assert scheduled(TINY, 0, count=50.0)[2] == 50.0
    assert scheduled(dataclasses.replace(TINY, reward_memory=0), 0, count=1e6)[2] == 1e6


def test_a_training_ends_without_exploration():
    config = dataclasses.replace(TINY, num_envs=16)
    env = training_environment(config)
    model = make_model(config, env, [], None)
    while model.num_timesteps < config.timesteps:
        follow_schedule(model, env, config)
        model.learn(1, reset_num_timesteps=False)
    follow_schedule(model, env, config)
    assert float(model.policy.log_std.detach().max()) <= -3.0
    assert model.ent_coef == 0.0


@pytest.mark.parametrize(
    ("wrong", "text"),
    [
        ({"log_std_end": float("nan")}, "log_std_end must be finite; got nan"),
        ({"explore": 1.0}, "explore must be at least 0 and below 1; got 1.0"),
        ({"reward_memory": -1}, "reward_memory must be a non-negative integer; got -1"),
        ({"reward_memory": True}, "reward_memory must be a non-negative integer; got True"),
    ],
)
def test_wrong_values_are_refused(wrong, text):
    with pytest.raises(ValueError, match=text):
        TrainingConfig("consensus_v0", **wrong)
