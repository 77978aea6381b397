"""Navigation: collisions found exactly, rewards and costs as documented, starts and goals that are far enough apart."""

import functools
import importlib
import math

import numpy as np
import pytest

from agents import describe, make_policy
from agents.policy import by_agent
from khop_env import Arena, CostsApart, Obstacle, consensus_v0, make_batched, navigation_v0, scenario
from khop_env.physics import SingleIntegrator
from khop_env.scenarios.files import ScenarioFileError, read_scenario, write_scenario
from khop_env.scenarios.teams import TEAM_MODELS
from khop_env.tasks.motion import lower_distances, segment_to_segment
from khop_env.testing import check_environment

FAMILIES = ("swap", "crossing", "corridor")
SHORTEST = {"swap": 0.5, "crossing": 1.0, "corridor": 1.0}  # m between starting points


# -- geometry ------------------------------------------------------------------------------------------------------


def test_distances_along_motion_are_those_of_many_samples():
    """Never above a fine sampling, nor below it by more than its spacing; agents, discs and walls."""
    rng = np.random.default_rng(0)
    before, after = rng.uniform(-1.0, 1.0, (2, 4, 2, 50))
    obstacles = np.hstack([rng.uniform(-1.0, 1.0, (3, 4)), rng.uniform(0.0, 0.2, (3, 1))])
    obstacles[0, 2:4] = obstacles[0, :2]  # a disc
    nearest, clearance = np.full((4, 50), np.inf), np.full((4, 50), np.inf)
    lower_distances(before, after, obstacles, nearest, clearance, 0, nearest.shape[1])
    share = np.linspace(0.0, 1.0, 2001)[:, None, None, None]
    places = before + share * (after - before)  # (S, N, 2, B)
    gaps = np.linalg.norm(places[:, :, None] - places[:, None], axis=3)
    gaps[:, np.arange(4), np.arange(4)] = np.inf
    sampled = gaps.min(axis=(0, 2))
    assert (nearest <= sampled + 1e-12).all()
    assert (nearest > sampled - 3e-3).all()
    along = np.linspace(0.0, 1.0, 201)[:, None]
    for i in range(4):
        to_wall = np.inf
        for ax, ay, bx, by, radius in obstacles:
            wall = np.array([ax, ay]) + along * np.array([bx - ax, by - ay])
            gap = np.linalg.norm(places[::20, i][:, None] - wall[None, :, :, None], axis=2).min(axis=(0, 1)) - radius
            to_wall = np.minimum(to_wall, gap)
        assert (clearance[i] <= to_wall + 1e-12).all()
        assert (clearance[i] > to_wall - 0.02).all()


def test_two_that_pass_within_a_step_collide():
    """At neither end of the step are they near each other; one that waits until the other has passed isn't hit."""
    before = np.array([[[-1.0], [0.0]], [[1.0], [0.1]]])
    nearest, clearance = np.full((2, 1), np.inf), np.full((2, 1), np.inf)
    lower_distances(before, before * [[-1.0], [1.0]], np.zeros((0, 5)), nearest, clearance, 0, nearest.shape[1])
    np.testing.assert_allclose(nearest, 0.1)
    # crossing paths, at different times: the segments cross, the agents don't meet
    before, after = np.array([[[-1.0], [0.0]], [[0.0], [3.0]]]), np.array([[[1.0], [0.0]], [[0.0], [-1.0]]])
    nearest[...] = np.inf
    lower_distances(before, after, np.zeros((0, 5)), nearest, clearance, 0, nearest.shape[1])
    assert nearest[0, 0] == pytest.approx(math.sqrt(0.2))
    assert segment_to_segment(-1.0, 0.0, 1.0, 0.0, 0.0, 3.0, 0.0, -1.0) == 0.0


# -- starts and goals ----------------------------------------------------------------------------------------------


@pytest.mark.parametrize("parameters", ["", ":agents=12,radius=0.3", ":agents=16,graph=ring"])
@pytest.mark.parametrize("family", FAMILIES)
def test_nobody_touches_anything_at_the_start_nor_at_a_goal(family, parameters):
    env = make_batched("navigation_v0", f"{family}{parameters}", num_envs=40)
    _, infos = env.reset(seed=3)
    radius = env.task.arena.radius
    apart = SHORTEST[family] * radius / 0.2
    assert infos["min_distance"].min() >= apart
    assert infos["obstacle_distance"].min() >= radius
    assert not infos["cost"].any()
    goals = env.task.memory["goal"]
    gaps = np.linalg.norm(goals[:, None] - goals, axis=2)
    gaps[np.arange(len(goals)), np.arange(len(goals))] = np.inf
    assert gaps.min() >= apart
    assert len(np.unique(goals[0, 0])) == 40  # drawn for each episode
    if env.task.arena.goals == "opposite":
        np.testing.assert_array_equal(goals, -env.world.positions())


def test_starts_stay_in_the_initial_set_and_are_the_seed_s():
    made = scenario("crossing:agents=20")
    env = make_batched("navigation_v0", made, num_envs=3)
    env.reset(seed=5)
    x = env.simulator.x.copy()
    assert (np.abs(x - made.initial.center) <= made.initial.radius).all()
    env.reset(seed=[7, 6, 5])
    np.testing.assert_array_equal(env.simulator.x[::-1], x)


def test_a_place_that_is_too_small_is_refused():
    crowded = scenario("crossing").replace(arena=Arena(apart=3.0), name="crowded")
    with pytest.raises(ValueError, match=r"no room for 8 agents 3 m apart, of radius 0.2 m"):
        make_batched("navigation_v0", crowded)


@pytest.mark.parametrize("family", FAMILIES)
@pytest.mark.parametrize("model", TEAM_MODELS)
def test_going_straight_arrives_at_the_limit_of_speed(family, model):
    """Every model; nobody is in the way, because collisions only cost. All are at their goals when it ends."""
    env = make_batched("navigation_v0", f"{family}:model={model}", num_envs=4, max_cycles=400)
    policy = make_policy("go_to_goal")
    policy.reset(describe(env), range(4))
    observations, infos = env.reset(seed=0)
    distance = infos["task_error"].copy()
    first = np.full(distance.shape, np.inf)
    over = np.zeros(4, bool)
    for cycle in range(1, 401):
        actions = np.stack(list(policy.act(by_agent(env, observations)).values()), axis=1)
        observations, _, terminated, _, infos = env.step(actions, ended=over)
        first = np.where((infos["arrived"] > 0.0) & np.isinf(first), 0.05 * cycle, first)
        assert (infos["arrived"].all(axis=1) == terminated).all()
        over |= terminated
        if over.all():
            break
    assert over.all()
    if model == "integrator":
        assert (first * math.sqrt(2.0) * 1.1 + 0.1 > distance - 0.1).all()  # not faster than its limits and the wind
        assert (first < distance + 1.0).all()


def test_keeping_right_lets_pass():
    """Two that meet head-on pass each other on the right, where those that go straight collide."""
    found = {}
    for name in ("go_to_goal", "keep_right"):
        env = navigation_v0.parallel_env(wide(), observe="oracle", goal_radius=0.1)
        places = np.array([[-2.0, 0.0], [2.0, 0.0], [4.0, 3.0], [-5.0, 3.0]])
        env.reset(seed=0, options={"initial_state": places.ravel()})
        env.batched.task.memory["goal"][..., 0] = places[[1, 0, 2, 3]]
        policy = make_policy(name)
        policy.reset(describe(env), [0])
        observations = {agent: env.observe(agent) for agent in env.agents}
        sides, cost = [], 0.0
        while env.agents:
            observations, _, terminated, _, infos = env.step(policy.act(observations))
            cost += infos["integrator_0"]["cost"]
            sides.append(env.batched.world.positions()[:2, 1, 0])
        assert all(terminated.values())
        found[name] = cost, np.array(sides)
    assert found["go_to_goal"][0] > 0.0
    assert found["keep_right"][0] == 0.0
    assert found["keep_right"][1].min(axis=0)[0] < -0.1  # the one that goes to the right of the map keeps below
    assert found["keep_right"][1].max(axis=0)[1] > 0.1


def test_who_is_stuck_goes_aside_and_comes_back():
    """An agent whose inputs don't move it tries another direction after a second, which the seed decides."""
    env = lane()
    observed = {agent: env.observe(agent) for agent in env.agents}
    first, again, other = ([], [], [])
    for actions, seed in ((first, 3), (again, 3), (other, 4)):
        policy = make_policy("keep_right")
        policy.reset(describe(env), [seed])
        actions += [policy.act(observed)["integrator_2"] for _ in range(120)]
    np.testing.assert_array_equal(first, again)
    assert not np.array_equal(first, other)
    wished = first[0]
    aside = [not np.allclose(action, wished) for action in first]
    assert not any(aside[:20])
    assert any(aside[21:30])
    assert not all(aside[21:])


def test_a_cart_that_is_pushed_off_its_goal_is_not_stuck():
    """By a disturbance, some centimetres and slowly; it doesn't try other directions then."""
    env = navigation_v0.parallel_env("swap:model=cart,duration=20", observe="oracle")
    env.reset(seed=0)
    batched = env.batched
    batched.task.memory["goal"][..., 0] = batched.world.positions()[..., 0]
    batched.task.memory["goal"][0] *= 40.0  # out of the others' way, and the episode goes on
    policy = make_policy("keep_right")
    policy.reset(describe(env), [0])
    observations, far = {agent: env.observe(agent) for agent in env.agents}, []
    while env.agents:
        observations, *_ = env.step(policy.act(observations))
        far.append(batched.task_errors()[0, 1:].max())
    assert max(far) > 0.05
    assert max(far) < 0.15


# -- rewards, costs and ends ---------------------------------------------------------------------------------------


def wide():
    """Four agents that may start anywhere, without disturbance."""
    return scenario("swap:agents=4,disturbance=0").replace(center=0.0, radius=6.0, name="wide").sized()


def lane(**arguments):
    """Four agents in a row on the x axis without disturbance; 1 m apart, they move along it."""
    env = navigation_v0.parallel_env(wide(), **arguments)
    x0 = np.array([0.0, 0.0, 1.0, 0.0, 4.0, 0.0, 5.0, 0.0])
    env.reset(seed=0, options={"initial_state": x0})
    return env


def step(env, *velocities):
    """Each agent's velocity along x."""
    agents = env.possible_agents
    return env.step({agent: np.array([v, 0.0], np.float32) for agent, v in zip(agents, velocities, strict=True)})


@pytest.mark.parametrize("reward", ["agent", "team"])
def test_rewards_are_the_documented_formula(reward):
    """Progress, effort, and the penalty of a collision, which happens when the gap falls below two radii."""
    env = lane(effort=0.5, penalty=3.0, reward=reward, control_period=0.1, dt=0.05)
    goal = env.batched.task.memory["goal"][..., 0]
    collided = []
    for _ in range(8):
        place = env.batched.world.positions()[..., 0]
        _, rewards, terminated, _, infos = step(env, 0.5, -0.5, 1.0, 0.0)
        now = env.batched.world.positions()[..., 0]
        progress = np.linalg.norm(goal - place, axis=1) - np.linalg.norm(goal - now, axis=1)
        cost = np.array([infos[agent]["cost"] for agent in env.possible_agents])
        expected = progress - 0.1 * 0.5 * np.array([0.25, 0.25, 1.0, 0.0]) - 3.0 * cost
        if reward == "team":
            expected = np.full(4, expected.mean())
        np.testing.assert_allclose(list(rewards.values()), expected, atol=1e-12)
        collided.append(cost.tolist())
        np.testing.assert_allclose(infos["integrator_0"]["min_distance"], now[1, 0] - now[0, 0], atol=1e-12)
        assert not any(terminated.values())
    # 1 m less 0.1 m a step: 0.4 m after six isn't a collision, except by rounding
    assert [row[0] for row in collided[:5]] == [0.0] * 5
    assert [row[0] for row in collided[6:]] == [1.0] * 2
    assert [row[2] for row in collided] == [0.0] * 6 + [1.0] * 2 or collided[5][2] in (0.0, 1.0)
    for row in collided:
        assert row[0] == row[1]
        assert row[2] == row[3]


def test_the_bonus_is_paid_once_and_all_must_be_there_at_once():
    env = lane(effort=0.0, bonus=10.0, goal_radius=0.12)
    memory = env.batched.task.memory
    memory["goal"][..., 0] = [[0.2, 0.0], [1.0, 0.0], [4.0, 0.0], [5.2, 0.0]]
    bonuses = []
    for velocity in (1.0, 1.0, 1.0, -1.0, -1.0, -1.0, -1.0, 1.0, 1.0, 1.0, 1.0):
        _, rewards, terminated, _, infos = step(env, velocity, 0.0, 0.0, 0.0)
        bonuses.append(rewards["integrator_0"] > 5.0)
        arrived = [infos[agent]["arrived"] for agent in env.possible_agents]
        assert arrived[1:] == [1.0, 1.0, 0.0]
        assert not any(terminated.values())
        assert rewards["integrator_1"] == 0.0  # it was there from the beginning
    assert sum(bonuses) == 1
    while env.agents:
        _, _, terminated, _, infos = step(env, 0.0, 0.0, 0.0, 1.0)
    assert all(terminated.values())
    assert all(info["arrived"] for info in infos.values())


def test_a_collision_can_end_the_episode():
    env = lane(end_at_collision=True)
    while env.agents:
        _, _, terminated, _, infos = step(env, 1.0, -1.0, 0.0, 0.0)
    assert all(terminated.values())
    assert [info["cost"] for info in infos.values()] == [1.0, 1.0, 0.0, 0.0]


def test_between_the_steps_of_a_control_period_too():
    """Two agents that turn back within a control period are nearest in between: its substeps count."""
    env = lane(control_period=0.2, dt=0.05, actuator="lag")
    env.batched.task.moved(env.batched.world, 0)  # as if at the beginning of a period
    x = env.batched.world.x
    x[0], x[2] = 0.9, 1.0
    env.batched.task.moved(env.batched.world, 1)
    x[0], x[2] = 0.0, 1.0
    env.batched.task.moved(env.batched.world, 2)
    assert env.batched.task.evaluate(env.batched.world).infos["min_distance"][0, 0] == pytest.approx(0.1)
    step(env, 0.0, 0.0, 0.0, 0.0)
    assert env.batched.task.evaluate(env.batched.world).infos["min_distance"][0, 0] == pytest.approx(1.0)


def test_obstacles_cost_and_are_observed():
    """The nearest first; from inside a disc the way to its surface."""
    arena = Arena(obstacles=(Obstacle((3.0, -1.0), (3.0, 1.0)), Obstacle((0.0, 0.5), radius=0.25)))
    env = navigation_v0.parallel_env(wide().replace(arena=arena))
    x0 = np.array([0.0, 0.0, 2.5, 0.0, 0.0, 2.0, -3.0, 0.0])
    observations, infos = env.reset(seed=0, options={"initial_state": x0})
    named = {agent: env.layout(agent).read(seen) for agent, seen in observations.items()}
    one, other = named["integrator_0"], named["integrator_1"]
    np.testing.assert_allclose([one["obstacle0.x"], one["obstacle0.y"]], [0.0, 0.25], atol=1e-6)
    np.testing.assert_allclose([one["obstacle1.x"], one["obstacle1.y"]], [3.0, 0.0], atol=1e-6)
    np.testing.assert_allclose([other["obstacle0.x"], other["obstacle0.y"]], [0.5, 0.0], atol=1e-6)
    assert infos["integrator_0"]["obstacle_distance"] == pytest.approx(0.25)
    _, _, _, _, infos = env.step(dict.fromkeys(env.possible_agents, np.array([0.0, 1.0], np.float32)))
    _, _, _, _, infos = env.step(dict.fromkeys(env.possible_agents, np.array([0.0, 1.0], np.float32)))
    assert infos["integrator_0"]["cost"] == 1.0
    assert infos["integrator_1"]["cost"] == 0.0


def test_costs_apart():
    """Six values, and the same numbers in the infos; refused where there are no costs."""
    env = CostsApart(lane())
    env.reset(seed=0)
    actions = {agent: np.zeros(2, np.float32) for agent in env.possible_agents}
    observations, rewards, costs, terminated, truncated, infos = env.step(actions)
    assert list(costs) == list(rewards) == list(observations) == list(terminated) == list(truncated)
    assert costs == {agent: info["cost"] for agent, info in infos.items()}
    other = CostsApart(consensus_v0.parallel_env())
    other.reset(seed=0)
    with pytest.raises(ValueError, match="consensus_v0 has no costs: its infos have the keys task_error, "):
        other.step(dict.fromkeys(other.possible_agents, np.zeros(2, np.float32)))


def test_episodes_last_as_long_as_the_scenario():
    assert make_batched("navigation_v0", "crossing:duration=30").settings.horizon == 600
    assert make_batched("navigation_v0", "crossing", control_period=0.1).settings.horizon == 150
    assert make_batched("navigation_v0", "crossing", max_cycles=7).settings.horizon == 7
    assert make_batched("consensus_v0", "mixed_fleet").settings.horizon == 200
    assert make_batched("consensus_v0", "mixed_fleet", max_cycles=None).settings.horizon == 600


def test_frames_show_discs_goals_collisions_arrows_and_marks():
    """And say in a legend what they are."""
    env = navigation_v0.parallel_env("swap", render_mode="rgb_array")
    policy = make_policy("go_to_goal")
    policy.reset(describe(env), [0])
    observations, infos = env.reset(seed=1)
    world = env.batched.world
    frames = [env.render()]
    world.arrows = np.full((8, 2, 1), 0.5)
    frames.append(env.render())
    world.arrows, world.marked = None, np.arange(8)[:, None] == 3
    frames.append(env.render())
    world.marked = None
    while not any(info["cost"] for info in infos.values()):
        actions = policy.act(observations)
        observations, _, _, _, infos = env.step(actions)
    frames.append(env.render())
    colors = {"hit": (204, 51, 17), "arrow": (238, 119, 51), "mark": (170, 51, 119), "goal": (34, 136, 51)}
    found = [
        {name: (np.abs(frame.astype(int) - color).sum(axis=2) < 30) for name, color in colors.items()}
        for frame in frames
    ]
    legend = slice(700, None)
    assert [int(each["hit"][:, legend].sum()) > 50 for each in found] == [True] * 4
    assert [int(each["hit"][:, :700].sum()) > 400 for each in found] == [False, False, False, True]
    for name, expected in (("arrow", [False, True, False, False]), ("mark", [False, False, True, False])):
        for part in (slice(700), legend):
            assert [int(each[name][:, part].sum()) > 10 for each in found] == expected
    rows, columns = np.nonzero(found[0]["goal"][:, :700])  # all goals are in view
    assert len(rows) > 8 * 30
    assert min(columns) > 60
    assert max(columns) < 690
    assert min(rows) > 42


def test_obstacles_are_in_view_and_in_the_legend():
    """Also where nobody is near them."""
    frame = navigation_v0.parallel_env("corridor", render_mode="rgb_array")
    frame.reset(seed=0)
    grey = np.abs(frame.render().astype(int) - 153).sum(axis=2) < 9
    assert grey[:, 700:].sum() > 30
    columns = np.nonzero(grey[:, 60:690].sum(axis=0) > 100)[0]  # ends of both rooms
    assert len(columns) > 2
    assert columns[-1] - columns[0] > 400


# -- arguments and files -------------------------------------------------------------------------------------------


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"effort": -1.0}, "effort must be finite and not negative; got -1.0"),
        ({"penalty": math.inf}, "penalty must be finite and not negative; got inf"),
        ({"goal_radius": 0.0}, "goal_radius must be a positive, finite number"),
        ({"reward": "both"}, "reward must be 'agent' or 'team'; got 'both'"),
        ({"end_at_collision": 1}, "end_at_collision must be True or False; got 1"),
    ],
)
def test_wrong_arguments_are_refused(arguments, message):
    with pytest.raises(ValueError, match=message):
        navigation_v0.parallel_env(**arguments)


@pytest.mark.parametrize(
    ("name", "message"),
    [
        ("swap:agents=7", "swap needs an even number of agents from 4 to 1000; got agents=7"),
        ("corridor:model=car", "no model 'car'; did you mean 'cart'"),
        ("crossing:agents=9,graph=regular3", "needs an even number of agents; got 9"),
        ("crossing:graph=tre", "no graph 'tre'; did you mean 'tree'"),
        ("crossing:radius=0", "Arena.radius must be positive and finite; got 0.0"),
        ("crossing:speed=-1", "speed must be positive.*got speed=-1"),
    ],
)
def test_wrong_parameters_of_the_families_are_refused(name, message):
    with pytest.raises(ValueError, match=message):
        scenario(name)


def test_arenas_that_are_none_are_refused():
    with pytest.raises(ValueError, match=r"Obstacle.end must be two finite numbers"):
        Obstacle((0.0, 0.0), (1.0, math.nan))
    with pytest.raises(ValueError, match=r"Obstacle.radius must be finite and not negative; got -1"):
        Obstacle((0.0, 0.0), radius=-1.0)
    with pytest.raises(ValueError, match=r"Arena.goals must be 'opposite' or 'random'; got 'far'"):
        Arena(goals="far")
    flat = scenario("random_geometric:agents=4").replace(models=(SingleIntegrator(dim=1),) * 4, center=0.0, radius=1.0)
    with pytest.raises(ValueError, match="obstacles are in the plane, and positions have 1 axes"):
        flat.replace(disturbance=None, arena=Arena(obstacles=(Obstacle((0.0, 0.0)),)))


@pytest.mark.parametrize("name", ["corridor:agents=6", "swap:model=vessel,loss=0", "crossing:continuous=true"])
def test_files_have_the_arena(name, tmp_path):
    made = scenario(name)
    path = tmp_path / "mine.toml"
    path.write_text(write_scenario(made))
    again = read_scenario(path)
    assert again.arena == made.arena
    assert write_scenario(again) == write_scenario(made)
    text = path.read_text().replace("goals = ", "gaols = ")
    path.write_text(text)
    with pytest.raises(ScenarioFileError, match=r"arena.gaols: unknown key .*did you mean 'goals'"):
        read_scenario(path)


def test_laws_have_nothing_to_act_along():
    """A clear refusal, and policies that do something by default."""
    module = importlib.import_module("khop_env.navigation_v0")
    with pytest.raises(ValueError, match="tanh acts along task edges, and agents of navigation_v0 have none"):
        make_policy("tanh").reset(describe(module.parallel_env()), [0])
    with pytest.raises(ValueError, match=r"go_to_goal needs an environment with goals, e.g. navigation_v0"):
        make_policy("go_to_goal").reset(describe(consensus_v0.parallel_env()), [0])


def test_the_contract_is_kept_over_a_network_and_among_obstacles():
    """Spaces, seeds, copies, pickles, vector rows, leaks, and the checks of PettingZoo, Gymnasium and SB3."""
    report = check_environment(
        functools.partial(navigation_v0.parallel_env, "corridor:agents=4", max_cycles=20), steps=30
    )
    report.raise_if_failed()
    assert {check.status for check in report.checks} == {"passed"}
