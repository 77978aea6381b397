"""Saved states go into environments of their own kind only, and a refusal leaves no trace."""

import networkx as nx
import numpy as np
import pytest

from khop_env import consensus_v0, scenario
from khop_env.env import Lag
from khop_env.network import Fixed, Outage, RandomLinks
from khop_env.observers import Exponential
from khop_env.physics import Sinusoid
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


def paper_with(**changes):
    return {"scenario": scenario("paper").replace(**changes)}


def star(k):
    """Everybody is within two hops: a third changes no size."""
    graph = nx.star_graph(7)
    return {"scenario": scenario("paper").replace(communication=graph, task=graph, k=k)}


@pytest.mark.parametrize(
    ("theirs", "mine", "differing"),
    [
        (
            {"control_period": 0.1},
            {},
            "control periods differ: 0.1 s in 1 steps of order 1 there, 0.05 s in 1 steps of order 1 here",
        ),
        ({}, {"dt": 0.01}, "control periods differ: 0.05 s in 1 steps of order 1 there, 0.05 s in 5 steps of order 1"),
        ({"order": 2}, {}, "control periods differ: .* order 2 there, .* order 1 here"),
        (
            paper_with(disturbance=Sinusoid(0.2)),
            paper_with(disturbance=Sinusoid(0.1)),
            r"disturbances differ: Sinusoid\(amplitude=0.2, .*\) there, Sinusoid\(amplitude=0.1, .*\) here",
        ),
        (
            paper_with(disturbance=None),
            paper_with(disturbance=Sinusoid(0.0)),
            r"disturbances differ: none there, Sinusoid\(amplitude=0.0, .*\) here",
        ),
        (
            paper_with(delta=Exponential(90.0, 0.5, 5.0)),
            paper_with(delta=Exponential(90.0, 0.4, 5.0)),
            r"bounds differ: Exponential\(.*final=0.5, rate=5.0\) there, Exponential\(.*final=0.4, rate=5.0\) here",
        ),
        (
            paper_with(theta=Exponential(300.0, 1.5, 5.0)),
            paper_with(theta=Exponential(300.0, 1.5, 4.0)),
            r"bounds differ: .* there, Exponential\(.*rate=4.0\) here",
        ),
        (
            paper_with(schedule=RandomLinks(0.5)),
            paper_with(schedule=RandomLinks(0.6)),
            r"schedules differ: RandomLinks\(probability=0.5, .*\) there, RandomLinks\(.*0.6, .*here",
        ),
        (
            paper_with(schedule=Fixed(nx.path_graph(3))),
            paper_with(schedule=Fixed(nx.path_graph(2)) & Outage(1.0, 1.0)),
            r"schedules differ: Fixed\(graph=\[\(0, 1\), \(1, 0\), \(1, 2\), \(2, 1\)\]\) there, "
            r"Fixed\(graph=\[\(0, 1\), \(1, 0\)\]\), Outage\(.*\) here",
        ),
        (
            star(2),
            star(3),
            "numbers of hops differ: k = 2 there, k = 3 here; make both with the same arguments",
        ),
    ],
)
def test_states_of_another_period_order_disturbance_bound_or_number_of_hops_are_refused(theirs, mine, differing):
    """All of the same size, so that nothing but words tells them apart."""
    env, clean = (consensus_v0.parallel_env(**mine) for _ in range(2))
    other = consensus_v0.parallel_env(**theirs)
    other.reset(seed=0)
    assert same(env.reset(seed=1), clean.reset(seed=1))
    with pytest.raises(ValueError, match=f"can't restore: the state is of another environment, the {differing}"):
        env.set_state(other.get_state())
    assert same(state(env), state(clean))
    assert same(play(env, 2), play(clean, 2))


class Floor:
    """A bound of a user's own, without a repr."""

    def __call__(self, t):
        return np.full_like(t, 90.0)

    def infimum(self):
        return 90.0


def test_bounds_of_one_s_own_are_known_by_their_class():
    """Not by where an object is in memory: the same scenario, made twice, is the same."""
    env, other = (consensus_v0.parallel_env(**paper_with(delta=Floor())) for _ in range(2))
    env.reset(seed=1)
    other.set_state(env.get_state())
    assert same(play(other, 2), play(env, 2))
    with pytest.raises(ValueError, match=r"bounds differ: Floor there, Exponential\(.*\) here"):
        parallel("consensus_v0").set_state(env.get_state())


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


def test_schedules_are_known_by_their_links():
    """Not by the objects that hold them, and not by their order."""
    there, here = nx.Graph([(0, 1), (1, 2), (5, 4)]), nx.Graph([(4, 5), (2, 1), (1, 0)])
    env, other = (consensus_v0.parallel_env(**paper_with(schedule=Fixed(graph))) for graph in (there, here))
    env.reset(seed=1)
    other.set_state(env.get_state())
    assert same(play(other, 2), play(env, 2))
