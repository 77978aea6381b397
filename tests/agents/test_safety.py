"""The safety filter's theorem, against everybody ramming everybody with errors on their bounds."""

import dataclasses

import numpy as np
import pytest

from agents import SafetyFilter
from khop_env.env.layout import ObservationLayout
from khop_env.physics import DriftingIntegrator, SingleIntegrator
from tests.agents.ramming import PERIOD, PUSHED, SPEED, Ram, Ramming


def rammed(world, steps=120, margin="certified", gamma=1.0, free=(), kind=SafetyFilter):
    """Play the world; agents `free` act without the filter."""
    env, announce = world.description(), world.delay is not None
    policy = kind(Ram(world, pauses=announce), margin, gamma=gamma, announce=announce)
    policy.reset(env, range(world.batch))
    lost = 0
    for _ in range(steps):
        actions = policy.act(world.observations(env))
        for i in free:
            actions[env.agents[i]][:, :2] = policy.wanted[env.agents[i]]
        world.move(actions)
        lost += sum(int(infeasible.sum()) for infeasible in policy.infeasible.values())
    return lost


@pytest.mark.parametrize(("largest", "gamma"), [(0.02, 1.0), (0.3, 1.0), (0.3, 0.4), (0.0, 1.0)])
def test_ramming_never_collides_with_errors_on_their_bounds(largest, gamma):
    """At no instant; and they come within 3 cm of touching, 2.4 of them for the disturbance."""
    world = Ramming(largest=largest)
    assert rammed(world, gamma=gamma) == 0
    assert world.closest.min() >= 2.0 * world.radius
    assert world.closest.min() < 2.0 * world.radius + 0.04


@pytest.mark.parametrize("delay", [0, 6, 80])
@pytest.mark.parametrize("model", [SingleIntegrator(input_limit=SPEED), DriftingIntegrator(input_limit=3.0)])
def test_announced_anchors_never_let_agents_collide(model, delay):
    """Ages jump from 0 to 4 s, agents pause and say so, and ram each other again; anchors come nearer than without."""
    world = Ramming(delay=delay, model=model)
    assert rammed(world, steps=150) == 0
    assert world.closest.min() >= 2.0 * world.radius
    assert world.closest.min() < 2.0 * world.radius + 0.12


class Forgetful(SafetyFilter):
    """Doesn't keep the pace that it announced."""

    def act(self, observations):
        """As if it hadn't announced anything."""
        self._resting[...] = 0
        return super().act(observations)


@pytest.mark.parametrize(("younger", "kind"), [(PERIOD, SafetyFilter), (0.0, Forgetful)])
def test_what_is_announced_has_to_be_true(younger, kind):
    """Ages a period too small, and agents that don't stay at rest, collide."""
    world = Ramming(delay=6, younger=younger)
    rammed(world, steps=150, kind=kind)
    assert (world.closest < 2.0 * world.radius).mean() > 0.1


@pytest.mark.parametrize("largest", [0.0, 0.3])
def test_integrators_with_a_drift_never_collide_either(largest):
    """Which changes within a period; it is cancelled as it was at its beginning."""
    world = Ramming(largest=largest, model=DriftingIntegrator(input_limit=3.0))
    assert rammed(world) == 0
    assert world.closest.min() >= 2.0 * world.radius
    assert world.closest.min() < 2.0 * world.radius + 0.12


def test_a_bound_too_small_by_one_period_collides():
    """So the bound isn't larger than it has to be by more than that."""
    world = Ramming(largest=0.3, missing=(SPEED + PUSHED) * PERIOD)
    rammed(world)
    assert (world.closest < 2.0 * world.radius).mean() > 0.5


@pytest.mark.parametrize("margin", ["none", 0.1])
def test_point_estimates_and_small_margins_collide(margin):
    """In the same worlds."""
    world = Ramming(largest=0.3)
    rammed(world, margin=margin)
    assert (world.closest < 2.0 * world.radius).mean() > 0.5


def test_an_agent_without_the_filter_voids_the_claim():
    """The theorem is about teams."""
    world = Ramming(largest=0.3)
    rammed(world, free=[0])
    assert (world.closest < 2.0 * world.radius).mean() > 0.5


def test_obstacles_are_not_touched():
    """Full speed at discs, one of which is a point: a corner."""
    world = Ramming(largest=0.0, obstacles=np.array([[0.0, 0.0, 0.3], [1.4, 0.3, 0.0]]), radius=0.1)
    assert rammed(world) == 0
    assert world.clearance.min() >= world.radius
    assert world.clearance.min() < world.radius + 0.03


def test_a_disturbance_larger_than_its_bound_is_noticed():
    """An agent that isn't where it should be starts anew from where it is, and that is counted."""
    world = Ramming(batch=2)
    env, policy = world.description(), SafetyFilter(Ram(world))
    policy.reset(env, range(2))
    for jump in (0.0, 0.0, 0.5, 0.0):
        world.x[1, 0] += jump
        world.move(policy.act(world.observations(env)))
        assert policy.infeasible[env.agents[0]].tolist() == [False, jump > 0.0]


def test_what_is_clipped_counts_as_unknown():
    """A bound or a place at the limit of observations stops an agent; its own place there, too, and is counted."""
    world = Ramming(batch=1, largest=0.0)
    env = world.description()
    agent, layout = env.agents[0], env.layouts[env.agents[0]]
    observations = world.observations(env)
    for name, value, counted in (
        ("slot1.bound.x", layout.high[layout.index("slot1.bound.x")], False),
        ("slot1.position.y", layout.high[layout.index("slot1.position.y")], False),
        ("own.x", layout.high[layout.index("own.x")], True),
    ):
        policy = SafetyFilter(Ram(world))
        policy.reset(env, [0])
        assert np.abs(policy.act(observations)[agent]).max() > 0.1
        policy.reset(env, [0])
        changed = observations[agent].copy()
        changed[:, layout.index(name)] = value
        actions = policy.act({**observations, agent: changed})
        assert not actions[agent].any()
        assert policy.infeasible[agent].tolist() == [counted]


@pytest.mark.parametrize("by_messages", [True, False])
def test_before_anything_has_arrived(by_messages):
    """By messages the bound is that of the initial set; a neighbour whose link is down has none, and one stops."""
    world = Ramming(batch=1, largest=0.0)
    env = world.description(age=by_messages)
    policy = SafetyFilter(Ram(world))
    policy.reset(env, [0])
    observations = world.observations(env)
    layout = env.layouts[env.agents[0]]
    observations[env.agents[0]][:, layout.index("slot2.valid")] = 0.0
    assert policy.act(observations)[env.agents[0]].any() == by_messages


def test_where_nothing_is_near_actions_are_the_policy_s_own():
    """Bit for bit, beyond their limits, too."""
    world = Ramming(batch=3, largest=0.0)
    world.x *= 20.0
    env, policy = world.description(), SafetyFilter(Ram(world))
    policy.reset(env, range(3))
    wanted = {agent: np.full((3, 2), 1.7, np.float32) for agent in env.agents}
    policy.policy.act = lambda observations: wanted
    for _ in range(3):
        actions = policy.act(world.observations(env))
        for agent in env.agents:
            np.testing.assert_array_equal(actions[agent], wanted[agent])
            assert not policy.intervention[agent].any()
        world.move(actions)


def test_the_filter_reads_names_not_places():
    """Columns in another order give the same actions."""
    world = Ramming(batch=20, largest=0.1)
    env = world.description()
    observations = world.observations(env)
    order = np.random.default_rng(0).permutation(len(env.layouts[env.agents[0]]))
    layouts = {
        agent: ObservationLayout(agent, [layout.fields[q] for q in order], layout.slots)
        for agent, layout in env.layouts.items()
    }
    found = []
    for description, seen in (
        (env, observations),
        (
            dataclasses.replace(env, layouts=layouts),
            {agent: values[:, order] for agent, values in observations.items()},
        ),
    ):
        policy = SafetyFilter(Ram(world))
        policy.reset(description, range(20))
        found.append(policy.act(seen))
    for agent in env.agents:
        np.testing.assert_array_equal(*(actions[agent] for actions in found))
