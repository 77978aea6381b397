"""The contract of environments beyond the libraries' own tests, which let NaN and shared memory pass."""

import copy
import itertools
import pickle
from functools import partial

import numpy as np
import pytest

from khop_env.testing import arrays
from tests.env.playing import (
    CROSS,
    ENVIRONMENTS,
    EVERY,
    MODES,
    batched,
    info_keys,
    parallel,
    play,
    random_actions,
    require_contract,
    same,
    state,
)

cross = pytest.mark.parametrize(("environment", "name", "observe", "uniform"), CROSS)
every = pytest.mark.parametrize(("environment", "name"), EVERY)


def require_in_space(env, observations, infos, rewards=None):
    """Everything finite, every observation in its Box, and every info a number."""
    assert list(observations) == list(infos) == env.possible_agents
    for agent, observation in observations.items():
        assert np.isfinite(observation).all()
        assert env.observation_space(agent).contains(observation), agent
        assert tuple(infos[agent]) == info_keys(str(env))
        assert all(type(value) in (int, float) and np.isfinite(value) for value in infos[agent].values())
        np.testing.assert_array_equal(env.observe(agent), observation)
    assert env.state_space.contains(env.state())
    assert rewards is None or all(type(each) is float and np.isfinite(each) for each in rewards.values())


@cross
def test_observations_are_in_space_and_finite(environment, name, observe, uniform):
    """At reset and along episodes, with actions inside and far outside their bounds, which are counted."""
    env = parallel(environment, name, observe=observe, uniform=uniform, bounds=True, max_cycles=5)
    rng = np.random.default_rng(0)
    for scale in (1.0, 1e3):
        require_in_space(env, *env.reset(seed=3))
        for _ in range(5):
            observations, rewards, terminated, truncated, infos = env.step(random_actions(env, rng, scale))
            require_in_space(env, observations, infos, rewards)
            assert any(one["clipped_actions"] > 0 for one in infos.values()) == (scale > 1.0)
            assert all(one["max_error_to_bound"] < 1.0 for one in infos.values())
        assert all(truncated.values())
        assert not any(terminated.values())
        assert env.agents == []


@pytest.mark.parametrize("observe", MODES)
@pytest.mark.parametrize("name", ["convoy", "random_geometric:agents=12"])
def test_states_that_run_away_are_clipped_and_counted(name, observe):
    """All agents at full speed one way: beyond `limit` observations and `state` stay in their spaces."""
    env = parallel("consensus_v0", name, observe=observe, limit=3.0, max_cycles=150)
    _, infos = env.reset(seed=1)
    assert not any(info["clipped_observations"] for info in infos.values())
    while env.agents:
        observations, rewards, _, _, infos = env.step(
            {agent: np.ones(env.action_space(agent).shape, np.float32) for agent in env.agents}
        )
        require_in_space(env, observations, infos, rewards)
    assert np.abs(env.batched.simulator.x).max() > 6.0
    for agent, info in infos.items():
        own = env.batched.simulator.x[0, env.batched.fleet.state_slice(env.batched.fleet.agent(agent))]
        assert info["clipped_observations"] >= np.sum(np.abs(own) > 3.0) > 0
    assert np.abs(env.state()).max() == 3.0


@every
def test_the_corners_of_the_initial_set_are_fine(environment, name):
    """All agents as far apart as the initial set lets them be, both for the whole fleet and agent by agent."""
    env = parallel(environment, name, bounds=True)
    fleet, initial = env.batched.fleet, env.batched.simulator.initial
    x0 = initial.center + initial.radius * np.random.default_rng(0).choice([-1.0, 1.0], fleet.n)
    by_agent = {one: x0[fleet.state_slice(i)] for i, one in enumerate(fleet.ids)}
    first = env.reset(seed=4, options={"initial_state": x0})
    np.testing.assert_array_equal(env.batched.simulator.x[0], x0)
    require_in_space(env, *first)
    played = []
    for seed in range(3):
        played += play(env, 1, seed)
        observations, rewards, _, _, infos = played[-1]
        require_in_space(env, observations, infos, rewards)
    assert same(env.reset(seed=4, options={"initial_state": by_agent}), first)
    assert same([play(env, 1, seed)[0] for seed in range(3)], played)


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_some_initial_states_leave_the_others_as_drawn(environment):
    """Whoever isn't named in `initial_state`, and the disturbances, are those of the same seed without options."""
    one, other = parallel(environment, "mixed_fleet"), parallel(environment, "mixed_fleet")
    one.reset(seed=8)
    other.reset(seed=8, options={"initial_state": {"cart_1": [0.1, 0.2, 0.15, -0.1]}})
    fleet = one.batched.fleet
    part = fleet.state_slice(fleet.agent("cart_1"))
    expected = one.batched.simulator.save().x
    expected[part] = np.array([[0.1], [0.2], [0.15], [-0.1]])
    saved = other.batched.simulator.save()
    np.testing.assert_array_equal(saved.x, expected)
    np.testing.assert_array_equal(saved.drawn, one.batched.simulator.save().drawn)
    assert same(other.get_state().generators, one.get_state().generators)


@every
def test_spaces_are_the_same_in_every_observe_mode(environment, name):
    """A policy trained on estimates can be run on the truth, and the other way round."""
    for uniform in (True, False):
        envs = [parallel(environment, name, observe=observe, uniform=uniform, bounds=True) for observe in MODES]
        assert envs[0].observation_spaces == envs[1].observation_spaces == envs[2].observation_spaces
        assert envs[0].action_spaces == envs[1].action_spaces == envs[2].action_spaces
        assert envs[0].state_space == envs[1].state_space == envs[2].state_space
        for agent in envs[0].possible_agents:
            assert envs[0].layout(agent).fields == envs[1].layout(agent).fields == envs[2].layout(agent).fields
        if uniform:
            assert len({repr(space) for space in envs[0].observation_spaces.values()}) == 1


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_steps_share_no_memory(environment):
    """Arrays and dictionaries that were handed out are never written again, and belong to nobody else."""
    env = parallel(environment, "mixed_fleet", actuator="lag", bounds=True)
    seen = [env.reset(seed=0), *play(env, 3), (env.state(),), (env.observe(env.agents[0]),), (env.state(),)]
    frozen = copy.deepcopy(seen)
    play(env, 3)
    env.reset()
    assert same(seen, frozen)
    for one, other in itertools.combinations(seen, 2):
        assert not any(np.shares_memory(a, b) for a, b in itertools.product(arrays(one), arrays(other)))
        assert not {id(a) for a in one if isinstance(a, dict)} & {id(b) for b in other if isinstance(b, dict)}
    for agents in (seen[0][0], seen[1][0]):
        assert not any(np.shares_memory(a, b) for a, b in itertools.combinations(agents.values(), 2))


def test_batched_steps_share_no_memory():
    """The same of the arrays that the other environments are made of, and of saved states."""
    env = batched("leader_following_v0", "mixed_fleet", num_envs=3, actuator="lag", bounds=True)
    seen = [env.reset(seed=0)]
    actions = np.full((3, len(env.agents), 3), 0.5)
    for _ in range(3):
        seen += [env.step(actions), (env.state(),), (env.observations(),)]
    seen.append(env.reset(env_ids=[1]))
    frozen = copy.deepcopy(seen)
    env.step(actions)
    assert same(seen, frozen)
    for one, other in itertools.combinations(seen, 2):
        assert not any(np.shares_memory(a, b) for a, b in itertools.product(arrays(one), arrays(other)))
    for one, other in itertools.combinations(arrays(seen[1]), 2):
        assert not np.shares_memory(one, other)
    assert all(one.flags.writeable and 0 not in one.strides for one in arrays(seen))


@every
def test_writing_into_what_was_returned_changes_nothing(environment, name):
    """Observations, rewards, infos, actions, states and saved states belong to whoever got them."""
    spoilt, clean = (parallel(environment, name, actuator="slew", max_cycles=4) for _ in range(2))
    rng = np.random.default_rng(5)
    assert same(spoilt.reset(seed=2), clean.reset(seed=2))
    for _ in range(6):
        if not clean.agents:
            assert same(spoilt.reset(), clean.reset())
        actions = random_actions(clean, rng)
        expected = copy.deepcopy(clean.step(actions))
        got = spoilt.step(actions)
        assert same(got, expected)
        for one in [*arrays(got), *arrays(actions), spoilt.state(), spoilt.observe(spoilt.possible_agents[0])]:
            one[...] = np.nan
        for one in got:
            one["__all__"] = one.pop(spoilt.possible_agents[0])
        saved = spoilt.get_state()
        for one in (saved.simulator.x, *saved.simulator.memory.values(), saved.inputs):
            one[...] = np.nan
        for values in saved.task.values():
            values[...] = np.nan
        saved.generators[0].random(3)
    assert same(state(spoilt), state(clean))


@every
def test_the_public_checks_pass(environment, name):
    """All of `check_environment`, over several episodes, with a lagging input and bounds."""
    require_contract(partial(parallel, environment, name, max_cycles=20, actuator="lag", bounds=True), steps=50)


@every
def test_300_steps_are_the_same_bits_for_the_same_seed(environment, name):
    """Over several episodes, of which only the first is seeded; with all disturbances (mixed_fleet has every kind)."""
    require_contract(partial(parallel, environment, name, max_cycles=120), "same_seed")


@every
def test_another_seed_changes_every_agent_s_observations(environment, name):
    def run(seed):
        env = parallel(environment, name, max_cycles=120)
        return [env.reset(seed=seed), *play(env, 20, seed=9)]

    for mine, its in zip(run(7), run(8), strict=True):
        assert all(not np.array_equal(mine[0][agent], its[0][agent]) for agent in mine[0])


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["copy", "pickle"])
@every
def test_copies_continue_bit_for_bit(environment, name, copied):
    """In the middle of an episode, over its end, and over the next resets, which aren't seeded."""
    env = parallel(environment, name, max_cycles=7, actuator="lag")
    env.reset(seed=1)
    play(env, 4)
    twin = copied(env)
    expected = play(env, 20, seed=3)
    assert same(play(twin, 20, seed=3), expected)
    assert same(state(twin), state(env))
    env.reset(seed=1)  # and playing on with one doesn't move the other
    assert not same(state(twin), state(env))


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_copies_of_a_never_seeded_environment_differ(environment):
    """Fresh entropy at every reset, as worker processes that each unpickle one instance need it."""
    for env in (parallel(environment), parallel(environment, "mixed_fleet")):
        played = parallel(environment)
        played.reset()
        stored = pickle.dumps(env), pickle.dumps(played)
        states = [pickle.loads(one) for one in stored * 2]
        for one in states:
            one.reset()
        drawn = [one.get_state().simulator for one in states]
        for one, other in itertools.combinations(drawn, 2):
            if one.x.shape == other.x.shape:
                assert np.all(one.x != other.x)
                assert not np.array_equal(one.drawn, other.drawn)


@every
def test_saved_states_are_exact(environment, name):
    """get_state and set_state, into the same and into a fresh environment, before and after the end of an episode."""
    env = parallel(environment, name, max_cycles=5, actuator="lag")
    fresh = parallel(environment, name, max_cycles=5, actuator="lag")
    env.reset(seed=1)
    for before in (0, 3, 2):  # 0: at the start; 3: in the middle; then after the end
        play(env, before)
        saved = env.get_state()
        stored = pickle.dumps(saved)
        observed, agents = [env.observe(agent) for agent in env.possible_agents], list(env.agents)
        expected = play(env, 12, seed=3)
        for one in (env, fresh):
            one.set_state(pickle.loads(stored))
            assert one.agents == agents
            assert same([one.observe(agent) for agent in one.possible_agents], observed)
            assert same(play(one, 12, seed=3), expected)
        env.set_state(saved)
        assert same(pickle.dumps(saved), stored)
    assert env.agents == []


def test_saved_states_keep_whether_an_environment_was_seeded():
    """After set_state a never-seeded environment still draws fresh entropy, and a seeded one goes on with its own."""
    env = parallel("consensus_v0")
    env.reset()
    unseeded = env.get_state()
    env.reset(seed=0)
    seeded = env.get_state()
    drawn = {}
    for which, saved in {"unseeded": unseeded, "seeded": seeded}.items():
        for number in range(2):
            env.set_state(saved)
            env.reset()
            drawn[which, number] = env.get_state().simulator.x
    assert np.all(drawn["unseeded", 0] != drawn["unseeded", 1])
    np.testing.assert_array_equal(drawn["seeded", 0], drawn["seeded", 1])
