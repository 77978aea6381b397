"""The safety filter's theorem for agents that have to brake, and for teams of different agents."""

import dataclasses
import math

import numpy as np
import pytest

from agents import SafetyFilter, compare, describe, shielded
from agents.safety.braking import axis_map, brake_table, held, track
from agents.safety.ships import ship_axes
from agents.safety.stopping import (
    COS,
    NUMBERS,
    RAYS,
    SIN,
    STEP,
    axis_ends,
    braking_input,
    separating_rows,
    stopping_distance,
)
from khop_env.physics import DriftingIntegrator, SingleIntegrator, SurfaceVessel, Unicycle
from khop_env.registry import make_batched
from tests.agents.ramming_models import Ram, RammingTeam, cart, ship

TEAMS = {
    "carts": [cart()] * 4,
    "unicycles": [Unicycle()] * 4,
    "ships": [ship()] * 4,
    "mixed": [cart(), Unicycle(), SingleIntegrator(), ship()],
    "drifting": [cart(), DriftingIntegrator(input_limit=3.0), cart(), SingleIntegrator()],
}


def rammed(world, cycles=100, margin="certified", gamma=1.0):
    """Play the world; how often the guarantee had to be begun anew."""
    env = world.description()
    policy = SafetyFilter(Ram(world), margin, gamma=gamma)
    policy.reset(env, range(world.batch))
    lost = 0
    for _ in range(cycles):
        world.move(policy.act(world.observations(env)))
        lost += sum(int(infeasible.sum()) for infeasible in policy.infeasible.values())
    return lost


@pytest.mark.parametrize(
    ("team", "options", "near"),
    [
        ("carts", {"largest": 0.3}, 0.003),
        ("carts", {"largest": 0.02, "steps": 5}, 0.003),
        ("carts", {"largest": 0.0, "gamma": 0.4}, 0.003),
        ("carts", {"largest": 0.1, "shift": 90.0}, 0.003),
        ("unicycles", {"largest": 0.3}, 1e-4),
        ("unicycles", {"largest": 0.0, "steps": 3, "shift": -90.0}, 1e-4),
        ("ships", {"largest": 0.1}, 0.03),
        ("ships", {"largest": 0.0, "steps": 5}, 0.03),
        ("mixed", {"largest": 0.3}, 0.05),
        ("drifting", {"largest": 0.1, "steps": 2}, 0.15),
    ],
)
def test_ramming_never_collides_with_errors_on_their_bounds(team, options, near):
    """At no instant between steps of the simulator either; and they come within some millimetres of touching."""
    world = RammingTeam(TEAMS[team], batch=50, **{key: value for key, value in options.items() if key != "gamma"})
    assert rammed(world, gamma=options.get("gamma", 1.0)) == 0
    assert world.closest.min() >= 2.0 * world.radius
    assert world.closest.min() < 2.0 * world.radius + near


@pytest.mark.parametrize(("team", "speed"), [("carts", 1.0), ("unicycles", 1.0), ("ships", 1.0)])
def test_a_bound_too_small_by_one_period_collides(team, speed):
    """By what an agent at full speed goes in a period: bounds aren't larger than they have to be by more than that."""
    world = RammingTeam(TEAMS[team], batch=50, missing=speed * 0.05)
    rammed(world)
    assert (world.closest < 2.0 * world.radius).mean() > 0.3


@pytest.mark.parametrize("team", ["carts", "unicycles", "ships"])
def test_point_estimates_collide(team):
    """In the same worlds."""
    world = RammingTeam(TEAMS[team], batch=50)
    rammed(world, margin="none")
    assert (world.closest < 2.0 * world.radius).mean() > 0.5


@pytest.mark.parametrize("team", ["carts", "unicycles", "ships"])
def test_obstacles_are_not_touched(team):
    """Full speed at discs, one of which is a point: a corner."""
    discs = np.array([[0.0, 0.0, 0.3], [1.4, 0.3, 0.0]])
    world = RammingTeam(TEAMS[team], batch=50, largest=0.0, obstacles=discs, radius=0.1)
    assert rammed(world) == 0
    assert world.clearance.min() >= world.radius
    assert world.clearance.min() < world.radius + 0.03


@pytest.mark.parametrize("team", list(TEAMS))
def test_where_nothing_is_near_actions_are_the_policy_s_own(team):
    """Bit for bit, beyond their limits, too."""
    world = RammingTeam(TEAMS[team], batch=3, largest=0.0, ring=20.0)
    env, policy = world.description(), SafetyFilter(Ram(world))
    policy.reset(env, range(3))
    rng = np.random.default_rng(0)
    for _ in range(3):
        wanted = {agent: rng.uniform(-1.3, 1.3, (3, model.m)).astype(np.float32) for agent, model in env.models.items()}
        policy.policy.act = lambda observations, wanted=wanted: wanted
        actions = policy.act(world.observations(env))
        for agent in env.agents:
            np.testing.assert_array_equal(actions[agent], wanted[agent])
            assert not policy.intervention[agent].any()
        world.move(actions)


@pytest.mark.parametrize("team", ["carts", "unicycles", "ships"])
def test_what_is_clipped_or_unknown_makes_an_agent_brake(team):
    """A bound, a place or a velocity at the limit of observations."""
    world = RammingTeam(TEAMS[team], batch=1, largest=0.0, ring=20.0)
    env = world.description()
    agent, layout = env.agents[0], env.layouts[env.agents[0]]
    velocity = {"carts": ["slot0.bound.vx", "slot2.vy"], "unicycles": [], "ships": ["slot1.sway"]}[team]
    for name in ("slot1.bound.x", "slot1.position.y", "own.x", *velocity):
        policy = SafetyFilter(Ram(world))
        policy.reset(env, [0])
        observations = world.observations(env)
        observations[agent][:, layout.index(name)] = layout.high[layout.index(name)]
        actions = policy.act(observations)
        assert not actions[agent][:, : 1 if team == "unicycles" else 2].any(), name
        assert policy.infeasible[agent].tolist() == [name == "own.x"]


@pytest.mark.parametrize("gamma", [1.0, 0.3])
def test_rows_imply_the_constraint_at_every_point(gamma):
    """For random stopping boxes and convex sets S' that cover them, on a fine grid of the box of differences."""
    rng, distance, checked = np.random.default_rng(0), 0.4, 0
    grid = np.linspace(-1.0, 1.0, 61)
    for _ in range(400):
        half = rng.choice([0.0, 0.05, 0.5, 3.0], 2) * rng.random(2)
        angle, away = rng.uniform(0.0, 2.0 * math.pi), rng.uniform(0.0, 0.6)
        x, y = (distance + away) * np.array([math.cos(angle), math.sin(angle)])
        x, y = x + math.copysign(half[0], x), y + math.copysign(half[1], y) * rng.choice([1.0, 0.0])
        rows = np.zeros((40, 3))
        used = separating_rows(x, y, *half, distance, gamma, 10.0, rows, 0)
        if used < 0:
            continue
        corners = rng.normal(size=(5, 2)) * 0.1  # of S', beside the box itself
        box = np.array([[0.0, 0.0], [rng.random() * 0.2, rng.random() * 0.2]])
        corners = np.concatenate([corners, [[a, b] for a in box[:, 0] for b in box[:, 1]]])

        def more(e, corners=corners, box=box):
            return (e @ corners.T).max(axis=1) - np.maximum(e * box[0], e * box[1]).sum(axis=1)

        points = np.column_stack([each.ravel() for each in np.meshgrid(x + half[0] * grid, y + half[1] * grid)])
        length = np.linalg.norm(points, axis=1)
        allowed = 0.5 * gamma * np.maximum(length - distance, 0.0)
        # scale S' - S towards S until the rows just admit it
        of_rows, of_points = more(rows[:used, :2]), more(points / length[:, None])
        share = min(1.0, (rows[:used, 2] / np.maximum(of_rows, 1e-12)).min())
        assert (share * of_points <= allowed + 1e-9).all()
        checked += share < 1.0
    assert checked > 100


def test_rays_are_unit_vectors_and_hold_the_axes():
    """Exactly."""
    angle = STEP * np.arange(RAYS)
    np.testing.assert_allclose(COS, np.cos(angle), atol=1e-15)
    np.testing.assert_allclose(SIN, np.sin(angle), atol=1e-15)
    quarters = [RAYS // 4 * k for k in range(4)]
    assert [(COS[k], SIN[k]) for k in quarters] == [(1, 0), (0, 1), (-1, 0), (0, -1)]


@pytest.mark.parametrize(("damping", "steps"), [(0.0, 1), (2.0, 1), (2.0, 5), (15.0, 4)])
def test_braking_covers_no_more_than_the_stopping_box(damping, steps):
    """So it is always admitted; and the box is exactly what braking covers, in the simulator's steps."""
    axis, strength = axis_map(damping, 0.05, steps), 1.7
    brake = brake_table(axis, strength, 1.0)  # slower than what follows: the rest is followed step by step
    last = len(brake.knots) - 1
    numbers = [*axis[:4], 0.0, 0.0, strength, 0.05 if steps > 1 else 0.0, last, NUMBERS + 2 * (last + 1)]
    axes = np.tile(np.concatenate([numbers, *brake]), (1, 2, 1))
    for speed in [*np.linspace(-2.0, 2.0, 401), *brake.knots, 1e-9]:
        stop = [stopping_distance(axes, 0, 0, side * speed) for side in (-1.0, 1.0)]
        low, high = axis_ends(axes, 0, 0, speed, braking_input(axes, 0, 0, speed))
        assert low >= -stop[0] - 1e-13
        assert high <= stop[1] + 1e-13
        p, v, reached = 0.0, speed, [0.0]
        for _ in range(200):
            u = braking_input(axes, 0, 0, v)
            for _ in range(steps):
                p, v = p + axis.step * v, v + axis.step * (u - damping * v)
                reached.append(p)
        assert min(reached) == pytest.approx(-stop[0], abs=1e-10)
        assert max(reached) == pytest.approx(stop[1], abs=1e-10)


@pytest.mark.parametrize("steps", [1, 4])
def test_errors_stay_within_their_bounds_and_come_near(steps):
    """Under the disturbance that is worst for each of them, with errors of observation."""
    axis, pushed, rounding = axis_map(2.0, 0.05, steps), np.array([0.02, 0.1]), np.array([1e-4, 1e-4])
    tracking = track(axis, pushed, rounding, 2.0)
    state, effect, _ = held(2.0, axis.step, steps)
    closed = state + np.outer(effect, tracking.gains)
    once = np.array([[1.0, axis.step], [0.0, 1.0 - 2.0 * axis.step]])
    worst, budget, within = np.zeros(2), 0.0, 0.0
    for aim in ([1.0, 0.0], [0.0, 1.0], [*tracking.gains]):
        error = np.zeros(2)
        for k in range(60):
            ahead = np.array(aim) @ np.linalg.matrix_power(closed, 59 - k)
            seen = error + rounding * np.sign(ahead @ np.outer(effect, tracking.gains))
            budget = max(budget, abs(float(tracking.gains @ seen)))
            for j in range(steps):
                push = pushed * np.sign(ahead @ np.linalg.matrix_power(once, steps - 1 - j))
                feedback = np.array([0.0, tracking.gains @ seen])
                error = once @ error + axis.step * (push + feedback)
                within = max(within, abs(float(error[0])))
            worst = np.maximum(worst, np.abs(error))
    assert (worst <= tracking.error).all()
    assert (worst >= 0.9 * tracking.error).all()
    assert 0.5 * tracking.budget <= budget <= tracking.budget
    assert 0.75 * tracking.within <= within <= tracking.within


@pytest.mark.parametrize("steps", [1, 2, 5])
def test_ships_move_as_carts_within_the_disturbance(steps):
    """Random states of the operating region, inputs and disturbances; half of the bound is reached."""
    model, rng, period, count = ship(), np.random.default_rng(0), 0.05, 20000
    disturbance = np.array([0.0, 0.0, 0.0, 0.1, 0.1, 0.0])
    axes = ship_axes("vessel_0", model, disturbance, 1e-6, period, steps)
    axis = axis_map(axes.damping, period, steps)
    heading, course = rng.uniform(-math.pi, math.pi, (2, count))
    x = np.zeros((count, 6))
    x[:, 2] = heading
    x[:, 3:5] = 1.08 * axes.speed * np.column_stack([np.cos(course), np.sin(course)])
    limit = axes.numbers[9]
    free_gain, keep, munk = axes.numbers[8], axes.numbers[7], axes.numbers[6]
    x[:, 5] = rng.uniform(-limit, limit, count)
    u = rng.choice([-1.0, 1.0], (count, 3)) * model.input_limit
    free = keep * x[:, 5] + free_gain * munk * x[:, 3] * x[:, 4]
    yaw = np.clip(u[:, 2] / model.mass[2], (-limit - free) / free_gain, (limit - free) / free_gain)
    u[:, 2] = yaw * model.mass[2]
    assert (np.abs(u[:, 2]) <= model.input_limit[2] * (1.0 + 1e-9)).all()

    def velocity(x):
        cos, sin = np.cos(x[:, 2]), np.sin(x[:, 2])
        return np.column_stack([cos * x[:, 3] - sin * x[:, 4], sin * x[:, 3] + cos * x[:, 4]])

    start, begin = x.copy(), velocity(x)
    rate = model.drift(np.zeros(count), x) + model.input_map(np.zeros(count), x, u)
    turned = rate[:, 3:5] + x[:, 5:] * np.column_stack([-x[:, 4], x[:, 3]])
    cos, sin = np.cos(heading)[:, None], np.sin(heading)[:, None]
    acceleration = cos * turned + sin * np.column_stack([-turned[:, 1], turned[:, 0]]) + axes.damping * begin
    w = np.zeros((count, 6))
    w[:, 3:5] = 0.1 * rng.choice([-1.0, 1.0], (count, 2))
    for _ in range(steps):
        rate = model.drift(np.zeros(count), x) + model.input_map(np.zeros(count), x, u)
        x = x + period / steps * (rate + w)
        assert (np.abs(x[:, 5]) <= 1.0).all()
    expected = axis.keep * begin + axis.gain * acceleration
    place = start[:, :2] + axis.forward * begin + axis.push * acceleration
    _, _, pushed = held(axes.damping, axis.step, steps)
    allowed = pushed @ np.array([0.0, axes.pushed[2]])
    off = np.abs(velocity(x) - expected).max()
    assert 0.5 * allowed[1] < off <= allowed[1]
    assert np.abs(x[:, :2] - place).max() <= allowed[0] + 1e-12


def test_what_the_theorem_does_not_cover_is_refused():
    """With what to do about it."""
    carts = RammingTeam(TEAMS["carts"]).description()
    unicycles = RammingTeam(TEAMS["unicycles"]).description()
    pushed = {agent: np.array([0.1, 0.1, 0.0]) for agent in unicycles.models}
    strong = {agent: np.array([0.0, 0.0, 1.9, 1.9]) for agent in carts.models}
    ships = RammingTeam([SurfaceVessel()] * 4).description()
    weak = dataclasses.replace(ship(), linear_drag=(30.0, 40.0, 0.5), input_limit=(30.0, 40.0, 1.0))
    slim = RammingTeam([weak] * 4).description()
    for env, message in (
        (dataclasses.replace(unicycles, disturbance=pushed), "'unicycle_0' aside, at up to 0.1 m/s: let it act on the"),
        (
            dataclasses.replace(carts, disturbance=strong),
            "'cart_0' can't hold its place: against up to .* choose a smaller",
        ),
        (dataclasses.replace(carts, disturbance={}), "nothing of the disturbance of 'cart_0'"),
        (dataclasses.replace(carts, steps=0), "needs a simulator of order 1, or a network"),
        (ships, "can't hold 'vessel_0': at .* m/s drag and turning take up to"),
        (slim, "can't hold 'vessel_0': its moment doesn't keep its yaw rate below 0.3 rad/s at 1.1 m/s$"),
    ):
        with pytest.raises(ValueError, match=message):
            SafetyFilter(Ram(RammingTeam([cart()] * 4))).reset(env, [0])
    for env in (dataclasses.replace(unicycles, disturbance=pushed), dataclasses.replace(carts, steps=0)):
        SafetyFilter(Ram(RammingTeam([cart()] * 4)), 0.3).reset(env, [0])


@pytest.mark.parametrize(
    ("disturbance", "arguments", "message"),
    [
        (0.1, {"control_period": 0.1}, r"its place.* 0\.1, 0\.3 m/s\^2 .* period of 0\.1 s.*a shorter control period$"),
        (0.1, {"control_period": 0.1, "dt": 0.02}, r"its moment .* period of 0\.1 s: choose a shorter control period$"),
        (0.3, {}, r"its course: .*0\.42 m/s\^2 from disturbances of 0\.3, .*: choose a smaller disturbance$"),
    ],
)
def test_ships_that_cannot_be_held_are_refused_with_the_cause(disturbance, arguments, message):
    """And what the message says to change helps."""
    env = make_batched("navigation_v0", f"swap:model=vessel,disturbance={disturbance}", bounds=True, **arguments)
    with pytest.raises(ValueError, match=message):
        shielded("zero").reset(describe(env), [0])
    shielded("zero").reset(describe(make_batched("navigation_v0", "swap:model=vessel", bounds=True)), [0])


@pytest.mark.parametrize("model", ["integrator", "drifter", "cart", "unicycle", "vessel"])
def test_every_model_of_the_scenarios(model):
    """Over bursts of losses, with the filter's own policy inside."""
    compared = compare(
        "navigation_v0",
        ["filter"],
        scenario=f"swap:model={model}",
        seeds=range(2),
        arguments={"max_cycles": 40},
    )
    assert [row.policy for row in compared.rows] == ["filter"]
