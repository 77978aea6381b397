"""Tasks: displacements, leaders, and rewards, which are the documented formula of the true states."""

import math

import networkx as nx
import numpy as np
import pytest

from khop_env import leader_following_v0
from khop_env.observers import Exponential, ObserverDesign
from khop_env.physics import Fleet, SingleIntegrator
from khop_env.registry import make_batched
from khop_env.tasks import EdgeTask, Formation, World
from tests.env.playing import ALONG_EDGES, EVERY_ALONG_EDGES, SCENARIOS, batched, built, parallel, play, random_actions

every = pytest.mark.parametrize(("environment", "name"), EVERY_ALONG_EDGES)
scenarios = pytest.mark.parametrize("name", SCENARIOS)


# -- rewards and ends ----------------------------------------------------------------------------------------------


def mean_square_error(env, agent):
    """Over the agent's task edges, from the true positions."""
    task, fleet = env.batched.task, env.batched.fleet
    positions = env.batched.simulator.x[0][fleet.position_index]
    mine = np.flatnonzero(task.edges[:, 0] == fleet.agent(agent))
    misses = [positions[j] - positions[i] - d for (i, j), d in zip(task.edges[mine], task.displacement[mine])]  # noqa: B905
    return np.mean([miss @ miss for miss in misses]) if misses else 0.0


@pytest.mark.parametrize("actuator", ["direct", "lag"])
@every
def test_rewards_are_the_documented_formula(environment, name, actuator):
    """-control_period * (mean over task edges of |p_j - p_i - d_ij|^2 + effort * |u_i|^2), of inputs after clipping."""
    env = parallel(environment, name, effort=0.7, control_period=0.04, actuator=actuator, uniform=False)
    _, infos = env.reset(seed=1)
    rng = np.random.default_rng(0)
    for _ in range(3):
        for agent, info in infos.items():
            assert info["task_error"] == pytest.approx(math.sqrt(mean_square_error(env, agent)), rel=1e-12)
        actions = random_actions(env, rng, 1.5)
        _, rewards, _, _, infos = env.step(actions)
        fleet, inputs = env.batched.fleet, env.get_state().inputs[:, 0]
        for agent in env.possible_agents:
            u = inputs[fleet.input_slice(fleet.agent(agent))]
            if actuator == "direct":
                np.testing.assert_allclose(u, np.clip(actions[agent], -1.0, 1.0))
            expected = -0.04 * (mean_square_error(env, agent) + 0.7 * u @ u)
            assert rewards[agent] == pytest.approx(expected, rel=1e-12)


@every
def test_a_team_reward_is_the_mean_of_all(environment, name):
    own, team = (parallel(environment, name, reward=reward) for reward in ("agent", "team"))
    own.reset(seed=1)
    team.reset(seed=1)
    for mine, its in zip(play(own, 3), play(team, 3), strict=True):
        assert len(set(its[1].values())) == 1
        assert next(iter(its[1].values())) == pytest.approx(np.mean(list(mine[1].values())), rel=1e-12)
        assert len(set(mine[1].values())) > 1


@pytest.mark.parametrize("environment", ALONG_EDGES)
def test_success_terminates_when_the_worst_agent_is_near_enough(environment):
    """Exactly when no task error exceeds the radius; that isn't a truncation, even at the horizon."""
    env = parallel(environment, max_cycles=30)
    env.reset(seed=4)
    worst = [max(info["task_error"] for info in one[-1].values()) for one in play(env, 30)]
    first = int(np.argmin(worst))
    for radius, ends in ((worst[first], first), (np.nextafter(worst[first], 0.0), None)):
        for horizon in (30, first + 1):
            env = parallel(environment, max_cycles=horizon, success_radius=radius)
            env.reset(seed=4)
            seen = play(env, horizon if ends is None else first + 1)
            for number, (_, _, terminated, truncated, _) in enumerate(seen):
                success = ends is not None and worst[number] <= radius
                assert set(terminated.values()) == {success}
                assert set(truncated.values()) == {not success and number + 1 == horizon}
            assert env.agents == []


# -- formation -----------------------------------------------------------------------------------------------------


@scenarios
def test_formations_can_be_reached(name):
    """Displacements are differences of points: they cancel both ways and around every cycle of the task graph."""
    built_ = built(name)
    task = batched("formation_v0", name, num_envs=1).task
    wanted = dict(zip(map(tuple, task.edges.tolist()), task.displacement, strict=True))
    assert set(wanted) == {*built_.task.edges, *((j, i) for i, j in built_.task.edges)}
    for (i, j), displacement in wanted.items():
        np.testing.assert_array_equal(displacement, -wanted[j, i])
        assert np.linalg.norm(displacement) > 0.5
    for cycle in nx.cycle_basis(built_.task):
        total = sum(wanted[i, j] for i, j in zip(cycle, cycle[1:] + cycle[:1], strict=True))
        np.testing.assert_allclose(total, 0.0, atol=1e-12)


@pytest.mark.parametrize("agents", [5, 12, 13, 30])
def test_default_neighbours_are_the_spacing_apart(agents):
    """On a ring up to 12 agents, and in a square grid of more; nobody stands on another's place."""
    fleet = Fleet((SingleIntegrator(),) * agents)
    everybody = nx.complete_graph(agents)
    bound = Exponential(10.0, 1.0, 1.0)
    design = ObserverDesign(fleet, nx.path_graph(agents), 2, bound, bound)
    none = np.zeros((fleet.n, 1))
    task = Formation(spacing=0.8)
    task.bind(World(design, everybody, 1, 0.05, 100.0, np.zeros(1), none, none))
    distance = np.linalg.norm(task.displacement, axis=1).reshape(agents, agents - 1)
    np.testing.assert_allclose(distance.min(axis=1), 0.8)
    assert distance.max() <= 0.8 * max(math.sqrt(2.0 * agents) + 1.0, 1.0 / math.sin(math.pi / agents))


def test_points_and_spacing_are_the_users_to_choose():
    """The environment's displacements are those of the points, and an agent that stands there has no error."""
    built_ = built("mixed_fleet")
    points = np.random.default_rng(0).uniform(-3.0, 3.0, (12, 2))
    env = parallel("formation_v0", "mixed_fleet", points=points.tolist())
    edges = env.batched.task.edges
    np.testing.assert_allclose(env.batched.task.displacement, points[edges[:, 1]] - points[edges[:, 0]])
    fleet, x0 = built_.fleet, np.zeros(built_.fleet.n)
    x0[fleet.position_index] = points + np.array([0.5, -0.5])
    _, infos = env.reset(seed=0, options={"initial_state": x0})
    assert all(info["task_error"] < 1e-12 for info in infos.values())
    double = parallel("formation_v0", "paper", spacing=2.0).batched.task.displacement
    np.testing.assert_allclose(double, 2.0 * parallel("formation_v0", "paper").batched.task.displacement)


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        (
            {"points": np.zeros((8, 3))},
            r"points must be finite, of shape \(agents, position axes\) = \(8, 2\).*\(8, 3\)",
        ),
        ({"points": np.full((8, 2), np.nan)}, "points must be finite"),
        ({"spacing": 0.0}, "spacing must be a positive, finite number of at most 1e30; got 0.0"),
        ({"spacing": math.inf}, "spacing must be a positive, finite number of at most 1e30; got inf"),
    ],
)
def test_formations_that_are_none_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        parallel("formation_v0", **arguments)


@scenarios
def test_consensus_is_to_meet_along_the_task_graph(name):
    task = batched("consensus_v0", name, num_envs=1).task
    assert not task.displacement.any()
    assert len(task.edges) == 2 * built(name).task.number_of_edges()


# -- leader following ----------------------------------------------------------------------------------------------


@scenarios
def test_every_scenario_has_leaders_that_their_followers_cannot_hear(name):
    """At least two leaders; each follower has one, 2 to k hops away, with a task edge and a place around it."""
    task, built_ = batched("leader_following_v0", name, num_envs=1).task, built(name)
    assert len(task.leader_indices) >= 2
    hops = dict(nx.all_pairs_shortest_path_length(built_.communication))
    followers = [i for i in range(len(built_.fleet)) if i not in task.leader_indices]
    assert task.edges[:, 0].tolist() == followers
    for i, j in task.edges.tolist():
        assert j in task.leader_indices
        assert 2 <= hops[i][j] <= built_.k
    np.testing.assert_allclose(np.linalg.norm(task.displacement, axis=1), 1.0)
    assert len({(j, *d) for (_, j), d in zip(task.edges.tolist(), task.displacement.tolist(), strict=True)}) == len(
        followers
    )


def test_the_convoy_s_leaders():
    """The three quick ones, at half their limit."""
    env = parallel("leader_following_v0", "convoy")
    assert env.batched.task.leader_indices == (0, 3, 6)
    assert env.batched.task.speeds == (3.0,) * 3
    assert env.possible_agents == ["drifter_1", "drifter_2", "drifter_4", "drifter_5", "drifter_7"]


@scenarios
def test_leaders_take_no_part_but_are_in_the_state(name):
    """No agent, no reward, no action; state() holds them, and other agents' task graphs don't matter."""
    env = parallel("leader_following_v0", name)
    env.reset(seed=0)
    fleet, leaders = env.batched.fleet, env.batched.task.leader_indices
    ids = [fleet.ids[i] for i in leaders]
    returned = play(env, 1)[0]
    assert set(env.possible_agents) == set(fleet.ids) - set(ids)
    assert all(list(one) == env.possible_agents for one in returned)
    fields = [field.name.split(".")[0] for field in env.batched.state_fields]
    assert list(dict.fromkeys(fields)) == list(fleet.ids)
    assert len(env.state()) >= fleet.n


def quick_leaders(speed):
    """Five single integrators without disturbance, of whom two lead, far from their input limits."""
    scenario = built("random_geometric:agents=12")
    return leader_following_v0.batched_env(
        scenario.replace(models=(SingleIntegrator(input_limit=100.0),) * 12, disturbance=None).sized(),
        num_envs=20,
        control_period=0.02,
        max_cycles=2000,
        leader_speed=speed,
    )


def test_leaders_move_smoothly_at_the_speed_asked_for_and_stay_near():
    """Rms speed over 20 s and 20 episodes within 10 %; acceleration and distance bounded by the sines' sum."""
    speed, step = 0.8, 0.02
    env = quick_leaders(speed)
    env.reset(seed=0)
    index = env.fleet.position_index[list(env.task.leader_indices)]
    actions = np.zeros((20, len(env.agents), 2))
    track = [env.simulator.x[:, index]]
    for _ in range(1000):
        env.step(actions)
        track.append(env.simulator.x[:, index].copy())
    path = np.array(track)  # (time, copy, leader, axis)
    velocity = np.diff(path, axis=0) / step
    rms = np.sqrt((velocity**2).sum(axis=-1).mean(axis=(0, 1)))
    np.testing.assert_allclose(rms, speed, rtol=0.1)
    amplitude = speed * math.sqrt(2.0 / 6.0)  # three sines on each of two axes
    assert np.abs(np.diff(velocity, axis=0)).max() <= 3.0 * amplitude * 2.5 * step * 1.1
    assert np.abs(path - path[0]).max() <= 2.0 * 3.0 * amplitude / 1.5 * 1.1
    assert np.abs(velocity).max() <= 3.0 * amplitude * 1.1
    assert np.ptp(velocity[:, 0], axis=0).min() > amplitude  # and they do move
    assert not np.allclose(path[:, 0] - path[0, 0], path[:, 1] - path[0, 1])  # each episode its own route


def test_leaders_stay_near_in_spite_of_drift_and_disturbance():
    """The convoy's unstable drift doesn't carry them away within an episode, and inputs stay in their limits."""
    env = batched("leader_following_v0", "convoy", num_envs=10, max_cycles=400)
    env.reset(seed=0)
    index = env.fleet.position_index[list(env.task.leader_indices)]
    start = env.simulator.x[:, index].copy()
    for _ in range(400):
        env.step(np.zeros((10, len(env.agents), 2)))
        assert np.abs(env.simulator.u).max() <= 6.0
        assert np.abs(env.simulator.x[:, index] - start).max() < 15.0


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"leaders": 0}, "leaders must be 1 to 7 of 8 agents, or a list of ids; got 0"),
        ({"leaders": 8}, "leaders must be 1 to 7 of 8 agents"),
        ({"leaders": []}, "needs at least one leader and one follower; got 0 leaders of 8 agents"),
        ({"leaders": ["drifter_O"]}, "no agent 'drifter_O'; did you mean 'drifter_"),
        ({"leaders": [9]}, "no agent 9: the fleet's agents are 0 to 7"),
        ({"leaders": ["drifter_0"]}, "no leader within k hops of 'drifter_"),
        ({"follow": {"drifter_0": "drifter_3"}}, "follow: 'drifter_0' isn't a follower"),
        ({"follow": {"drifter_1": "drifter_2"}}, "follow: 'drifter_2' isn't a leader"),
        ({"follow": {"drifter_1": "drifter_6"}}, "'drifter_1' knows nothing of 'drifter_6', which is more than k hops"),
        ({"leader_speed": 0.0}, "leader_speed must be a positive, finite number of at most 1e30; got 0.0"),
        ({"spacing": -1.0}, "spacing must be finite and not negative; got -1.0"),
    ],
)
def test_leaders_that_cannot_be_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        parallel("leader_following_v0", "convoy", **arguments)


def test_leaders_and_followers_are_the_users_to_choose():
    """By id, by number, and the leader of each follower, even a neighbour; spacing=0 is to meet the leader."""
    env = parallel(
        "leader_following_v0", "convoy", leaders=["drifter_3"], follow={"drifter_2": "drifter_3"}, spacing=0.0
    )
    assert env.batched.task.leader_indices == (3,)
    assert not env.batched.task.displacement.any()
    assert set(env.batched.task.edges[:, 1].tolist()) == {3}
    one = parallel("leader_following_v0", "convoy", leaders=("drifter_0", "drifter_6"), leader_speed=1.5)
    assert one.batched.task.leader_indices == (0, 6)
    assert one.batched.task.speeds == (1.5, 1.5)
    assert len(parallel("leader_following_v0", "convoy", leaders=4).batched.task.leader_indices) == 4


class AnyOrder(EdgeTask):
    """Edges in the order in which somebody wrote them down."""

    def relations(self, world):
        return np.array([[5, 6], [0, 2], [5, 4], [0, 1]]), np.arange(8.0).reshape(4, 2)


def test_slots_have_the_displacement_of_their_own_edge_in_whatever_order_edges_are():
    env = make_batched(AnyOrder(), "paper")
    expected = {(5, 6): [0.0, 1.0], (0, 2): [2.0, 3.0], (5, 4): [4.0, 5.0], (0, 1): [6.0, 7.0]}
    observations, _ = env.reset(seed=0)
    seen = 0
    for i, layout in enumerate(env.layouts):
        for number, slot in enumerate(layout.slots):
            columns = layout.columns(f"slot{number}.displacement")
            wanted = expected.get((i, slot.agent), [0.0, 0.0])
            assert observations[0, i, columns].tolist() == wanted
            assert slot.task_edge == ((i, slot.agent) in expected)
            seen += (i, slot.agent) in expected
    assert seen == len(expected)
