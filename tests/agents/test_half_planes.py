"""The program over half planes, against exact enumeration and a linear program's solver."""

import itertools

import numpy as np
from hypothesis import given
from hypothesis import strategies as st
from scipy.optimize import linprog

from agents.half_planes import BOX, best_velocity, box_limits

BOX_ROWS = np.array([[1.0, 0.0, 1.0], [-1.0, 0.0, 1.0], [0.0, 1.0, 1.0], [0.0, -1.0, 1.0]])
planes = st.lists(st.tuples(st.integers(0, 359), st.integers(-20, 30)), max_size=7)
wishes = st.tuples(st.floats(-2.0, 2.0), st.floats(-2.0, 2.0))


def rows_of(chosen, turn=0.0):
    """Half planes by degrees and twentieths, after the box's."""
    angle = np.deg2rad([degrees for degrees, _ in chosen]) + turn
    rest = np.column_stack([np.cos(angle), np.sin(angle), [0.05 * b for _, b in chosen]])
    return np.concatenate([BOX_ROWS, rest.reshape(-1, 3)])


def least_violation(rows, hard):
    """The smallest largest violation of rows from `hard` on, which may be negative; None if hard rows contradict."""
    soft = np.arange(len(rows)) >= hard
    found = linprog(
        [0, 0, 1], np.column_stack([rows[:, :2], -1.0 * soft]), rows[:, 2], bounds=[(None, None)] * 2 + [(-5, 5)]
    )
    return found.fun if found.status == 0 else None


def nearest(rows, wish):
    """Distance of the nearest point: among the wish, its feet on all lines, and their crossings."""
    points = [wish]
    points += [wish - (row[:2] @ wish - row[2]) * row[:2] for row in rows]
    for one, two in itertools.combinations(rows, 2):
        if abs(one[0] * two[1] - one[1] * two[0]) > 1e-9:
            points.append(np.linalg.solve(np.array([one[:2], two[:2]]), [one[2], two[2]]))
    inside = [point for point in points if (rows[:, :2] @ point <= rows[:, 2] + 1e-9).all()]
    return min(np.linalg.norm(point - wish) for point in inside)


@given(planes, wishes)
def test_the_nearest_or_the_least_violation(chosen, wish):
    rows, wish = rows_of(chosen), np.array(wish)
    least = least_violation(rows, BOX) if chosen else -1.0
    x, y, kept = best_velocity(rows, BOX, len(rows), *wish)
    violation = rows[:, :2] @ (x, y) - rows[:, 2]
    assert violation[:BOX].max() <= 1e-9
    assert violation.max() <= max(least, 0.0) + 1e-6
    if least > 1e-6:
        assert not kept
    if least < -1e-6:
        assert kept
        np.testing.assert_allclose(np.linalg.norm((x, y) - wish), nearest(rows, wish), atol=1e-6)


@given(planes, planes, wishes)
def test_hard_rows_are_kept_where_they_can_be(first, then, wish):
    """Whatever the others demand; else all but the box are equal."""
    rows, hard = rows_of(first + then), BOX + len(first)
    x, y, _ = best_velocity(rows, hard, len(rows), *wish)
    violation = rows[:, :2] @ (x, y) - rows[:, 2]
    assert violation[:BOX].max() <= 1e-9
    if not then:
        return
    possible = least_violation(rows[:hard], BOX) if first else -1.0
    if possible < -1e-6:
        assert violation[:hard].max() <= 1e-6
        assert violation[hard:].max() <= max(least_violation(rows, hard), 0.0) + 1e-6
    if possible > 1e-6:
        assert violation[BOX:].max() <= least_violation(rows, BOX) + 1e-6


def test_the_order_of_rows_does_not_matter_where_they_agree():
    rng = np.random.default_rng(0)
    for _ in range(200):
        rows = rows_of([(int(rng.integers(360)), int(rng.integers(0, 30))) for _ in range(6)])
        wish = rng.uniform(-2.0, 2.0, 2)
        other = np.concatenate([rows[:BOX], rng.permutation(rows[BOX:])])
        one, two = (best_velocity(each, BOX, len(each), *wish) for each in (rows, other))
        assert one[2]
        np.testing.assert_allclose(one, two, atol=1e-9)


def test_a_box_is_its_four_rows():
    rows = np.full((BOX, 3), np.nan)
    box_limits(-0.2, 0.3, -0.4, 0.5, rows)
    assert best_velocity(rows, BOX, BOX, 1.0, 1.0) == (0.3, 0.5, True)
    assert best_velocity(rows, BOX, BOX, -1.0, -1.0) == (-0.2, -0.4, True)
    assert best_velocity(rows, BOX, BOX, 0.1, -0.1) == (0.1, -0.1, True)
