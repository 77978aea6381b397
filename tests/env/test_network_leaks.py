"""Under a network nothing that hasn't arrived is in an observation."""

import copy
import itertools

import numpy as np
import pytest

from khop_env import consensus_v0
from khop_env.network import Network
from khop_env.testing.leaks import changed_by
from tests.env.playing import (
    ENVIRONMENTS,
    built,
    parallel,
    play,
    random_actions,
    same,
)
from tests.env.test_networked_environments import BURSTS, SILENT, cases


@pytest.mark.parametrize("observe", ["estimate", "local"])
@pytest.mark.parametrize("environment", ENVIRONMENTS)
@cases
def test_nobody_sees_the_true_state_of_another(environment, name, estimator, observe):
    """Not even a neighbour's, nor another's estimates: all that is in an observation is one's own."""
    env = parallel(environment, name, network=BURSTS, estimator=estimator, bounds=True, observe=observe)
    env.reset(seed=5)
    play(env, 4)
    fleet, layout = env.batched.fleet, env.batched.simulator.observers.layout
    acting = {fleet.agent(agent) for agent in env.possible_agents}
    for j in range(len(fleet)):
        part, pairs = fleet.state_slice(j), np.flatnonzero(layout.observer == j)

        def move(saved, part=part):
            saved.simulator.x[part] += 0.7 + 0.1 * np.arange(saved.simulator.x[part].shape[0])[:, None]

        def think(saved, pairs=pairs):
            memory = saved.simulator.memory
            memory["estimate"][np.isin(layout.column_pair, pairs)] += 0.3
            memory["hops"][pairs] += 1.0

        assert set(changed_by(env, move)) == {j} & acting
        assert set(changed_by(env, think)) == {j} & acting


def without_disturbance(name):
    """Disturbances may couple agents, physically."""
    return built(name).replace(disturbance=None)


def test_an_agent_that_nobody_hears_changes_no_observation():
    """Two runs with other states and actions of one agent, all of whose messages are lost."""
    for scenario, estimator in itertools.product(("paper", "mixed_fleet"), ("ppso", "relay")):
        arguments = {"network": SILENT, "estimator": estimator, "bounds": True}
        env = consensus_v0.parallel_env(without_disturbance(scenario), **arguments)
        fleet, rng = env.batched.fleet, np.random.default_rng(0)
        for j, agent in enumerate(fleet.ids[:3]):
            runs = []
            for offset in (0.0, 0.1):
                env.reset(seed=4)
                saved = env.get_state()
                saved.simulator.x[fleet.state_slice(j)] += offset
                env.set_state(saved)
                seen = []
                rng = np.random.default_rng(7)
                for _ in range(5):
                    actions = random_actions(env, rng)
                    actions[agent] *= 1.0 - 5.0 * offset
                    seen.append(env.step(actions)[0])
                runs.append(seen)
            for first, second in zip(*runs, strict=True):
                assert [name for name in first if not same(first[name], second[name])] == [agent]


def test_lost_messages_on_their_way_change_nothing():
    """What is edited in a message on its way shows in observations of those only who get a message over that link."""
    network = Network(loss=0.5, latency=0.12)
    for seed, estimator in itertools.product(range(3), ("ppso", "relay")):
        env = consensus_v0.parallel_env(without_disturbance("paper"), network=network, estimator=estimator)
        env.reset(seed=seed)
        play(env, 7, seed)
        saved, fleet, design = env.get_state(), env.batched.fleet, env.batched.simulator.design
        actions = random_actions(env, np.random.default_rng(seed))
        expected = env.step(actions)[0]
        newest = [each.simulator.memory["channel.newest"][:, 0] for each in (saved, env.get_state())]
        over = np.flatnonzero(newest[1] > newest[0])
        affected = set()
        for j in range(len(fleet)):
            edited = copy.deepcopy(saved)
            sent = edited.simulator.memory["channel.sent"]
            sent[:, 1 + fleet.state_offset[j] : 1 + fleet.state_offset[j + 1]] += 0.3
            env.set_state(edited)
            found = env.step(actions)[0]
            changed = {fleet.agent(agent) for agent in found if not same(found[agent], expected[agent])}
            assert changed <= {int(design.links.receiver[link]) for link in over if design.links.sender[link] == j}
            affected |= changed
        assert affected
