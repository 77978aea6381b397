"""Policies under a network: an agent about which nothing has arrived contributes nothing; other columns are refused."""

import dataclasses

import numpy as np
import pytest

from agents import LAWS, describe, make_policy
from agents.learning import PRETRAINED, LearnedPolicy, PolicyFileError, TrainingConfig
from agents.learning.config_file import read_config, write_config
from agents.learning.environment import build, training_environment
from agents.learning.learned import columns_of
from agents.learning.scaling import ObservationScaler
from agents.policy import by_agent
from khop_env.network import Network
from khop_env.simulation import View
from tests.env.playing import ALONG_EDGES, batched, parallel

LOSSY = "lossy:loss=0.6,burst=3"


def view_of(env):
    """The law's view of the acting agents, from the observers' memory: what nothing has arrived about isn't known."""
    fleet, task, x = env.fleet, env.task, env.simulator.x
    layout, memory = env.simulator.observers.layout, env.simulator.state.memory
    number = {fleet.agent(agent): place for place, agent in enumerate(env.agents)}
    edges, known, displacement = [], [], []
    for described in env.layouts:
        i = fleet.agent(described.agent)
        for slot in (each for each in described.slots if each.task_edge):
            j, first = slot.agent, layout.slot[i, slot.agent]
            wanted = task.displacement[np.flatnonzero((task.edges == (i, j)).all(axis=1))[0]]
            other = memory["estimate"][first + fleet.position_index[j] - fleet.state_offset[j]].T
            arrived = memory["stamp"][layout.column_pair[first]] >= 0.0
            edges.append((number[i], number.get(j, -1)))
            known.append(arrived)
            displacement.append(arrived[:, None] * (other - x[:, fleet.position_index[i]] - wanted))
    acting = type(fleet)([fleet.models[fleet.agent(agent)] for agent in env.agents])
    own = np.concatenate([x[:, fleet.state_slice(fleet.agent(agent))] for agent in env.agents], axis=1)
    columns = np.ascontiguousarray(np.array(displacement).transpose(0, 2, 1))
    return View(acting, own, np.array(edges), np.array(known).T, columns.transpose(2, 0, 1)), acting


@pytest.mark.parametrize("estimator", ["ppso", "relay"])
@pytest.mark.parametrize("environment", ALONG_EDGES)
@pytest.mark.parametrize("law", LAWS)
def test_laws_act_on_what_has_arrived(environment, law, estimator):
    """On estimates of neighbours, too; as the law itself does with the numbers in the observers' memory."""
    env = batched(environment, "mixed_fleet", num_envs=4, network=LOSSY, estimator=estimator)
    policy = make_policy(law)
    policy.reset(describe(env), seeds=range(4))
    observations, _ = env.reset(0)
    unknown = []
    for _ in range(4):
        actions = policy.act(by_agent(env, observations))
        view, acting = view_of(env)
        unknown.append(not view.known.all())
        expected = policy.law(env.simulator.t, view) / acting.input_limit
        for number, agent in enumerate(env.agents):
            own = expected[:, acting.input_slice(number)]
            np.testing.assert_allclose(actions[agent][:, : own.shape[1]], own, atol=2e-4)
        observations, *_ = env.step(np.stack([actions[agent] for agent in env.agents], axis=1))
    assert unknown[0]


def test_without_any_message_nobody_moves():
    """Consensus with nobody; the first guess isn't anybody's position."""
    env = parallel("consensus_v0", network=Network(loss=1.0))
    policy = make_policy("tanh")
    policy.reset(describe(env), seeds=[0])
    observations, _ = env.reset(seed=0)
    assert not any(action.any() for action in policy.act(observations).values())


def test_a_learned_policy_of_other_columns_is_refused():
    """Trained without a network, and used under one; and the other way round."""
    policy = LearnedPolicy.load(PRETRAINED / "consensus_paper.npz")
    ideal, networked = (describe(batched("consensus_v0", network=network)) for network in (None, "wifi"))
    policy.reset(ideal, [0])
    with pytest.raises(PolicyFileError, match=r"'slot0.task_edge' there and 'slot0.age' here; .* without a network"):
        policy.reset(networked, [0])
    other = dataclasses.replace(policy, columns=columns_of(networked))
    other.reset(networked, [0])
    with pytest.raises(PolicyFileError, match="train a policy for it, or create it with a network"):
        other.reset(ideal, [0])


def test_features_of_ages_and_bounds_and_of_slots_that_begin():
    """Half seconds and two metres; a slot is zero until something has arrived, and that isn't a velocity."""
    env = batched("consensus_v0", num_envs=16, network=LOSSY, estimator="relay", bounds=True)
    scaler = ObservationScaler.of(describe(env), rates=True)
    before, _ = env.reset(seed=0)
    begun = 0
    for _ in range(6):
        after, *_ = env.step(np.zeros((16, 8, 2)))
        features = scaler(after, before)
        for number, layout in enumerate(env.layouts):
            for slot in range(len(layout.slots)):
                column = {
                    name: layout.index(f"slot{slot}.{name}") for name in ("valid", "age", "bound.x1", "position.x")
                }
                valid = after[:, number, column["valid"]]
                seen = features[:, number]
                np.testing.assert_allclose(seen[:, column["age"]], 2.0 * valid * after[:, number, column["age"]])
                np.testing.assert_allclose(
                    seen[:, column["bound.x1"]], 0.5 * valid * after[:, number, column["bound.x1"]]
                )
                begins = valid > before[:, number, column["valid"]]
                rate = len(layout) + scaler.moving.tolist().index(column["position.x"])
                assert not seen[begins, rate].any()
                begun += begins.sum()
        before = after
    assert begun


def test_training_settings_name_a_network():
    """A run's file says it, so that it can be read and used again."""
    for network in ("wifi", Network(loss=(0.1, 0.3), burst=None), {"profile": "wifi", "loss": 0.2}):
        config = TrainingConfig("consensus_v0", num_envs=2, arguments={"network": network, "estimator": "relay"})
        env = training_environment(config).venv.venv.batched
        assert env.settings.network == Network.of(network)


def test_copies_and_episodes_of_a_training_draw_their_own_networks():
    """And the episodes that select the best policy are played over networks out of the same ranges."""
    text = "random:loss=0..0.6,burst=2..8"
    arguments = {"network": text, "estimator": "relay", "max_cycles": 6}
    config = TrainingConfig("consensus_v0", num_envs=3, arguments=arguments)
    env = training_environment(config)
    env.reset()
    seen, batched = [], env.venv.batched
    for _ in range(18):
        seen.append(batched.simulator.observers.drawn(batched.simulator.state))
        env.step(np.zeros((len(batched.agents) * 3, *env.action_space.shape), np.float32))
    for copy, networks in enumerate(zip(*seen, strict=True)):
        episodes = list(dict.fromkeys(networks))
        assert [networks.count(each) for each in episodes] == [6 - 2 * copy, 6, 6, 2 * copy][: 3 + (copy > 0)]
    networks = {each for row in seen for each in row}
    assert len(networks) == 3 + 4 + 4
    assert all(0.0 <= each.loss <= 0.6 and 2.0 <= each.burst <= 8.0 for each in networks)
    assert build(config, 2).settings.network == Network.of(text)


def test_training_settings_are_read_back(tmp_path):
    config = TrainingConfig("consensus_v0", arguments={"network": Network(loss=(0.1, 0.3)), "estimator": "relay"})
    path = tmp_path / "config.toml"
    path.write_text(write_config(config, {}), encoding="utf-8")
    found = read_config(path)["arguments"]
    assert Network.of(found["network"]) == Network(loss=(0.1, 0.3))
    assert found["estimator"] == "relay"
