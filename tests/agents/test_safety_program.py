"""The safety filter's program: its rows imply the constraint for every point of every box, and its move is nearest."""

import math

import numpy as np
import pytest
from scipy.optimize import minimize

from agents.safety.rows import box_rows, nearest_move, obstacle_rows, ray_distance

DISTANCE, REACH = 0.4, 0.1
POINTS = np.linspace(-1.0, 1.0, 81)


def boxes(rng, count=5):
    """Random boxes (x, y, hx, hy) near the origin, which is outside; some are points or segments, some are large."""
    found = []
    while len(found) < count:
        half = rng.choice([0.0, 0.05, 0.3, 2.0]) * rng.uniform(0.0, 1.0, 2) * rng.integers(0, 2, 2)
        angle, away = rng.uniform(0.0, 2.0 * math.pi), rng.uniform(0.0, 0.7)
        x, y = (DISTANCE + away + np.linalg.norm(half)) * np.array([math.cos(angle), math.sin(angle)])
        if rng.random() < 0.3:  # a corner or a face at the distance, or nearer
            x, y = half[0] + rng.uniform(0.2, 0.5), rng.uniform(-half[1], half[1])
        if abs(x) > half[0] or abs(y) > half[1]:
            found.append((x, y, *half))
    return found


def program(chosen, gamma):
    """Rows of boxes, and of a square of moves."""
    rows = np.zeros((4 + 26 * len(chosen), 3))
    for row in range(4):
        rows[row, row // 2], rows[row, 2] = 1.0 - 2.0 * (row % 2), REACH / math.sqrt(2.0)
    used = 4
    for x, y, hx, hy in chosen:
        used = box_rows(x, y, hx, hy, DISTANCE, gamma, REACH, rows, used)
        assert used > 0
    return rows[:used].copy()


def on_grid(chosen, gamma):
    """The constraint itself, (a_x, a_y, b) at points of a grid on each box and of its edges."""
    found = []
    for x, y, hx, hy in chosen:
        px, py = (each.ravel() for each in np.meshgrid(x + hx * POINTS, y + hy * POINTS))
        length = np.hypot(px, py)
        found.append(np.column_stack([px, py, np.zeros_like(px)]) / length[:, None])
        found[-1][:, 2] = 0.5 * gamma * np.maximum(length - DISTANCE, 0.0)
    return np.concatenate(found)


def wishes(rng):
    """A wanted move within the square."""
    return rng.uniform(-1.0, 1.0, 2) * REACH / math.sqrt(2.0)


@pytest.mark.parametrize("gamma", [1.0, 0.3])
def test_the_move_keeps_the_constraint_at_every_point_of_every_box(gamma):
    """On a fine grid; and what the rows give up to be finitely many is a few per cent of the longest move."""
    rng, lost, checked = np.random.default_rng(0), [], 0
    for _ in range(300):
        chosen, wish = boxes(rng), wishes(rng)
        rows = program(chosen, gamma)
        z = np.array(nearest_move(rows, len(rows), *wish))
        grid = on_grid(chosen, gamma)
        assert (grid[:, :2] @ z <= grid[:, 2] + 1e-9).all()
        every = np.concatenate([rows[:4], grid])
        ideal = np.array(nearest_move(every, len(every), *wish))
        lost.append(np.linalg.norm(z - wish) - np.linalg.norm(ideal - wish))
        checked += bool(np.linalg.norm(z - wish) > 1e-6)
    assert checked > 100
    assert np.mean(lost) < 0.01 * REACH
    assert max(lost) < 0.15 * REACH


def test_the_move_is_the_nearest_that_the_rows_admit():
    """Compared with a quadratic program's solver."""
    rng = np.random.default_rng(1)
    for _ in range(60):
        count = int(rng.integers(1, 30))
        angle = rng.uniform(0.0, 2.0 * math.pi, count)
        rows = np.column_stack([np.cos(angle), np.sin(angle), rng.uniform(0.0, 1.0, count) * rng.integers(0, 2, count)])
        wish = rng.normal(size=2)
        z = np.array(nearest_move(rows, count, *wish))
        assert (rows[:, :2] @ z <= rows[:, 2] + 1e-9).all()
        found = minimize(
            lambda point, wish=wish: ((point - wish) ** 2).sum(),
            np.zeros(2),
            jac=lambda point, wish=wish: 2.0 * (point - wish),
            constraints={
                "type": "ineq",
                "fun": lambda point, rows=rows: rows[:, 2] - rows[:, :2] @ point,
                "jac": lambda point, rows=rows: -rows[:, :2],
            },
            method="SLSQP",
            options={"ftol": 1e-14, "maxiter": 300},
        )
        np.testing.assert_allclose(np.linalg.norm(z - wish), np.linalg.norm(found.x - wish), atol=1e-6)
        np.testing.assert_allclose(z, found.x, atol=2e-4)


def test_the_order_of_boxes_does_not_matter_nor_do_quarter_turns():
    """Nor any turn for boxes that are points."""
    rng = np.random.default_rng(2)
    for _ in range(100):
        chosen, wish = boxes(rng), wishes(rng)
        rows = program(chosen, 1.0)
        z = nearest_move(rows, len(rows), *wish)
        other = program([chosen[q] for q in rng.permutation(len(chosen))], 1.0)
        np.testing.assert_allclose(nearest_move(other, len(other), *wish), z, atol=1e-9)
        turned = program([(-y, x, hy, hx) for x, y, hx, hy in chosen], 1.0)
        np.testing.assert_allclose(nearest_move(turned, len(turned), -wish[1], wish[0]), (-z[1], z[0]), atol=1e-9)
        cos, sin = math.cos(0.7), math.sin(0.7)
        turn = np.array([[cos, -sin], [sin, cos]])
        points = [(x, y, 0.0, 0.0) for x, y, _, _ in chosen]
        spun = [(*turn @ (x, y), 0.0, 0.0) for x, y, _, _ in chosen]
        still, moved = program(points, 1.0)[4:], program(spun, 1.0)[4:]
        expected = turn @ nearest_move(still, len(still), *wish)
        np.testing.assert_allclose(nearest_move(moved, len(moved), *turn @ wish), expected, atol=1e-9)


def test_from_inside_a_box_no_move_is_left():
    """And z = 0 is always admitted."""
    assert box_rows(0.1, 0.0, 0.2, 0.2, DISTANCE, 1.0, REACH, np.zeros((30, 3)), 4) == -1
    rows = program([(0.3, 0.0, 0.1, 5.0), (-0.3, 0.0, 0.1, 5.0), (0.0, 0.3, 5.0, 0.1), (0.0, -0.3, 5.0, 0.1)], 1.0)
    assert np.abs(nearest_move(rows, len(rows), 0.05, 0.02)).max() < 1e-9


def test_a_move_that_comes_out_too_long_is_shortened():
    """As rounding might make it; here by a row whose normal is too long."""
    assert nearest_move(np.array([[2.0, 0.0, 1.0]]), 1, 3.0, 0.0) == (0.5, 0.0)


def test_far_boxes_add_no_rows():
    """Where no move could break the constraint."""
    assert box_rows(3.0, 0.0, 1.0, 1.0, DISTANCE, 1.0, REACH, np.zeros((30, 3)), 4) == 4


def test_a_ray_that_misses_by_rounding_is_as_short_as_the_nearest_point():
    """Which is the safe side."""
    assert ray_distance(1.0, 0.0, 0.0, 0.0, math.cos(1e-16), 1e-16, 1.0) == 1.0
    assert ray_distance(2.0, 0.0, 1.0, 1.0, 1.0, 0.0, 1.0) == 1.0
    assert ray_distance(2.0, 0.0, 1.0, 1.0, 0.8, 0.6, 1.0) == pytest.approx(1.25)


def test_an_obstacle_is_kept_away_from_for_every_direction_within_the_turn():
    """The two rows imply those between them."""
    rows = np.zeros((2, 3))
    assert obstacle_rows(0.6, 0.8, 0.25, 0.2, 0.3, REACH, rows, 0) == 2
    rng = np.random.default_rng(3)
    for _ in range(50):
        z = np.array(nearest_move(rows, 2, *rng.uniform(-0.3, 0.3, 2)))
        for turn in np.linspace(-0.3, 0.3, 13):
            angle = math.atan2(0.8, 0.6) + turn
            assert math.cos(angle) * z[0] + math.sin(angle) * z[1] <= 0.05 + 1e-9
