"""Compiled program over half planes: the velocity nearest to a wish, or else the one that violates them least.

Source: J. van den Berg, S. J. Guy, M. Lin and D. Manocha, Reciprocal n-Body Collision Avoidance, Robotics Research
(ISRR 2009), Springer, 2011, section 5.2 and 5.3: incremental linear programming in two and in three dimensions.
"""

from __future__ import annotations

import math

import numpy as np

from khop_env.compiled import compiled
from khop_env.observers import FloatArray

TOLERANCE = 1e-10  # rows that are broken by less count as kept
BOX = 4  # rows of a box, which come first


@compiled
def box_limits(low_x: float, high_x: float, low_y: float, high_y: float, rows: FloatArray) -> None:
    """Write the rows of a box, which every program begins with."""
    for row in range(BOX):
        rows[row, 0] = rows[row, 1] = 0.0
        rows[row, row // 2] = 1.0 if row % 2 == 0 else -1.0
    rows[0, 2], rows[1, 2], rows[2, 2], rows[3, 2] = high_x, -low_x, high_y, -low_y


@compiled
def best_velocity(rows: FloatArray, hard: int, used: int, wx: float, wy: float) -> tuple[float, float, bool]:
    """The velocity nearest to (wx, wy) with a . v <= b for all rows (a_x, a_y, b), |a| = 1, in any order.

    If there is none, the velocity at which the largest violation a . v - b of rows that aren't hard is smallest, within
    the hard ones; or within the box alone, where the hard ones contradict each other.

    Args:
        rows: (R, 3), the first `BOX` of which are those of a box that isn't empty.
        hard: rows that have to be kept in any case: the box's, and maybe some that follow.
        used: rows in use.
        wx: the wish.
        wy: likewise.

    Returns:
        The velocity, and whether it keeps all rows.
    """
    x, y, failed = _nearest(rows, used, wx, wy)
    if failed == used:
        return x, y, True
    if failed < hard:
        hard = BOX
    between = np.empty((used, 3))
    between[:hard] = rows[:hard]
    worst = 0.0
    for m in range(failed, used):
        if rows[m, 0] * x + rows[m, 1] * y - rows[m, 2] <= worst + TOLERANCE:
            continue
        count = hard  # where row m is violated at least as much as each row before it
        for k in range(hard, m):
            ax, ay = rows[k, 0] - rows[m, 0], rows[k, 1] - rows[m, 1]
            length = math.sqrt(ax * ax + ay * ay)
            if length > TOLERANCE:
                between[count, 0], between[count, 1] = ax / length, ay / length
                between[count, 2] = (rows[k, 2] - rows[m, 2]) / length
                count += 1
        found_x, found_y, found = _furthest(between, count, -rows[m, 0], -rows[m, 1])
        if found:  # else by rounding only
            x, y = found_x, found_y
        worst = max(worst, rows[m, 0] * x + rows[m, 1] * y - rows[m, 2])
    return x, y, False


@compiled
def _nearest(rows: FloatArray, used: int, wx: float, wy: float) -> tuple[float, float, int]:
    """The point nearest to the wish within the rows before the one that leaves none, and that row; `used` if none."""
    x, y = wx, wy
    for m in range(used):
        ax, ay, b = rows[m, 0], rows[m, 1], rows[m, 2]
        if ax * x + ay * y <= b + TOLERANCE:
            continue
        low, high = _interval(rows, m)
        if low > high:
            return x, y, m
        along = min(max(ax * wy - ay * wx, low), high)
        x, y = ax * b - ay * along, ay * b + ax * along
    return x, y, used


@compiled
def _furthest(rows: FloatArray, used: int, dx: float, dy: float) -> tuple[float, float, bool]:
    """The point furthest in a direction within the rows, which begin with a box; whether there is one."""
    x = rows[0, 2] if dx > 0.0 else -rows[1, 2]
    y = rows[2, 2] if dy > 0.0 else -rows[3, 2]
    for m in range(BOX, used):
        ax, ay, b = rows[m, 0], rows[m, 1], rows[m, 2]
        if ax * x + ay * y <= b + TOLERANCE:
            continue
        low, high = _interval(rows, m)
        if low > high:
            return x, y, False
        along = high if ax * dy - ay * dx > 0.0 else low
        x, y = ax * b - ay * along, ay * b + ax * along
    return x, y, True


@compiled
def _interval(rows: FloatArray, m: int) -> tuple[float, float]:
    """What rows before it leave of row m's line, a b + s (-a_y, a_x): low <= s <= high, nothing if low > high."""
    ax, ay = rows[m, 0], rows[m, 1]
    px, py = ax * rows[m, 2], ay * rows[m, 2]
    low, high = -math.inf, math.inf
    for k in range(m):
        slope = rows[k, 1] * ax - rows[k, 0] * ay
        room = rows[k, 2] - rows[k, 0] * px - rows[k, 1] * py
        if slope > TOLERANCE:
            high = min(high, room / slope)
        elif slope < -TOLERANCE:
            low = max(low, room / slope)
        elif room < -TOLERANCE:
            return math.inf, -math.inf
    return low, high
