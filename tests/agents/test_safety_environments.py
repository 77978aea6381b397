"""The safety filter in environments: episodes over a network, the policy inside, and what is refused."""

import dataclasses
import itertools

import networkx as nx
import numpy as np
import pytest

from agents import compare, describe, make_policy, shielded
from agents.navigation import KeepRight
from agents.policies import needs
from agents.policy import by_agent
from agents.safety.columns import without_bounds
from khop_env.observers import Exponential, TargetObservers
from khop_env.physics import DriftingIntegrator, SingleIntegrator, Sinusoid, paper_tree
from khop_env.registry import make_batched
from khop_env.scenarios import Scenario
from khop_env.tasks import Column, Consensus
from tests.agents.ramming import nearest_on

BURSTS = "lossy:period=0.05,loss=0.3,burst=5"


class Bodies(Consensus):
    """Agents that agree on a place, which discs can't."""

    def columns(self, world, agent):
        """The radius of the discs."""
        return [Column("radius", "m", 0.0, 1.0, 0.2)]


def circle(agents=8, k=6, **changes):
    """Single integrators on a circle of 2.5 m."""
    angle = 2.0 * np.pi * np.arange(agents) / agents
    values = {
        "name": "circle",
        "description": "single integrators on a circle",
        "models": (SingleIntegrator(),) * agents,
        "communication": paper_tree() if agents == 8 else nx.path_graph(agents),
        "task": nx.path_graph(agents) if k < agents - 2 else nx.complete_graph(agents),
        "k": k,
        "delta": Exponential(1.0, 0.117, 15.0),
        "observers": (TargetObservers(input_observer=False),) * agents,
        "disturbance": Sinusoid(0.1, frequency=(0.5, 2.0)),
        "center": 2.5 * np.column_stack([np.cos(angle), np.sin(angle)]).ravel(),
        "radius": 0.1,
    }
    return Scenario(**values | changes).sized()


CIRCLE = circle()


def closest(margin, name="tanh", network=BURSTS, episodes=8, cycles=120, scenario=CIRCLE):
    """(E,) smallest distances of episodes over a network, at every instant."""
    estimator = None if network is None else "relay"
    env = make_batched(Bodies(), scenario, num_envs=episodes, network=network, estimator=estimator, bounds=True)
    policy = shielded(name, margin)
    policy.reset(describe(env), range(episodes))
    observations, _ = env.reset(0)
    least = np.full(episodes, np.inf)
    for _ in range(cycles):
        before = env.simulator.x.reshape(episodes, -1, 2)
        actions = policy.act(by_agent(env, observations))
        observations, *_ = env.step(np.stack(list(actions.values()), axis=1))
        after = env.simulator.x.reshape(episodes, -1, 2)
        for i, j in itertools.combinations(range(before.shape[1]), 2):
            least = np.minimum(least, nearest_on(before[:, i] - before[:, j], after[:, i] - after[:, j]))
        assert not any(infeasible.any() for infeasible in policy.infeasible.values())
    return least


def test_over_bursts_of_losses_certified_bounds_keep_apart_and_estimates_do_not():
    """On the same episodes of agents that all want to be at one place."""
    assert closest("certified").min() >= 0.4
    assert (closest("none") < 0.4).all()


@pytest.mark.parametrize(
    ("name", "network"),
    [
        ("bang_bang", BURSTS),
        ("tanh", f"{BURSTS},noise=0.05"),
        ("tanh", "lossy:latency=0.12,jitter=0.1"),
        ("tanh", None),
    ],
)
def test_noise_delays_and_exchange_without_messages(name, network):
    """Bounds are certified, or those of the paper's observers."""
    assert closest("certified", name, network, episodes=4, cycles=80).min() >= 0.4


def test_a_team_of_integrators_with_and_without_a_drift():
    """Whose states have different names."""
    mixed = circle(models=(*(SingleIntegrator(),) * 4, *(DriftingIntegrator(input_limit=2.0),) * 4))
    assert closest("certified", episodes=4, scenario=mixed).min() >= 0.4
    assert (closest("none", episodes=4, scenario=mixed) < 0.4).any()


@pytest.mark.parametrize("uniform", [True, False])
def test_the_policy_inside_gets_what_it_would_get_without_the_filter(uniform):
    """Columns and values; and bounds if it wants them."""
    arguments = {"num_envs": 2, "network": BURSTS, "uniform": uniform}
    with_bounds, plain = (make_batched(Bodies(), CIRCLE, bounds=bounds, **arguments) for bounds in (True, False))
    kept, inside = without_bounds(describe(with_bounds))
    assert not without_bounds(describe(plain))[0]
    for env in (with_bounds, plain):
        env.reset(3)
    full, expected = (by_agent(env, env.observations()) for env in (with_bounds, plain))
    for agent, layout in describe(plain).layouts.items():
        assert inside.layouts[agent].names == layout.names
        np.testing.assert_array_equal(inside.layouts[agent].high, layout.high)
        np.testing.assert_array_equal(full[agent][:, kept[agent]], expected[agent])


def test_columns_of_padded_slots_are_left_out_like_those_of_others():
    """Agents with fewer slots are padded, to the same columns without bounds."""
    scenario = circle(5, k=2)
    with_bounds, plain = (
        describe(make_batched(Bodies(), scenario, network=BURSTS, bounds=bounds)) for bounds in (True, False)
    )
    assert len({len(layout.slots) for layout in plain.layouts.values()}) > 1
    _, inside = without_bounds(with_bounds)
    for agent, layout in plain.layouts.items():
        assert inside.layouts[agent].names == layout.names


def test_a_policy_trained_without_bounds_acts_inside_with_bounds_around():
    """It is refused if it is to get them."""
    env = make_batched("consensus_v0", "paper", bounds=True)
    policy = shielded("ppo:pretrained", 0.1, radius=0.05)
    policy.reset(describe(env), [0])
    observations, _ = env.reset(0)
    assert all(np.isfinite(action).all() for action in policy.act(by_agent(env, observations)).values())
    with pytest.raises(ValueError, match="trained on paper with"):
        shielded("ppo:pretrained", 0.1, radius=0.05, bounds=True).reset(describe(env), [0])


def test_a_policy_that_leaves_agents_out_is_named():
    """Rather than a KeyError."""
    env = make_batched(Bodies(), CIRCLE, bounds=True)
    policy = shielded("zero")
    policy.reset(describe(env), [0])
    observations = by_agent(env, env.reset(0)[0])
    for actions, message in (
        ({}, "the safety filter got no action for 'integrator_0'"),
        (dict.fromkeys(env.agents, np.zeros((1, 3))), r"must have shape \(1, 2\).* got \(1, 3\)"),
    ):
        policy.policy.act = lambda observations, actions=actions: actions
        with pytest.raises(ValueError, match=message):
            policy.act(observations)


@pytest.mark.parametrize(
    ("arguments", "scenario", "options", "message"),
    [
        ({}, CIRCLE, {}, "make the environment with bounds=True"),
        ({"bounds": True, "actuator": "lag"}, CIRCLE, {}, "actuator='direct'; the inputs of 'integrator_0' are states"),
        ({"bounds": True, "observe": "local"}, CIRCLE, {}, "needs observe='estimate' or 'oracle'"),
        ({"bounds": True}, "mixed_fleet", {}, "the disturbance pushes 'unicycle_0' aside"),
        ({"bounds": True}, circle(5, k=2), {}, "'integrator_0' doesn't know of integrator_3, integrator_4"),
        (
            {},
            circle(disturbance=Sinusoid(1.0)),
            {"margin": "none"},
            "pushed at up to 1 m/s, and its inputs are limited to 1",
        ),
    ],
)
def test_what_the_theorem_does_not_cover_is_refused(arguments, scenario, options, message):
    """With what to do about it."""
    policy = shielded("tanh", **options)
    with pytest.raises(ValueError, match=message):
        policy.reset(describe(make_batched(Bodies(), scenario, **arguments)), [0])


@pytest.mark.parametrize("scenario", ["swap:agents=4", "crossing:agents=4", "corridor:agents=4", CIRCLE])
def test_agents_start_as_far_apart_as_described(scenario):
    """Never nearer, and not much farther: by the arena, or the boxes in which they start."""
    env = make_batched("navigation_v0", scenario, num_envs=400)
    env.reset(0)
    places = env.world.positions()
    first, second = np.triu_indices(len(places), 1)
    nearest = np.linalg.norm(places[first] - places[second], axis=1).min()
    assert nearest >= describe(env).apart > 0.8 * nearest


@pytest.mark.parametrize(("model", "distance"), [("integrator", "1.67"), ("cart", "1.07")])
def test_starts_nearer_than_the_theorem_assumes_are_warned_of(model, distance):
    """With both distances; they can collide from there. Only where something is certified."""
    chosen = f"crossing:disturbance=0.9,model={model},agents=4"
    env = describe(make_batched("navigation_v0", chosen, control_period=0.5, bounds=True))
    with pytest.warns(UserWarning, match=rf"keeps agents {distance} m apart \(bodies of 0.2 m.* may start 1 m apart"):
        make_policy("filter").reset(env, [0])
    make_policy("filter:margin=none").reset(env, [0])
    make_policy("filter").reset(dataclasses.replace(env, apart=None), [0])
    make_policy("filter").reset(dataclasses.replace(env, apart=1.7), [0])
    make_policy("filter").reset(describe(make_batched("navigation_v0", f"crossing:model={model}", bounds=True)), [0])


def test_bodies_of_unknown_size_are_refused():
    """Unless a radius is given."""
    env = describe(make_batched("consensus_v0", CIRCLE, bounds=True))
    with pytest.raises(ValueError, match=r"no column 'radius'.* filter:radius=0.2:POLICY"):
        shielded("tanh").reset(env, [0])
    shielded("tanh", radius=0.2).reset(env, [0])


def test_options_out_of_range_are_refused():
    """Naming what was got."""
    for text in ("certifed", -0.1, True, float("nan"), None):
        with pytest.raises(ValueError, match="margin must be 'certified', 'none' or a number of metres"):
            shielded("tanh", text)
    for options in ({"gamma": 0.0}, {"gamma": 1.5}, {"radius": 0.0}):
        with pytest.raises(ValueError, match=f"{next(iter(options))} must be .*got {next(iter(options.values()))}"):
            shielded("tanh", **options)


def test_policies_by_name():
    """filter:OPTION=VALUE,...:POLICY, whose policy has parameters of its own."""
    policy = make_policy("filter:linear:gain=2,cancel_drift=true")
    assert (policy.margin, policy.policy.parameters) == ("certified", {"gain": 2.0, "cancel_drift": True})
    assert make_policy("filter:margin=0.3,gamma=0.5:zero").margin == 0.3
    assert isinstance(make_policy("filter").policy, KeepRight)
    assert [needs(make_policy(f"filter:margin={margin}:zero")).bounds for margin in ("certified", "none")] == [
        True,
        False,
    ]
    for spec, message in (
        ("filter:margin=none:", "there is no policy"),
        ("filter:margin=tanh:zero", "margin must be .* got 'tanh'"),
        ("filter:margn=none", "no option 'margn'; did you mean 'margin'"),
        ("filter:gamma=x", "gamma must be of type float; got 'x'"),
        ("filter:gamma=2", "gamma must be above 0 and at most 1"),
        ("filter:tan", "did you mean 'tanh'"),
        (
            "filter:linear:gain=2,radius=0.2",
            "no parameter 'radius'.*come before the policy: filter:radius=0.2:linear:gain=2$",
        ),
        (
            "filter:margin=none:line.py:Middle,radius=0.2",
            "Middle,radius=0.2': options of .* come before .*: filter:margin=none,radius=0.2:line.py:Middle$",
        ),
        (
            "filter:line.py:Middle,gain=2",
            "takes no options here; set them in the file, policy = Middle.* line.py:policy",
        ),
        ("filter:orca:margin=-1", "margin must be .*; got -1.0$"),
        ("filter:filter", "policy 'filter:filter': the policy is in a safety filter already"),
        ("filter:gamma=0.5:filter:margin=none:zero", "the policy is in a safety filter already"),
    ):
        with pytest.raises(ValueError, match=message):
            make_policy(spec)


def test_comparisons_switch_bounds_on():
    """For the rows that need them."""
    compared = compare(
        Bodies(),
        ["tanh", "filter:margin=none:tanh", "filter:tanh"],
        scenario=CIRCLE,
        seeds=range(2),
        arguments={"network": BURSTS, "max_cycles": 10},
    )
    has = [any("bound" in name for name in row.env.layouts["integrator_0"].names) for row in compared.rows]
    assert has == [False, False, True]
