"""ORCA: half planes by their definition, velocities of the published library, episodes of all models."""

import math

import numpy as np
import pytest
from hypothesis import assume, given
from hypothesis import strategies as st

from agents import describe, make_policy, play
from agents.half_planes import BOX, best_velocity, box_limits
from agents.orca import half_plane
from agents.policy import by_agent
from khop_env import consensus_v0, make_batched
from khop_env.scenarios.teams import TEAM_MODELS

HORIZON, PERIOD, RADIUS = 2.0, 0.05, 0.4

# own velocity; wish; others' places and velocities; velocity by the authors' library RVO2, in C++ (by pyrvo 0.4.3), for
# discs of 0.2 m, horizon 2 s, step 0.05 s: others on the way, nobody on it, bodies that overlap, nothing that all admit
PUBLISHED = [
    (
        (-0.01, 0.21),
        (-0.61, 0.08),
        [(-0.55, 0.91, 0.55, 0.52), (-1.05, 0.43, -0.67, 0.29), (0.89, -0.65, -0.7, 0.0)],
        (-0.54946, 0.1566),
    ),
    ((-0.36, -0.21), (0.43, -0.26), [(-0.84, 0.48, -0.37, -0.25), (-0.12, 0.72, 0.42, 0.01)], (0.29365, -0.38579)),
    ((0.01, -0.32), (-0.68, 0.61), [(-0.99, 0.83, -0.14, 0.61), (-0.32, 1.08, 0.08, -0.36)], (-0.52348, -0.25953)),
    (
        (-0.15, 0.36),
        (-0.43, -0.15),
        [(0.72, -0.29, 0.31, 0.43), (0.51, 0.27, -0.49, 0.3), (1.06, 1.18, 0.49, -0.14)],
        (-0.43, -0.15),
    ),
    (
        (0.37, 0.02),
        (-0.3, -0.62),
        [(-0.28, -0.22, -0.37, -0.09), (-1.09, -1.08, 0.66, 0.56), (1.2, 0.37, 0.48, -0.15)],
        (0.53662, -0.02487),
    ),
    ((-0.06, -0.06), (-0.31, 0.44), [(-0.11, -0.97, -0.2, -0.56), (-0.36, -0.04, 0.54, -0.49)], (0.47385, 0.58608)),
    (
        (-0.12, 0.47),
        (0.24, 0.07),
        [(0.25, 0.13, 0.27, 0.61), (-1.09, -0.58, 0.68, -0.39), (-0.31, 0.16, 0.43, -0.59)],
        (-0.06201, -0.57629),
    ),
    (
        (-0.23, 0.23),
        (0.1, -0.2),
        [(0.87, -0.74, -0.47, -0.2), (0.35, 0.66, 0.39, 0.59), (-0.06, 0.31, -0.62, 0.16)],
        (0.92922, -0.0689),
    ),
]


@pytest.mark.parametrize(("own", "wish", "others", "expected"), PUBLISHED)
def test_velocities_are_those_of_the_published_library(own, wish, others, expected):
    """Where its disc of speeds and our box don't matter; it has them in float32."""
    rows = np.zeros((BOX + len(others), 3))
    box_limits(-1.0, 1.0, -1.0, 1.0, rows)
    for row, (x, y, vx, vy) in enumerate(others, BOX):
        nx, ny, ux, uy = half_plane(x, y, own[0] - vx, own[1] - vy, RADIUS, HORIZON, PERIOD)
        rows[row] = -nx, -ny, -(nx * (own[0] + 0.5 * ux) + ny * (own[1] + 0.5 * uy))
    x, y, _ = best_velocity(rows, BOX, len(rows), *wish)
    np.testing.assert_allclose((x, y), expected, atol=3e-5)


def closest(place, velocity, horizon=HORIZON):
    """Smallest distance of a point that moves past, until the horizon, (..., 2) velocities."""
    velocity = np.asarray(velocity)
    square = (velocity**2).sum(axis=-1)
    time = np.clip((velocity @ place) / np.where(square > 0.0, square, 1.0), 0.0, horizon)
    return np.linalg.norm(place - velocity * time[..., None], axis=-1)


@given(
    st.floats(0.42, 4.0), st.floats(-3.2, 3.2), st.floats(0.01, 2.5), st.floats(-3.2, 3.2)
)  # where the other is, and the relative velocity, in polar coordinates
def test_the_change_is_the_smallest_that_reaches_the_boundary(distance, direction, speed, course):
    """By the definition of velocities that lead to a collision; and the normal leads out of them."""
    place = distance * np.array([math.cos(direction), math.sin(direction)])
    velocity = speed * np.array([math.cos(course), math.sin(course)])
    *normal, ux, uy = half_plane(*place, *velocity, RADIUS, HORIZON, PERIOD)
    change = np.array([ux, uy])
    length = np.linalg.norm(change)
    assume(length > 1e-3)
    np.testing.assert_allclose(closest(place, velocity + change), RADIUS, atol=1e-7)
    np.testing.assert_allclose(np.linalg.norm(normal), 1.0)
    colliding = closest(place, velocity) < RADIUS
    assert (change @ normal > 0.0) == colliding
    np.testing.assert_allclose(abs(change @ normal), length, rtol=1e-6)
    turns = np.linspace(0.0, 2.0 * math.pi, 100)
    smaller = velocity + 0.995 * length * np.column_stack([np.cos(turns), np.sin(turns)])
    assert ((closest(place, smaller) < RADIUS) == colliding).all()


def test_bodies_that_overlap_are_apart_after_a_period_and_no_direction_is_undefined():
    place, velocity = np.array([0.1, 0.2]), np.array([0.3, -0.1])
    change = half_plane(*place, *velocity, RADIUS, HORIZON, PERIOD)[2:]
    after = place - PERIOD * (velocity + np.array(change))
    np.testing.assert_allclose(np.linalg.norm(after), RADIUS)
    for x, y, vx, vy in ((0.0, 0.0, 0.0, 0.0), (0.1, 0.0, 2.0, 0.0)):
        found = half_plane(x, y, vx, vy, RADIUS, HORIZON, PERIOD)
        np.testing.assert_allclose(np.hypot(*found[:2]), 1.0)
        assert np.isfinite(found).all()


def test_on_the_truth_nobody_collides_and_straight_ways_do():
    """Over the same episodes, without a disturbance; 2 cm make up for velocities that are a period old."""
    env = make_batched("navigation_v0", "crossing:disturbance=0,loss=0,burst=1", num_envs=30, observe="oracle")
    orca, straight = (play(env, make_policy(name), range(30)).outcomes for name in ("orca:margin=0.02", "go_to_goal"))
    assert orca["collision"].mean() == 0.0
    assert orca["success"].mean() > 0.9
    assert straight["collision"].mean() > 0.8


@pytest.mark.parametrize("model", TEAM_MODELS)
def test_every_model_collides_less_than_by_going_straight(model):
    """And arrives; where inputs aren't velocities its assumptions don't hold, and some still collide."""
    env = make_batched("navigation_v0", f"crossing:model={model},loss=0,burst=1", num_envs=16)
    orca, straight = (play(env, make_policy(name), range(16)).outcomes for name in ("orca:margin=0.1", "go_to_goal"))
    assert orca["collision"].mean() < 0.5 * straight["collision"].mean()
    assert orca["success"].mean() > 0.6


def test_walls_are_not_touched():
    """By integrators that push against them."""
    env = make_batched("navigation_v0", "corridor:loss=0,burst=1", num_envs=12)
    policy = make_policy("orca:margin=0.1")
    policy.reset(describe(env), range(12))
    observations, infos = env.reset(0)
    nearest = np.full(12, np.inf)
    for _ in range(150):
        observations, *_, infos = env.step(
            np.concatenate(list(policy.act(by_agent(env, observations)).values()), axis=1)
        )
        nearest = np.minimum(nearest, infos["obstacle_distance"].min(axis=1))
    assert (nearest >= env.task.arena.radius).all()
    assert nearest.min() < env.task.arena.radius + 0.15


def test_what_does_not_fit_is_refused():
    with pytest.raises(ValueError, match=r"policy 'orca:horizon=0': horizon must be positive and finite; got 0.0"):
        make_policy("orca:horizon=0")
    with pytest.raises(ValueError, match=r"margin must be 0 or more and finite; got -1.0"):
        make_policy("orca:margin=-1")
    with pytest.raises(ValueError, match=r"policy 'orca:horizn=1': no option 'horizn'; did you mean 'horizon'"):
        make_policy("orca:horizn=1")
    with pytest.raises(ValueError, match=r"go_to_goal needs an environment with goals"):
        make_policy("orca").reset(describe(consensus_v0.parallel_env()), [0])
