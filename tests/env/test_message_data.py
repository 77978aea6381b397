"""Data of policies in messages: the last entries of an action, stored and forwarded with the agent's state."""

import numpy as np
import pytest

from khop_env import consensus_v0, leader_following_v0, navigation_v0
from khop_env.testing import check_environment

SIZE = 3


def played(env, steps, seed=0):
    """Actions, and the observations after each."""
    rng = np.random.default_rng(seed)
    env.reset(seed)
    actions, seen = [], []
    for _ in range(steps):
        actions.append(rng.uniform(-1.0, 1.0, (env.num_envs, int(env.action_offset[-1]))))
        seen.append(env.step(actions[-1])[0].reshape(env.num_envs, -1))
    return actions, seen


@pytest.mark.parametrize(
    "network", ["ideal:period=0.05", "ideal:period=0.05,loss=0.4,burst=3", "ideal:period=0.05,latency=0.02..0.12"]
)
@pytest.mark.parametrize(("module", "scenario"), [(navigation_v0, "swap"), (leader_following_v0, "convoy")])
def test_data_arrive_with_the_state_that_they_were_sent_with(module, scenario, network):
    """The age of a slot says of which action they are; 0 before anything has arrived, and of leaders."""
    env = module.batched_env(scenario, network=network, num_envs=3, message_size=SIZE, uniform=False)
    actions, seen = played(env, 20)
    compared = 0
    for number, (agent, layout) in enumerate(zip(env.agents, env.layouts, strict=True)):
        for q, slot in enumerate(layout.slots):
            columns = env.observation_offset[number] + layout.columns(f"slot{q}.message")
            ages = env.observation_offset[number] + layout.index(f"slot{q}.age")
            for step, observations in enumerate(seen):
                late = np.rint(observations[:, ages] / 0.05).astype(int)
                for b in range(env.num_envs):
                    expected = np.zeros(SIZE)
                    if slot.id in env.agents and late[b] <= step:
                        end = env.action_offset[env.agents.index(slot.id) + 1]
                        expected = actions[step - late[b]][b, end - SIZE : end]
                        compared += 1
                    np.testing.assert_array_equal(observations[b, columns], expected.astype(np.float32), err_msg=agent)
    assert compared > 500


def test_data_change_nothing_else():
    """Neither states nor estimates nor rewards depend on what is said."""
    silent, talking = (navigation_v0.batched_env("swap", num_envs=2, message_size=size) for size in (0, SIZE))
    for env in (silent, talking):
        env.reset(4)
    rng = np.random.default_rng(1)
    for _ in range(20):
        inputs = rng.uniform(-1.0, 1.0, (2, 8, 2))
        _, rewards, *_ = silent.step(inputs)
        _, others, *_ = talking.step(np.concatenate([inputs, rng.uniform(-1.0, 1.0, (2, 8, SIZE))], axis=2))
        np.testing.assert_array_equal(rewards, others)
        for name in ("estimate", "bound"):
            np.testing.assert_array_equal(
                silent.simulator.state.memory[name], talking.simulator.state.memory[name], err_msg=name
            )


@pytest.mark.parametrize("observe", ["estimate", "oracle", "local"])
def test_the_contract_is_kept_with_data_in_messages(observe):
    """No leaks: what is said is known to those who have received it."""
    report = check_environment(
        lambda: consensus_v0.parallel_env("paper", network="wifi", message_size=2, observe=observe),
        steps=30,
        skip=["sb3", "gymnasium"],
    )
    report.raise_if_failed()


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"message_size": 2}, "message_size=2: without a network there are no messages"),
        ({"message_size": -1, "network": "wifi"}, "message_size must be an integer from 0 to 1000; got -1"),
        ({"message_size": True, "network": "wifi"}, "message_size must be an integer from 0 to 1000; got True"),
    ],
)
def test_wrong_sizes(arguments, message):
    with pytest.raises(ValueError, match=message):
        consensus_v0.parallel_env(**arguments)


def test_data_that_are_not_finite_are_refused():
    env = navigation_v0.parallel_env("swap", message_size=1)
    env.reset(0)
    actions = {agent: np.zeros(3, np.float32) for agent in env.agents}
    actions["integrator_2"][2] = np.nan
    with pytest.raises(ValueError, match=r"the action of 'integrator_2' isn't finite: entry 2 is nan"):
        env.step(actions)
