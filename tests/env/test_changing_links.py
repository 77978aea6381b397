"""Links that come and go, without a network: a neighbour whose link is down isn't observed."""

from functools import partial

import numpy as np
import pytest

from khop_env import consensus_v0
from khop_env.network import RandomLinks
from khop_env.testing.leaks import changed_by
from tests.env.playing import built, play, require_contract

SCENARIOS = ("paper", "mixed_fleet")


def changing(name, probability=0.6, **arguments):
    scenario = built(name).replace(schedule=RandomLinks(probability, both_ways=False))
    return consensus_v0.parallel_env(scenario, **arguments)


@pytest.mark.parametrize("observe", ["estimate", "local", "oracle"])
@pytest.mark.parametrize("name", SCENARIOS)
def test_a_neighbour_is_observed_while_its_link_is_up(name, observe):
    """Its slot is valid then, and as without a schedule; otherwise its state is zeros."""
    env, fixed = changing(name, observe=observe), consensus_v0.parallel_env(built(name), observe=observe)
    seen = set()
    for seed in range(3):
        env.reset(seed=seed)
        play(env, 2)
        fixed.reset(seed=seed)
        saved, state = fixed.get_state(), env.get_state()
        saved.simulator.x[...] = state.simulator.x
        fixed.set_state(saved)
        simulator = env.batched.simulator
        up, links = simulator.observers.links_up(simulator.state)[:, 0], simulator.design.links
        for agent in env.possible_agents:
            i, layout = env.batched.fleet.agent(agent), env.layout(agent)
            assert layout.names == fixed.layout(agent).names
            found, usual = (layout.read(each.observe(agent)) for each in (env, fixed))
            for number, slot in enumerate(layout.slots):
                if not slot.heard:
                    continue
                there = bool(up[links.index[slot.agent, i]]) or observe == "oracle"
                seen.add(there)
                state = [key for key in layout.names if key.startswith(f"slot{number}.")]
                for key in (key for key in state if not any(part in key for part in ("task_edge", "type", "displac"))):
                    assert found[key] == (usual[key] if there else 0.0), key
    assert seen == ({True} if observe == "oracle" else {True, False})


@pytest.mark.parametrize("observe", ["estimate", "local"])
@pytest.mark.parametrize("name", SCENARIOS)
def test_a_state_reaches_those_whose_link_is_up(name, observe):
    """And nobody else, at that instant."""
    env = changing(name, observe=observe)
    env.reset(seed=5)
    play(env, 3)
    simulator, fleet = env.batched.simulator, env.batched.fleet
    up, links = simulator.observers.links_up(simulator.state)[:, 0].copy(), simulator.design.links
    assert not up.all()
    for j in range(len(fleet)):

        def move(saved, part=fleet.state_slice(j)):  # noqa: B008
            saved.simulator.x[part] += 0.7 + 0.1 * np.arange(saved.simulator.x[part].shape[0])[:, None]

        receivers = links.receiver[up & (links.sender == j)].tolist()
        assert set(changed_by(env, move)) == {j, *receivers}


def test_the_public_checks_pass():
    require_contract(partial(changing, "paper", bounds=True, max_cycles=8), steps=10)
