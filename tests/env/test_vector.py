"""The Gymnasium vector environment: every row is an agent of a single environment, bit for bit, autoreset included."""

import copy
import itertools
import pickle

import numpy as np
import pytest
from gymnasium.vector import AutoresetMode

from khop_env import make_vec
from khop_env.testing import arrays
from tests.env.playing import EVERY, built, ends_within, info_keys, parallel, same

COPIES, CYCLES = 3, 17
every = pytest.mark.parametrize(("environment", "name"), EVERY)


def vector(environment="consensus_v0", name="paper", copies=COPIES, autoreset_mode="same_step", **arguments):
    return make_vec(environment, copies, autoreset_mode=autoreset_mode, scenario=built(name), **arguments)


def actions_for(env, cycles, scale=1.3):
    return np.random.default_rng(0).uniform(-scale, scale, (cycles, *env.action_space.shape)).astype(np.float32)


def singles(environment, name, copies, **arguments):
    return [parallel(environment, name, **arguments) for _ in range(copies)]


def require_same_rows(env, b, rows, by_agent):
    """Rows of copy b against one single environment's dictionary."""
    agents = env.batched.agents
    for i, agent in enumerate(agents):
        mine, its = rows[b * len(agents) + i], by_agent[agent]
        assert np.asarray(mine).tobytes() == np.asarray(its).tobytes(), (b, agent)


@pytest.mark.parametrize("actuator", ["direct", "lag"])
@every
def test_rows_are_agents_of_single_environments(environment, name, actuator):
    """Row b * N + i is agent i of a ParallelEnv with seed + b, over several episodes, whose ends are in final_obs."""
    # with a success radius the copies end at different times, some by termination and some by truncation
    radius = {"consensus_v0": 1.9, "formation_v0": 2.3, "leader_following_v0": 2.0, "navigation_v0": 2.9}[environment]
    radius *= 3.0 if name == "mixed_fleet" else 1.0
    arguments = {"max_cycles": 6, "actuator": actuator, "observe": "estimate", "bounds": True}
    arguments |= ends_within(environment, radius)
    env, others = vector(environment, name, **arguments), singles(environment, name, COPIES, **arguments)
    count = len(env.batched.agents)
    rows, infos = env.reset(seed=11)
    for b, other in enumerate(others):
        observations, its = other.reset(seed=11 + b)
        require_same_rows(env, b, rows, observations)
        for key in info_keys(environment):
            require_same_rows(env, b, infos[key], {agent: its[agent][key] for agent in its})
    ended = 0
    for actions in actions_for(env, CYCLES):
        rows, rewards, terminated, truncated, infos = env.step(actions)
        assert rows.dtype == np.float32
        assert env.observation_space.contains(rows)
        for b, other in enumerate(others):
            part = slice(b * count, (b + 1) * count)
            observations, reward, term, trunc, its = other.step(
                dict(zip(other.possible_agents, actions[part], strict=True))
            )
            require_same_rows(env, b, rewards, reward)
            require_same_rows(env, b, terminated, term)
            require_same_rows(env, b, truncated, trunc)
            over = not other.agents
            assert ("final_obs" in infos and infos["_final_obs"][part].all()) == over
            if over:
                ended += 1
                require_same_rows(env, b, infos["final_obs"], observations)
                for key in info_keys(environment):
                    require_same_rows(env, b, infos["final_info"][key], {one: its[one][key] for one in its})
                observations, its = other.reset()
            elif "final_obs" in infos:
                assert not infos["_final_obs"][part].any()
                assert all(one is None for one in infos["final_obs"][part])
                assert not any(infos["final_info"][f"_{key}"][part].any() for key in info_keys(environment))
            require_same_rows(env, b, rows, observations)
            for key in info_keys(environment):
                require_same_rows(env, b, infos[key], {one: its[one][key] for one in its})
                assert infos[f"_{key}"].all()
    assert ended >= 2 * COPIES


def test_autoreset_is_declared_and_in_the_same_step():
    """metadata says SAME_STEP; the horizon truncates all copies at once, and the next episode runs to its own."""
    env = vector(max_cycles=3)
    assert env.metadata["autoreset_mode"] is AutoresetMode.SAME_STEP
    assert env.num_envs == COPIES * 8
    rows, _ = env.reset(seed=0)
    first = rows
    for number, actions in enumerate(actions_for(env, 9), start=1):
        rows, _, terminated, truncated, infos = env.step(actions)
        assert not terminated.any()
        assert (truncated.all(), truncated.any()) == ((number % 3 == 0),) * 2
        assert ("final_obs" in infos) == (number % 3 == 0)
        if number % 3 == 0:
            assert not np.array_equal(rows, np.stack(infos["final_obs"]))
            assert np.all(env.batched.simulator.t == 0.0)
            assert not np.array_equal(rows, first)  # the next episode is another one


def test_copies_that_end_alone_leave_the_others_running():
    """Only the copy whose agents have met terminates, is reset, and has a final observation."""
    env = vector(success_radius=0.05, max_cycles=50)
    n = env.batched.fleet.n
    x0 = env.batched.simulator.initial.center + np.random.default_rng(0).uniform(-1.0, 1.0, (COPIES, n))
    x0[1] = 0.3
    env.reset(seed=0, options={"initial_state": x0})
    _, _, terminated, truncated, infos = env.step(np.zeros(env.action_space.shape, np.float32))
    np.testing.assert_array_equal(terminated, np.repeat([False, True, False], 8))
    np.testing.assert_array_equal(infos["_final_obs"], terminated)
    np.testing.assert_array_equal(env.batched.simulator.t, [0.05, 0.0, 0.05])
    assert not truncated.any()
    assert np.all(infos["final_info"]["task_error"][8:16] <= 0.05)
    assert np.all(infos["task_error"][8:16] > 0.05)


def test_a_list_of_seeds_and_one_seed():
    """seed=5 is 5, 6, 7; each copy may have its own; without one the copies go on with their generators."""
    env = vector()
    first = env.reset(seed=5)
    following = env.reset()
    assert same(env.reset(seed=[5, 6, 7]), first)
    assert same(env.reset(), following)
    rows, _ = env.reset(seed=[6, 6, None])
    assert rows[:8].tobytes() == rows[8:16].tobytes() == first[0][8:16].tobytes()
    assert rows[16:].tobytes() != following[0][16:].tobytes()


def test_never_seeded_copies_differ():
    """Fresh entropy for each copy and each reset."""
    env = vector()
    drawn = [env.reset()[0].reshape(COPIES, -1) for _ in range(2)]
    for one, other in itertools.combinations([*drawn[0], *drawn[1]], 2):
        assert not np.array_equal(one, other)


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["copy", "pickle"])
def test_copies_continue_bit_for_bit(copied):
    """Over the end of an episode and autoreset, with leaders and all disturbances."""
    env = vector("leader_following_v0", "mixed_fleet", max_cycles=5)
    env.reset(seed=1)
    actions = actions_for(env, 14)
    for one in actions[:3]:
        env.step(one)
    twin = copied(env)
    expected = [env.step(one) for one in actions[3:]]
    assert same([twin.step(one) for one in actions[3:]], expected)


def test_steps_share_no_memory():
    """Rows, rewards, flags, infos and final observations of different steps, and of the actions given."""
    env = vector(max_cycles=2)
    actions = actions_for(env, 5)
    seen = [(actions,), env.reset(seed=0), *(env.step(one) for one in actions)]
    frozen = copy.deepcopy(seen)
    env.step(actions[0])
    env.step(actions[1])
    assert same(seen, frozen)
    for one, other in itertools.combinations(seen, 2):
        assert not any(np.shares_memory(a, b) for a, b in itertools.product(arrays(one), arrays(other)))
    final, rows = seen[3][-1]["final_obs"], seen[3][0]
    assert not np.shares_memory(final[0], rows)
    for one in seen[3][-1].values():
        for two in seen[3][-1]["final_info"].values():
            assert one is not two


def test_one_copy_and_many_copies_are_the_same_bits():
    """The batch size changes nothing: copy 0 of 40 is the only copy of 1 (tiles of 32 in the readout)."""
    one, many = vector("formation_v0", "mixed_fleet", 1), vector("formation_v0", "mixed_fleet", 40)
    count = one.num_envs
    assert one.reset(seed=3)[0].tobytes() == many.reset(seed=3)[0][:count].tobytes()
    last = vector("formation_v0", "mixed_fleet", 1)
    last.reset(seed=3 + 39)
    for actions in actions_for(many, 4):
        rows = many.step(actions)[0]
        assert one.step(actions[:count])[0].tobytes() == rows[:count].tobytes()
        assert last.step(actions[-count:])[0].tobytes() == rows[-count:].tobytes()


# -- what it refuses -----------------------------------------------------------------------------------------------


def bad_actions(env):
    """(actions, what the message says)."""
    good = np.zeros(env.action_space.shape, np.float32)
    nan, infinite = good.copy(), good.astype(float)
    nan[10, 1], infinite[17, 0] = np.nan, -np.inf
    return [
        (nan, r"the action of 'drifter_2' in environment 1 isn't finite: entry 1 is nan"),
        (infinite, r"the action of 'drifter_1' in environment 2 isn't finite: entry 0 is -inf"),
        (good[:-1], r"actions must have shape \(24, 2\); got \(23, 2\)"),
        (good.reshape(3, 8, 2), r"actions must have shape \(24, 2\); got \(3, 8, 2\)"),
        (good.T, r"actions must have shape \(24, 2\); got \(2, 24\)"),
        (good.astype(str), r"actions must be numbers of shape \(3, 8, 2\); got <U"),
        (good.astype(object), r"actions must be numbers of shape \(3, 8, 2\); got object"),
        (good.astype(bool), r"actions must be numbers of shape \(3, 8, 2\); got bool"),
    ]


@pytest.mark.parametrize("case", range(8))
def test_bad_actions_are_refused_and_change_nothing(case):
    """The message says what, where and what is expected, and a corrected call follows as if nothing had been."""
    env, clean = vector(max_cycles=3), vector(max_cycles=3)
    assert same(env.reset(seed=1), clean.reset(seed=1))
    bad, message = bad_actions(env)[case]
    for actions in actions_for(env, 5):
        with pytest.raises(ValueError, match=message):
            env.step(bad)
        assert same(env.step(actions), clean.step(actions))


def test_bad_resets_are_refused_and_change_nothing():
    """Too few seeds, a negative one among good ones, and initial states that don't fit."""
    env, clean = vector("leader_following_v0"), vector("leader_following_v0")
    assert same(env.reset(seed=1), clean.reset(seed=1))
    n = env.batched.fleet.n
    for arguments, message in (
        ({"seed": [1, 2]}, "expected one seed or 3, one per environment that is reset; got 2"),
        ({"seed": [1, 2, -3]}, "a seed must be a non-negative integer, or None; got -3"),
        ({"seed": -1}, "a seed must be a non-negative integer, or None; got -1"),
        ({"options": {"initial_state": np.zeros((2, n))}}, rf"x0 must be finite, of shape \({n},\) or \(3, {n}\)"),
        ({"options": {"initial_state": np.full(n, np.inf)}}, "must be finite"),
        ({"options": [1]}, r"options are a dictionary, as {'initial_state': ...}; got \[1\] \(list\)"),
    ):
        with pytest.raises(ValueError, match=message):
            env.reset(**arguments)
    for actions in actions_for(env, 3):
        assert same(env.step(actions), clean.step(actions))
    assert same(env.reset(), clean.reset())


@pytest.mark.parametrize(
    ("copies", "message"),
    [
        ([0, 3], r"must be different indices from 0 to 2; got \[0, 3\]"),
        ([-1], r"from 0 to 2; got \[-1\]"),
        ([1, 1], r"different indices .* got \[1, 1\]"),
        (np.array([True, False, True]), r"not a mask: give np.flatnonzero\(mask\)"),
    ],
)
def test_copies_that_there_are_not_are_refused_and_change_nothing(copies, message):
    """A mask isn't read as numbers."""
    env, clean = vector(), vector()
    assert same(env.reset(seed=1), clean.reset(seed=1))
    with pytest.raises(ValueError, match=message):
        env.batched.reset(env_ids=copies)
    assert same(env.reset(), clean.reset())


def test_ragged_observations_have_no_rows():
    with pytest.raises(ValueError, match="a vector environment has one space for all rows: it needs uniform=True"):
        vector(uniform=False)


@pytest.mark.parametrize("mode", ["same_step", "next_step", "disabled"])
def test_a_step_before_the_first_reset_is_refused(mode):
    env = vector(autoreset_mode=mode)
    with pytest.raises(
        ValueError, match=r"no episode is running in 3 of 3 environments, the first 0: call reset\(\) first"
    ):
        env.step(np.zeros(env.action_space.shape))


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"environment": "consensus_v1"}, ValueError, "no environment 'consensus_v1'; did you mean 'consensus_v0'"),
        ({"environment": "leader_folowing_v0"}, ValueError, "did you mean 'leader_following_v0'"),
        ({"scenario": "papr"}, ValueError, "no scenario 'papr'; did you mean 'paper'"),
        ({"max_cycle": 3}, TypeError, "got an unexpected keyword argument 'max_cycle'; did you mean 'max_cycles'"),
        ({"autoreset_mode": "nextstep"}, ValueError, "must be 'same_step', 'next_step', 'disabled' .* got 'nextstep'"),
        ({"num_envs": 0}, ValueError, "num_envs must be a positive integer; got 0"),
    ],
)
def test_names_that_there_are_not_are_refused_with_the_nearest(arguments, error, message):
    with pytest.raises(error, match=message):
        make_vec(**{"environment": "consensus_v0", **arguments})
