"""What the certified filter is compared with: dead reckoning, constant margins, the truth, a textbook barrier."""

import numpy as np
import pytest
from scipy.optimize import linprog

from agents import describe, make_policy, play, shielded
from agents.others import Others, side_by_side
from agents.policies import needs
from agents.policy import by_agent
from khop_env import consensus_v0, make_batched, navigation_v0

BURSTS = "crossing:disturbance=0,loss=0.3,burst=5"


def driven(scenario, steps, inputs, batch=4, **options):
    """Others' tables along an episode in which agents have constant inputs, as (others, flat, world) at each step."""
    env = make_batched("navigation_v0", scenario, num_envs=batch, **options)
    others = Others(describe(env))
    observations, _ = env.reset(0)
    width = env.action_offset[-1] // len(env.agents)
    actions = np.tile(np.resize(inputs, (len(env.agents), width)).ravel(), (batch, 1)).astype(np.float32)
    for _ in range(steps):
        flat = side_by_side(by_agent(env, observations), tuple(env.agents))
        others.update(flat)
        yield others, flat, env
        observations, *_ = env.step(actions)


def truth(env, description):
    """(B, P, 2) where others are, from the agent that observes them, in m."""
    places = env.world.positions().transpose(2, 0, 1)
    layouts = description.layouts.values()
    return np.stack([places[:, s.agent] - places[:, i] for i, layout in enumerate(layouts) for s in layout.slots], 1)


@pytest.mark.parametrize("model", ["integrator", "unicycle"])
def test_dead_reckoning_is_exact_at_constant_velocities(model):
    """Once two positions have arrived, whatever their ages; held positions are not."""
    inputs = np.random.default_rng(0).uniform(-0.6, 0.6, (8, 2))
    if model == "unicycle":
        inputs[:, 1] = 0.0  # straight on
    worst = held = 0.0
    for step, (others, flat, env) in enumerate(driven(f"{BURSTS},model={model}", 80, inputs)):
        if step < 60:
            continue
        right = truth(env, describe(env))
        worst = max(worst, np.abs(others.extrapolated(flat)[:, others.position] - right).max())
        held = max(held, np.abs(flat[:, others.position] - right).max())
    assert others.moved_on.all()
    assert worst < 2e-4
    assert held > 0.5


@pytest.mark.parametrize("model", ["integrator", "drifter", "cart", "vessel"])
def test_on_the_truth_velocities_are_those_of_states_or_motion(model):
    """And nothing is moved on: ages are those of messages, which don't matter there."""
    inputs = np.random.default_rng(1).uniform(-0.5, 0.5, (8, 3 if model == "vessel" else 2))
    before = None
    for step, (others, flat, env) in enumerate(driven(f"{BURSTS},model={model}", 30, inputs, observe="oracle")):
        np.testing.assert_array_equal(others.extrapolated(flat), flat)
        places = env.world.positions().transpose(2, 0, 1).copy()
        if before is not None:
            layouts = describe(env).layouts.values()
            rate = (places - before) / env.settings.control_period
            moved = np.stack([rate[:, s.agent] for layout in layouts for s in layout.slots], 1)
            np.testing.assert_allclose(others.velocity, moved, atol=0.06)  # accelerations of up to 1 m/s^2
            assert step < 20 or np.abs(moved).max() > 0.2
        before = places
    assert not others.moved_on.any()


def test_velocities_are_cut_off_at_what_the_agent_can_do():
    """Positions that jump, as they do at the beginning of another episode."""
    env = make_batched("navigation_v0", "crossing:speed=0.7", num_envs=2)
    others, flat = Others(describe(env)), None
    for seed in (0, 1, 2):
        observations, _ = env.reset(seed)
        flat = side_by_side(by_agent(env, observations), tuple(env.agents))
        flat[:, others.valid] = 1.0
        flat[:, others.position] += np.random.default_rng(seed).normal(size=(2, len(others.valid), 2))
        others.update(flat)
    assert np.abs(others.velocity).max() == 0.7
    flat[:, others.valid] = 0.0
    others.update(flat)
    assert not others.ahead.any()


def test_dead_reckoning_collides_less_than_held_positions_but_does():
    """By one message every 0.07 s; over bursts of losses both collide often, and the certified filter doesn't."""
    found = {}
    for losses in ("burst=1", "burst=5"):
        for options in ("margin=none", "margin=none,dead_reckoning=true"):
            env = make_batched("navigation_v0", f"swap:{losses}", num_envs=32)
            found[losses, options] = play(env, make_policy(f"filter:{options}"), range(32)).outcomes["collision"].mean()
    assert found["burst=1", "margin=none,dead_reckoning=true"] < 0.6 * found["burst=1", "margin=none"]
    assert found["burst=5", "margin=none,dead_reckoning=true"] > 0.2


def test_dead_reckoning_is_refused_where_it_has_nothing_to_do_or_no_meaning():
    with pytest.raises(
        ValueError, match=r"dead_reckoning=True needs margin='none' or a number .* got margin='certified'"
    ):
        make_policy("filter:dead_reckoning=true")
    policy = shielded("keep_right", 0.1, dead_reckoning=True)
    assert "dead_reckoning=True" in repr(policy)
    assert not make_policy("filter:margin=0.1").dead_reckoning
    policy.reset(describe(make_batched("navigation_v0", "crossing", observe="oracle")), [0])  # it changes nothing there
    for scenario in ("crossing:continuous=true", "crossing:model=drifter"):
        with pytest.raises(
            ValueError, match=r"dead_reckoning=True has nothing to do: .* give the environment a network"
        ):
            policy.reset(describe(make_batched("navigation_v0", scenario)), [0])


def test_the_worst_case_margin_stands_still():
    """A margin of the largest age that occurs, times the speed: nobody collides, nobody gets anywhere."""
    env = make_batched("navigation_v0", "crossing", num_envs=16)
    layouts = describe(env).layouts
    oldest, observations = 0.0, env.reset(range(16))[0]
    for _ in range(200):
        for agent, values in by_agent(env, observations).items():
            ages = [layouts[agent].index(f"slot{q}.age") for q in range(len(layouts[agent].slots))]
            oldest = max(oldest, float(values[:, ages].max()))
        observations, *_ = env.step(np.zeros((16, env.action_offset[-1]), np.float32))
    margin = oldest * (1.0 + 0.1)
    assert margin > 2.0
    policy = make_policy(f"filter:margin={margin:.3g}")
    policy.reset(describe(env), range(16))
    observations, _ = env.reset(range(16))
    for step in range(90):
        if step == 40:  # everybody has heard of everybody
            start = env.world.positions().copy()
        observations, *_ = env.step(np.concatenate(list(policy.act(by_agent(env, observations)).values()), axis=1))
    moved = np.linalg.norm(env.world.positions() - start, axis=1)
    assert np.quantile(moved, 0.9) < 0.1
    assert not play(env, policy, range(16)).outcomes["success"].any()


def test_on_the_truth_nobody_collides_and_blind_beyond_neighbours_they_do():
    """The same filter without a margin; `--observe oracle` and `--observe local` of `khop evaluate`."""
    found = {}
    for observe in ("oracle", "local"):
        env = make_batched("navigation_v0", "crossing", num_envs=32, observe=observe)
        found[observe] = play(env, make_policy("filter:margin=none"), range(32)).outcomes
    assert not found["oracle"]["collision"].any()
    assert found["oracle"]["success"].mean() > 0.9
    assert found["local"]["collision"].mean() > 0.5


@pytest.mark.parametrize("model", ["crossing", "corridor:model=drifter"])
def test_the_certified_filter_keeps_away_from_walls_and_all(model):
    """Also agents whose coordinates have names other than x and y."""
    env = make_batched("navigation_v0", model, num_envs=12, bounds=True)
    assert not play(env, make_policy("filter"), range(12)).outcomes["collision"].any()


# -- the textbook barrier ----------------------------------------------------------------------------------------------


def barriers(layout, values, radius, alpha, speed, pushed):
    """(R, 3) rows e . v <= b of one agent, from its observation by names."""
    found = []
    seen = layout.read(values)
    for q in range(len(layout.slots)):
        place = np.array([seen[f"slot{q}.position.{axis}"] for axis in "xy"])
        bound = np.hypot(*(seen[f"slot{q}.bound.{axis}"] for axis in "xy"))
        distance = np.linalg.norm(place)
        e = place / distance
        fastest = np.abs(e).sum() * (speed + 2.0 * pushed)
        found.append([*e, alpha * (distance - bound - 2.0 * radius) - fastest])
    return np.array(found)


def test_the_barrier_is_kept_where_it_can_be_and_violated_least_elsewhere():
    """Along an episode, from the observations alone, by a linear program's solver."""
    env = make_batched("navigation_v0", "crossing", num_envs=4, bounds=True)
    description, policy = describe(env), make_policy("robust_barrier:alpha=8")
    policy.reset(description, range(4))
    observations, _ = env.reset(0)
    counted = np.zeros(2, int)
    for step in range(60):
        seen = by_agent(env, observations)
        actions = policy.act(seen)
        for agent, layout in description.layouts.items() if step % 10 == 9 else ():
            for b in range(4):
                rows = barriers(layout, seen[agent][b], 0.2, 8.0, 1.0, 0.1)
                violation = (rows[:, :2] @ actions[agent][b].astype(float) - rows[:, 2]).max()
                soft = np.column_stack([rows[:, :2], -np.ones(len(rows))])
                least = linprog([0, 0, 1], soft, rows[:, 2], bounds=[(-1, 1), (-1, 1), (None, None)]).fun
                assert violation <= max(least, 0.0) + 1e-5
                if abs(least) > 1e-4:
                    assert policy.infeasible[agent][b] == (least > 0.0)
                counted[int(policy.infeasible[agent][b])] += 1
        observations, *_ = env.step(np.concatenate(list(actions.values()), axis=1))
    assert counted.min() > 10


def test_the_barrier_keeps_apart_few_that_know_well_and_not_many_over_bursts():
    """It is no guarantee: over bursts of losses it often has no solution."""
    env = make_batched("navigation_v0", "crossing:agents=4,loss=0,burst=1", num_envs=32, bounds=True)
    outcomes = play(env, make_policy("robust_barrier"), range(32)).outcomes
    assert not outcomes["collision"].any()
    assert (outcomes["intervention"] > 0.0).all()
    assert outcomes["success"].mean() > 0.9
    env = make_batched("navigation_v0", "swap:loss=0.3,burst=5", num_envs=32, bounds=True)
    outcomes = play(env, make_policy("robust_barrier"), range(32)).outcomes
    assert outcomes["collision"].mean() > 0.1
    assert outcomes["infeasible"].mean() > 0.1


def test_what_the_barrier_is_not_for_is_refused():
    assert needs(make_policy("robust_barrier:alpha=2")).bounds
    assert needs(shielded("robust_barrier", 0.1)).bounds
    assert not needs(make_policy("orca")).bounds
    shielded("robust_barrier", 0.1).reset(describe(make_batched("navigation_v0", "crossing", bounds=True)), [0])
    with pytest.raises(ValueError, match=r"alpha must be positive and finite; got -1.0"):
        make_policy("robust_barrier:alpha=-1")
    for scenario, bounds, message in (
        ("crossing", False, r"robust_barrier reads certified bounds: make the environment with bounds=True"),
        ("crossing:model=cart", True, r"for agents whose input is a velocity .*'cart_0' is a DoubleIntegrator"),
    ):
        env = make_batched("navigation_v0", scenario, bounds=bounds)
        with pytest.raises(ValueError, match=message):
            make_policy("robust_barrier").reset(describe(env), [0])
    with pytest.raises(ValueError, match="go_to_goal needs an environment with goals"):
        make_policy("robust_barrier").reset(describe(consensus_v0.parallel_env(bounds=True)), [0])


def test_a_single_environment_has_values_without_a_batch():
    """As frames and films read them."""
    env = navigation_v0.parallel_env(bounds=True)
    policy = make_policy("robust_barrier")
    policy.reset(describe(env), [0])
    observations, _ = env.reset(seed=0)
    actions = policy.act(observations)
    for agent in env.agents:
        shapes = (each[agent].shape for each in (actions, policy.correction, policy.intervention, policy.infeasible))
        assert tuple(shapes) == ((2,), (2,), (), ())
