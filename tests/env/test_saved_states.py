"""Saved states go into environments of their own kind only, and a refusal leaves no trace."""

import numpy as np
import pytest

from khop_env import consensus_v0
from khop_env.env import Lag
from tests.env.playing import batched, parallel, play, same, state


def test_states_of_other_environments_are_refused_and_change_nothing():
    """Of other scenarios, other numbers of copies, and other tasks on the same fleet."""
    env, clean = parallel("leader_following_v0", "convoy"), parallel("leader_following_v0", "convoy")
    assert same(env.reset(seed=1), clean.reset(seed=1))
    others = [
        batched("leader_following_v0", "mixed_fleet"),
        batched("leader_following_v0", "convoy", num_envs=2),
        batched("consensus_v0", "convoy"),
        batched("leader_following_v0", "convoy", leaders=["drifter_0", "drifter_3", "drifter_6", "drifter_7"]),
    ]
    for other in others:
        other.reset(seed=0)
        with pytest.raises(ValueError, match="can't restore"):
            env.set_state(other.get_state())
        assert same(state(env), state(clean))
    assert same(play(env, 2), play(clean, 2))


@pytest.mark.parametrize(
    ("theirs", "mine", "differing"),
    [
        (("consensus_v0", {}), ("formation_v0", {}), "tasks differ: consensus there, formation here"),
        (
            ("consensus_v0", {}),
            ("consensus_v0", {"actuator": "lag"}),
            r"actuators differ: Direct\(\) there, Lag\(time_constant=0.1\) here",
        ),
        (
            ("consensus_v0", {"actuator": Lag(0.2)}),
            ("consensus_v0", {"actuator": "lag"}),
            r"actuators differ: Lag\(time_constant=0.2\) there",
        ),
        (
            ("formation_v0", {"spacing": 2.0}),
            ("formation_v0", {}),
            r"task edges differ: drifter_0 to drifter_1 by \[-0.765.*, -?[.0-9]*\] m, drifter_0 .*, \.\.\. there",
        ),
        (
            ("leader_following_v0", {"leader_speed": 0.5}),
            ("leader_following_v0", {"leader_speed": 0.25}),
            "leaders differ: .*_0 at 0.5 m/s, .* there, .*_0 at 0.25 m/s",
        ),
        (
            ("leader_following_v0", {"leaders": ["drifter_0", "drifter_3"]}),
            ("leader_following_v0", {"leaders": ["drifter_0", "drifter_3", "drifter_5"]}),
            "leaders differ: no others there, drifter_5 at .* here",
        ),
    ],
)
def test_states_of_the_same_size_but_of_another_task_or_actuator_are_refused(theirs, mine, differing):
    env, clean = (parallel(mine[0], **mine[1]) for _ in range(2))
    other = parallel(theirs[0], **theirs[1])
    other.reset(seed=0)
    assert same(env.reset(seed=1), clean.reset(seed=1))
    with pytest.raises(ValueError, match=f"can't restore: the state is of another environment, the {differing}"):
        env.set_state(other.get_state())
    assert same(state(env), state(clean))
    assert same(play(env, 2), play(clean, 2))


class Halved:
    def __call__(self, command, u, dt, step, steps):
        return 0.5 * command


def test_actuators_of_one_s_own_are_known_by_their_class():
    env, other = (parallel("consensus_v0", actuator=Halved()) for _ in range(2))
    env.reset(seed=1)
    other.set_state(env.get_state())
    assert same(play(other, 2), play(env, 2))
    with pytest.raises(ValueError, match=r"actuators differ: Halved there, Direct\(\) here"):
        parallel("consensus_v0").set_state(env.get_state())


@pytest.mark.parametrize("given", [3, None, {"x": 1.0}])
def test_what_is_no_state_is_refused(given):
    env, clean = parallel("consensus_v0"), parallel("consensus_v0")
    assert same(env.reset(seed=1), clean.reset(seed=1))
    for refusing in (env, env.batched):
        with pytest.raises(TypeError, match=r"takes what get_state\(\) returned, an EnvState; got .* \(\w+\)"):
            refusing.set_state(given)
    assert same(play(env, 2), play(clean, 2))


def test_a_restored_environment_can_be_rendered():
    """Also one that was never reset itself; the picture is that of the restored state."""
    env, fresh = (consensus_v0.parallel_env(render_mode="rgb_array") for _ in range(2))
    env.reset(seed=3)
    fresh.set_state(env.get_state())
    np.testing.assert_array_equal(fresh.render(), env.render())
