"""An agent's observation depends on itself, on its neighbours, and on its own estimates, and on nothing else."""

import numpy as np
import pytest

from khop_env.testing.leaks import changed_by
from tests.env.playing import EVERY, parallel, play

every = pytest.mark.parametrize(("environment", "name"), EVERY)
uniform_or_ragged = pytest.mark.parametrize("uniform", [True, False])


def in_mid_episode(environment, name, **arguments):
    """An environment some steps into an episode, and its fleet's names."""
    env = parallel(environment, name, bounds=True, **arguments)
    env.reset(seed=5)
    play(env, 4)
    return env, env.batched.fleet.ids


def within_one_hop(env, i):
    """The agents within one hop of i, itself included, from the graph alone."""
    return {i, *env.batched.simulator.design.communication[i]}


def changed(env, write):
    """The agents whose observation changes when `write` has edited the simulator's saved state."""
    return set(changed_by(env, lambda state: write(state.simulator)))


def moved(part):
    """Write other states, far from the estimates of them."""

    def write(simulator):
        simulator.x[part] += 0.7 + 0.1 * np.arange(simulator.x[part].shape[0])[:, None]

    return write


@uniform_or_ragged
@pytest.mark.parametrize("observe", ["estimate", "local"])
@every
def test_the_true_state_of_an_unheard_agent_changes_nothing(environment, name, observe, uniform):
    """For every pair, leaders included: i's observation changes with j's state exactly if i is j or its neighbour."""
    env, ids = in_mid_episode(environment, name, observe=observe, uniform=uniform)
    acting = {env.batched.fleet.agent(agent) for agent in env.possible_agents}
    pairs = 0
    for j in range(len(ids)):
        seen_by = changed(env, moved(env.batched.fleet.state_slice(j)))
        assert seen_by == {i for i in acting if j in within_one_hop(env, i)}, ids[j]
        pairs += len(acting) - len(seen_by)
    assert pairs > 0


@uniform_or_ragged
@every
def test_the_oracle_sees_exactly_those_within_k_hops(environment, name, uniform):
    """The same edit shows in every observation within k hops: the test above could fail."""
    import networkx as nx

    env, ids = in_mid_episode(environment, name, observe="oracle", uniform=uniform)
    design = env.batched.simulator.design
    hops = dict(nx.all_pairs_shortest_path_length(design.communication))
    acting = {env.batched.fleet.agent(agent) for agent in env.possible_agents}
    for j in range(len(ids)):
        seen_by = changed(env, moved(env.batched.fleet.state_slice(j)))
        assert seen_by == {i for i in acting if hops[i][j] <= design.k}, ids[j]


@every
def test_estimates_are_seen_by_those_who_make_them_only(environment, name):
    """Every entry of the estimates belongs to one observer: nobody else's observation changes with it."""
    env, _ = in_mid_episode(environment, name)
    layout, fleet = env.batched.simulator.design.states.layout, env.batched.fleet
    acting = {fleet.agent(agent) for agent in env.possible_agents}
    edited = np.zeros(layout.size, bool)
    for observer in range(len(fleet)):
        mine = np.zeros(layout.size, bool)
        for (i, j), slot in layout.slot.items():
            if i == observer:
                mine[slot : slot + fleet.models[j].n] = True

        def write(simulator, mine=mine):
            simulator.memory["estimate"][mine] += 0.3

        assert not (edited & mine).any()
        edited |= mine
        assert changed(env, write) == ({observer} & acting if mine.any() else set())
    assert edited.all()


@every
@pytest.mark.parametrize("observe", ["oracle", "local"])
def test_estimates_show_in_no_other_mode(environment, name, observe):
    """Neither the truth nor nothing depends on what anybody estimates."""
    env, _ = in_mid_episode(environment, name, observe=observe)

    def write(simulator):
        simulator.memory["estimate"] += 0.3

    assert changed(env, write) == set()


@every
def test_inputs_draws_and_solver_states_show_to_nobody_else(environment, name):
    """Other agents' inputs, the disturbance and the observers' inner states aren't observed; own inputs are."""
    env, ids = in_mid_episode(environment, name, actuator="lag")
    fleet = env.batched.fleet

    def write(simulator):
        simulator.drawn += 0.1
        simulator.u += 0.1
        simulator.g += 0.1
        simulator.memory["input_estimate"] += 0.1
        simulator.memory["eps"] += 0.1
        simulator.memory["nu"] += 0.1

    assert changed(env, write) == set()
    acting = {fleet.agent(agent) for agent in env.possible_agents}
    for j, agent in enumerate(ids):
        part = fleet.input_slice(j)

        def halve(state, part=part):
            state.inputs[part] *= 0.5

        assert set(changed_by(env, halve)) == {j} & acting, agent


def test_leaders_routes_show_to_nobody():
    """The plan of a leader is in no observation, before it has moved."""
    env, _ = in_mid_episode("leader_following_v0", "convoy", observe="oracle")

    def write(state):
        for values in state.task.values():
            values += 0.5

    assert not changed_by(env, write)
