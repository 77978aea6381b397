"""A safety filter that is given what isn't for it: another's state, other observations, options out of range."""

import numpy as np
import pytest

from agents import SafetyFilter, ShieldedEnv, describe, make_policy, shielded
from agents.policy import by_agent
from khop_env import navigation_v0
from khop_env.registry import make_batched


def played(agents=4, num_envs=2, policy="keep_right", cycles=3, model="integrator", **options):
    """A filter that has acted, and the observations that it got last."""
    env = make_batched("navigation_v0", f"swap:agents={agents},model={model}", num_envs=num_envs, bounds=True)
    found = SafetyFilter(make_policy(policy), **options)
    found.reset(describe(env), range(num_envs))
    observations, _ = env.reset(0)
    for _ in range(cycles):
        seen = by_agent(env, observations)
        observations, *_ = env.step(np.stack(list(found.act(seen).values()), axis=1))
    return found, by_agent(env, observations)


@pytest.mark.parametrize(
    ("other", "message"),
    [
        ({"agents": 8}, r"'anchor' in the state .* float64 of shape \(batch, 4, 2\); got float64 of shape \(2, 8, 2\)"),
        ({"model": "cart"}, r"'anchor' in the state .* got float64 of shape \(2, 4, 4\)"),
        ({"num_envs": 3}, "the state is of a batch of 3, and this safety filter plays 2"),
        ({"margin": 0.1, "dead_reckoning": True}, "has anchor, started, resting, memory; got anchor, .*, velocity"),
    ],
)
def test_a_state_of_another_filter_is_refused(other, message):
    """Nothing has changed then."""
    policy, observations = played()
    before = policy.get_state()
    with pytest.raises(ValueError, match=message):
        policy.set_state(played(**other)[0].get_state())
    for name, array in policy.get_state().items():
        np.testing.assert_array_equal(array, before[name])
    policy.act(observations)


def test_what_is_no_state_is_refused():
    """Saying what a state is."""
    policy, _ = played()
    state = policy.get_state()
    for wrong, message in (
        (None, r"a dict of anchor, started, resting, memory, from get_state\(\); got NoneType"),
        ({}, "has anchor, started, resting, memory; got nothing"),
        ({**state, "anchor": [1.0]}, r"'anchor' in the state .* got \[1.0\]"),
        ({**state, "started": state["started"].astype(float)}, "'started' in the state .* is bool .* got float64"),
        ({**state, "resting": state["resting"][:1]}, "of a batch of 1 and 2"),
    ):
        with pytest.raises(ValueError, match=message):
            policy.set_state(wrong)
    for name, array in policy.get_state().items():
        np.testing.assert_array_equal(array, state[name])
    fresh, observations = played(cycles=0)
    empty = fresh.get_state()
    first = fresh.act(observations)
    fresh.set_state(empty)
    for agent, action in fresh.act(observations).items():
        np.testing.assert_array_equal(action, first[agent])


def test_a_refused_state_leaves_a_shielded_environment_as_it_is():
    """Both parts of it, whichever is wrong."""
    env = ShieldedEnv(navigation_v0.parallel_env("swap:agents=4", bounds=True))
    env.reset(0)
    early = env.get_state()
    for _ in range(3):
        env.step(dict.fromkeys(env.agents, np.ones(2, np.float32)))
    before = env.get_state()
    other = ShieldedEnv(navigation_v0.parallel_env("swap:agents=8", bounds=True))
    other.reset(0)
    for wrong in ((early[0], {}), (other.get_state()[0], early[1]), (early[0], other.get_state()[1])):
        with pytest.raises((TypeError, ValueError)):
            env.set_state(wrong)
        inner, remembered = env.get_state()
        np.testing.assert_array_equal(inner.simulator.x, before[0].simulator.x)
        for name, array in remembered.items():
            np.testing.assert_array_equal(array, before[1][name])


def test_states_hold_what_dead_reckoning_remembers():
    """A filter of the same kind goes on bit for bit."""
    options = {"agents": 4, "margin": 0.3, "dead_reckoning": True, "policy": "go_to_goal"}
    policy, observations = played(cycles=50, **options)
    fresh, _ = played(cycles=0, **options)
    state = policy.get_state()
    without = state | {"velocity": 0.0 * state["velocity"], "stamp": np.full_like(state["stamp"], -np.inf)}
    fresh.set_state(state)
    blind, _ = played(cycles=0, **options)
    blind.set_state(without)
    expected, found, other = (each.act(observations) for each in (policy, fresh, blind))
    for agent, action in expected.items():
        np.testing.assert_array_equal(found[agent], action)
    assert any((other[agent] != action).any() for agent, action in expected.items())


def test_before_the_reset_there_is_nothing_to_act_on():
    """With the call that comes first."""
    policy = shielded("zero")
    for call in (
        lambda: policy.act({}),
        lambda: policy.correct({}, {}),
        lambda: policy.seen({}),
        lambda: policy.begin(1),
        policy.get_state,
        lambda: policy.set_state({}),
    ):
        with pytest.raises(ValueError, match=r"call reset\(describe\(env\), seeds\) first"):
            call()


def test_observations_are_checked():
    """Before the policy inside gets them; lists of numbers are as good as arrays."""
    policy, observations = played()
    agent, other = list(observations)[:2]
    for wrong, message in (
        ({}, "got no observation of 'integrator_0'"),
        ([1.0], "must be a dict with an array for each agent, e.g. for 'integrator_0'; the safety filter got list"),
        ({**observations, agent: "a"}, "observation of 'integrator_0' isn't numbers: 'a'"),
        ({**observations, agent: [[1.0], [1.0, 2.0]]}, "observation of 'integrator_0' isn't numbers"),
        ({**observations, agent: 1.0}, "columns of 'integrator_0' .* it got a single number"),
        ({**observations, agent: observations[agent][:, 1:]}, "columns of 'integrator_0' .* it got"),
        ({**observations, other: observations[other][:1]}, "must be of one batch: those of 'integrator_0' have shape"),
    ):
        for call in (policy.act, lambda seen: policy.correct(seen, {})):
            with pytest.raises(ValueError, match=message):
                call(wrong)
    state = policy.get_state()
    expected = policy.act(observations)
    policy.set_state(state)
    for agent, action in policy.act({name: each.tolist() for name, each in observations.items()}).items():
        np.testing.assert_array_equal(action, expected[agent])


@pytest.mark.parametrize(
    ("options", "message"),
    [
        ({"gamma": "a"}, "gamma must be above 0 and at most 1; got 'a'"),
        ({"gamma": True}, "gamma must be above 0 and at most 1; got True"),
        ({"gamma": None}, "gamma must be above 0 and at most 1; got None"),
        ({"radius": "a"}, "radius must be a positive number of metres; got 'a'"),
        ({"radius": [0.2]}, r"radius must be a positive number of metres; got \[0.2\]"),
    ],
)
def test_options_that_are_no_numbers_are_refused(options, message):
    """As those out of range."""
    with pytest.raises(ValueError, match=message):
        shielded("zero", **options)


def test_a_radius_below_what_is_observed_is_refused():
    """Where the distance is to be certain; that of observations, or more, is fine."""
    with pytest.raises(ValueError, match=r"radius=0.1 agents would touch: 'integrator_0' observes a radius of 0.2 m"):
        played(radius=0.1)
    played(radius=0.1, margin=0.0)
    played(radius=0.2)
    played(radius=0.3)


def test_a_simulator_of_order_2_is_refused():
    """Bounds hold in steps of order 1; over a network there is nothing but these."""
    for model in ("integrator", "cart"):
        text = f"crossing:continuous=true,model={model}"
        env = describe(make_batched("navigation_v0", text, order=2, bounds=True))
        with pytest.raises(ValueError, match=r"needs a simulator of order 1, or a network.* leave order=2 out"):
            shielded("zero").reset(env, [0])
        if model == "integrator":  # carts: `test_safety_models.py`
            shielded("zero", 0.3).reset(env, [0])
        shielded("zero").reset(describe(make_batched("navigation_v0", text, bounds=True)), [0])
