"""Rows of the Stable-Baselines3 vector environment one by one: seeds, options, attributes and methods."""

import dataclasses

import numpy as np
import pytest
from stable_baselines3.common.vec_env import VecMonitor

from khop_env import make_sb3_vec, make_vec
from tests.env.playing import built, same

COPIES = 2


def sb3(**arguments):
    return make_sb3_vec("consensus_v0", COPIES, scenario=built("paper"), **arguments)


def actions_for(env, cycles):
    shape = (cycles, env.num_envs, *env.action_space.shape)
    return np.random.default_rng(0).uniform(-1.0, 1.0, shape).astype(np.float32)


def test_attributes_and_methods_as_stable_baselines3_calls_them():
    """Its own tests of get_attr, set_attr and env_method, as far as rows that share an environment can have them."""
    env = sb3()
    rows = env.num_envs
    assert env.get_attr("agents") == [env.batched.agents] * rows
    assert len(env.get_attr("agents", indices=[0, -1])) == len(env.get_attr("agents", np.array([2, 3]))) == 2
    assert len(env.get_attr("agents", indices=3)) == 1
    assert (env.has_attr("agents"), env.has_attr("nothing")) == (True, False)
    env.reset()
    assert len(env.env_method("observations")) == rows
    assert len(env.env_method("reset", 3)) == rows
    short = dataclasses.replace(env.batched.settings, max_cycles=1)
    assert env.set_attr("settings", short, indices=list(range(rows))) is None
    assert env.get_attr("settings") == [short] * rows
    assert env.step(actions_for(env, 1)[0])[2].all()


@pytest.mark.parametrize("row", [16, -17])
def test_rows_that_there_are_not_are_refused(row):
    env = sb3()
    calls = (
        lambda: env.get_attr("agents", [0, row]),
        lambda: env.set_attr("agents", (), row),
        lambda: env.env_method("observations", indices=[row]),
        lambda: env.env_is_wrapped(VecMonitor, [row]),
    )
    for call in calls:
        with pytest.raises(IndexError, match=f"no row {row}: there are 16"):
            call()


def test_what_changes_all_rows_is_refused_for_some():
    """Rows of a copy are agents of one environment; nothing has changed then."""
    env, clean = sb3(), sb3()
    for one in (env, clean):
        one.seed(0)
        one.reset()
    shared = "rows share one environment: {} for all 16 of them, not for 1"
    with pytest.raises(AttributeError, match=shared.format("'settings' can be set")):
        env.set_attr("settings", None, indices=0)
    with pytest.raises(AttributeError, match="the environment has no attribute 'limit' that could be set"):
        env.set_attr("limit", 3.0)
    with pytest.raises(AttributeError, match=shared.format("'reset' can be called")):
        env.env_method("reset", indices=[5])
    actions = actions_for(env, 1)[0]
    assert same(env.step(actions), clean.step(actions))


def test_seed_starts_copies_from_its_own_seeds():
    """After seed(5) copy b starts from 5 + b, once: the next reset goes on."""
    env = sb3()
    other = make_vec("consensus_v0", COPIES, autoreset_mode="same_step", scenario=built("paper"))
    env.seed(5)
    first = env.reset()
    assert first.tobytes() == other.reset(seed=5)[0].tobytes()
    following = env.reset()
    assert following.tobytes() == other.reset()[0].tobytes() != first.tobytes()
    env.seed(5)
    assert env.reset().tobytes() == first.tobytes()


def test_seeds_of_rows_are_those_of_their_copies():
    env = sb3()
    assert env.seed(5) == [5] * 8 + [6] * 8
    env.seed()
    drawn = env.reset().reshape(COPIES, -1)
    assert not np.array_equal(*drawn)


def test_options_reach_the_copies():
    env = sb3()
    env.set_options({"initial_state": {"drifter_3": [0.5, -0.25]}})
    env.reset()
    np.testing.assert_array_equal(env.batched.simulator.x[:, 6:8], [[0.5, -0.25]] * 2)
    env.reset()  # they hold once
    assert not np.any(env.batched.simulator.x[:, 6:8] == [0.5, -0.25])


def test_options_of_each_row_reach_its_copy():
    """Rows of a copy are put together; what they leave out, and a copy without any, is drawn as ever."""
    env, clean = sb3(), sb3()
    options = [{} for _ in range(env.num_envs)]
    options[8 + 3] = {"initial_state": {"drifter_3": [0.5, -0.25]}}
    options[8 + 4] = {"initial_state": {"drifter_4": [0.1, 0.2]}}
    options[8 + 5] = {"initial_state": {"drifter_3": [0.5, -0.25]}}  # said twice, but the same
    options[15] = None
    for one in (env, clean):
        one.seed(3)
    env.set_options(options)
    rows, its = env.reset(), clean.reset()
    assert rows[:8].tobytes() == its[:8].tobytes()
    x, expected = env.batched.simulator.x, clean.batched.simulator.x.copy()
    expected[1, 6:10] = [0.5, -0.25, 0.1, 0.2]
    np.testing.assert_array_equal(x, expected)
    actions = actions_for(env, 1)[0]
    assert env.step(actions)[0][:8].tobytes() == clean.step(actions)[0][:8].tobytes()


def test_whole_states_of_each_row():
    """A fleet's own for each copy, or all copies' for everybody."""
    env = sb3()
    x0 = np.arange(2.0 * env.batched.fleet.n).reshape(2, -1) / 100.0
    env.set_options([{"initial_state": x0[row // 8]} for row in range(env.num_envs)])
    env.reset()
    np.testing.assert_array_equal(env.batched.simulator.x, x0)
    env.reset()
    env.set_options({"initial_state": x0})
    env.reset()
    np.testing.assert_array_equal(env.batched.simulator.x, x0)


def test_options_that_do_not_fit_are_refused():
    env = sb3()
    n = env.batched.fleet.n
    message = "options are a dictionary, or a list with one for each of the 16 rows; got 2"
    with pytest.raises(ValueError, match=message):
        env.set_options([{}, {}])
    with pytest.raises(ValueError, match=r"options are a dictionary, as {'initial_state': ...}; got 3 \(int\)"):
        env.set_options([3] * 16)
    env.set_options([{"initial_state": {"drifter_0": [0.1 * row, 0.0]}} for row in range(16)])
    with pytest.raises(
        ValueError, match="row 1 and a row before it are agents of environment 0, and give the same states"
    ):
        env.reset()
    env.set_options([{"initial_state": np.zeros((3, n))}] * 16)
    with pytest.raises(ValueError, match=r"or an array of shape \(16,\) or \(2, 16\); got \(3, 16\) for row 0"):
        env.reset()
    env.set_options([{"initial_state": {"drifter_9": [0.0, 0.0]}}] * 16)
    with pytest.raises(ValueError, match="option initial_state: no agent 'drifter_9'"):
        env.reset()
    env.set_options()
    env.reset()
