"""Memory of others from period to period in a safety filter, and obstacles that observations do not show in full."""

import dataclasses

import numpy as np
import pytest

from agents import SafetyFilter, describe, play, shielded
from agents.navigation import GoToGoal
from agents.policy import by_agent
from khop_env.env.layout import Field, ObservationLayout
from khop_env.network import Network
from khop_env.physics import SingleIntegrator, Unicycle
from khop_env.registry import make_batched, scenario
from khop_env.simulation import Arena, Obstacle
from tests.agents.ramming_models import Ram, RammingTeam, cart, ship


class East(GoToGoal):
    """Full speed along the first input, whatever is there."""

    def act(self, observations):
        """By agent."""
        wish = np.eye(1, 3, dtype=np.float32)[0]
        return {
            agent: np.tile(wish[: each.shape[-1]], (len(each), 1)) for agent, each in super().act(observations).items()
        }


def placed(model, places, arena, spread=0.0, **changes):
    """Four agents that start at given places, the second one up to `spread` beside its own."""
    base = scenario(f"swap:agents=4,model={model},disturbance=0")
    center = np.zeros((4, len(base.center) // 4))
    radius = np.zeros_like(center)
    center[:, :2], radius[1, 0] = places, spread
    return base.replace(center=center.ravel(), radius=radius.ravel(), arena=arena, **changes)


def test_what_is_remembered_of_others_survives_a_gap_and_is_dropped_with_the_episode():
    """A bound that says nothing leaves what follows from before, and stops an agent; new episodes know nothing."""
    world = RammingTeam([ship()] * 4, batch=2, largest=0.0, ring=20.0)
    env, policy = world.description(), SafetyFilter(Ram(world))
    policy.reset(env, [0, 1])
    world.move(policy.act(world.observations(env)))
    first = policy.get_state()["memory"]
    assert np.isfinite(first).all()
    agent, layout = env.agents[0], env.layouts[env.agents[0]]

    def blind():
        found = world.observations(env)
        found[agent][:, layout.index("slot0.bound.x")] = layout.high[layout.index("slot0.bound.x")]
        return found

    actions = policy.act(blind())
    assert (policy.intervention[agent] > 0.1).all()
    memory = policy.get_state()["memory"]
    assert (memory[:, 0, 1::2] >= first[:, 0, 1::2]).all()  # upper ends
    assert (memory[:, 0, ::2] <= first[:, 0, ::2]).all()
    np.testing.assert_allclose(memory[:, 0], first[:, 0], atol=0.2)
    world.move(actions)
    policy.begin(2, np.array([1]))
    world.move(policy.act(blind()))
    memory = policy.get_state()["memory"]
    assert np.isfinite(memory[0, 0]).all()
    assert np.isnan(memory[1, 0]).all()
    new = blind()
    new[agent][:, layout.index("slot0.age")] = 0.0  # as in the first observation of every episode
    policy.act(new)
    assert np.isnan(policy.get_state()["memory"][:, 0]).all()


def test_what_is_remembered_is_dropped_as_a_whole_where_it_is_contradicted():
    """A place that can't have been reached along one axis: nothing of the other axis is kept either."""
    world = RammingTeam([cart()] * 4, batch=1, largest=0.0, ring=20.0)
    env, policy = world.description(), SafetyFilter(Ram(world))
    policy.reset(env, [0])
    world.move(policy.act(world.observations(env)))
    agent, layout = env.agents[0], env.layouts[env.agents[0]]
    for jump, width in ((0.0, 0.5), (3.0, 6.0)):
        observations = world.observations(env)
        observations[agent][:, layout.index("slot0.position.x")] += jump
        observations[agent][:, layout.index("slot0.bound.y")] = 3.0
        world.move(policy.act(observations))
        low, high = policy.get_state()["memory"][0, 0, 2:4]
        assert (high - low > 6.0) == (jump > 0.0)
        assert high - low > width - 0.5


def test_without_ages_nothing_is_remembered():
    """Estimates without messages don't say how old they are, so that a new episode couldn't be told from the old."""
    world = RammingTeam([cart()] * 4, batch=1, largest=0.0, ring=20.0)
    env = world.description()
    layouts = {}
    for agent, layout in env.layouts.items():
        layouts[agent] = ObservationLayout(agent, [f for f in layout.fields if f.name[-4:] != ".age"], layout.slots)
    env = dataclasses.replace(env, layouts=layouts)
    policy = SafetyFilter(Ram(world))
    policy.reset(env, [0])
    for width in (0.0, 3.0):
        observations = world.observations(env)
        observations[env.agents[0]][:, layouts[env.agents[0]].index("slot0.bound.y")] = width
        world.move(policy.act(observations))
        low, high = policy.get_state()["memory"][0, 0, 2:4]
        assert high - low > 2.0 * width


@pytest.mark.parametrize("model", [SingleIntegrator(), cart(), Unicycle(), ship()])
def test_obstacles_beyond_what_observations_show_are_kept_away_from(model):
    """A vector at its limit says how far an obstacle is at least, and no direction."""
    world = RammingTeam([model] * 2, batch=1, largest=0.0, ring=20.0, obstacles=np.array([[0.0, 0.0, 0.1]]))
    env = world.description()
    inputs = 1 if isinstance(model, Unicycle) else 2
    for limit, stopped in ((world.radius + 5e-4, True), (3.0, False)):
        layouts = {
            agent: ObservationLayout(
                agent,
                [Field(f.name, f.unit, -limit, limit) if f.name == "obstacle0.y" else f for f in layout.fields],
                layout.slots,
            )
            for agent, layout in env.layouts.items()
        }
        policy = SafetyFilter(Ram(world))
        policy.reset(dataclasses.replace(env, layouts=layouts), [0])
        observations = world.observations(env)
        agent = env.agents[0]
        observations[agent][:, env.layouts[agent].columns("obstacle0")] = 0.01, -limit
        policy.policy.act = lambda seen: {name: np.ones((1, model.m), np.float32) for name in seen}
        actions = policy.act(observations)
        assert actions[agent][:, :inputs].any() != stopped


@pytest.mark.parametrize(
    ("model", "sides"),
    [
        ("cart", (0.25, -0.25, 0.27)),
        ("vessel", (0.25, -0.25, 0.27)),
        ("integrator", (0.21, -0.21, 0.211)),
        ("unicycle", (0.21, -0.21, 0.211)),
    ],
)
def test_a_wall_behind_nearer_obstacles_is_kept_away_from(model, sides):
    """A cart has to see it before it sees no way to stop: three walls beside its way are nearer for long."""
    beside = [Obstacle((-6.0, y), (0.0, y)) for y in sides]
    arena = Arena(obstacles=(Obstacle((0.0, -2.0), (0.0, 2.0)), *beside))
    places = [(-4.0, 0.0), (-4.0, 8.0), (-4.0, 16.0), (-4.0, 24.0)]
    env = make_batched(
        "navigation_v0", placed(model, places, arena, network=Network()), num_envs=1, bounds=True, max_cycles=200
    )
    found = play(env, shielded(East()), range(1)).outcomes
    assert not found["collision"].any()
    assert not found["infeasible"].any()
    assert env.world.positions()[0, 0, 0] > -0.4  # it goes all the way


@pytest.mark.parametrize("model", ["cart", "vessel", "integrator"])
def test_episodes_that_begin_without_a_word_to_the_filter(model):
    """As by autoreset: where another was before says nothing of where it is, and messages take half a second."""
    start = placed(
        model,
        [(0.0, 0.0), (1.6, 0.0), (0.0, 9.0), (0.0, 18.0)],
        Arena(apart=0.5),
        spread=1.0,
        network=Network(latency=0.5),
    )
    batch = 20
    env = make_batched("navigation_v0", start, num_envs=batch, bounds=True, max_cycles=1000)
    policy = SafetyFilter(None)
    policy.reset(describe(env), range(batch))
    observations, _ = env.reset(0)
    first, second = env.agents[:2]
    nearest = []
    for cycle in range(240):
        seen = by_agent(env, observations)
        wanted = {agent: np.zeros((batch, size), np.float32) for agent, size in policy.inside.action_sizes.items()}
        if cycle < 120:  # the second one goes to the far end
            wanted[second][:, 0] = np.clip(2.0 * (2.4 - seen[second][:, env.layouts[1].index("own.x")]), -1.0, 1.0)
        else:
            wanted[first][:, 0], wanted[second][:, 0] = 1.0, -1.0
        actions = policy.correct(seen, wanted)
        observations, _, _, _, infos = env.step(np.concatenate(list(actions.values()), axis=1))
        nearest.append(infos["min_distance"].min())
        assert not policy.infeasible[first].any()
        if cycle == 119:
            observations, _ = env.reset(env_ids=np.arange(batch))
    assert min(nearest) >= 0.4
    assert min(nearest[120:]) < 0.6
