"""Compiled program of the safety filter: rows that keep a move away from boxes and obstacles, and the nearest move.

docs/theory/safety.md has the program and why its rows imply it. Lengths are in m, moves are of one control period.
"""

from __future__ import annotations

import math

from khop_env.compiled import compiled
from khop_env.observers import FloatArray

SECTOR = math.pi / 24.0  # largest angle between two rows of one box
MOST_ROWS = 25  # of one box, which is seen under less than half a turn from outside
TOLERANCE = 1e-12  # m: rows that are broken by less count as kept


@compiled
def box_rows(
    x: float, y: float, hx: float, hy: float, distance: float, gamma: float, reach: float, rows: FloatArray, used: int
) -> int:
    """Rows (a_x, a_y, b), each a . z <= b >= 0, that keep a move z away from every point of a box.

    They imply e . z <= gamma max(|y| - distance, 0) / 2 for every point y = |y| e of the box, and are written only
    where a move of length `reach` could break them.

    Args:
        x: the box's centre, from the anchor that moves.
        y: likewise.
        hx: its half widths.
        hy: likewise.
        distance: to be kept.
        gamma: share of the gap that both agents together may use up.
        reach: length of the longest move.
        rows: (R, 3) written from row `used` on.
        used: rows that are in use.

    Returns:
        Rows that are in use then; -1 if the anchor is inside the box, which leaves only z = 0.
    """
    near_x = min(max(0.0, x - hx), x + hx)  # the box's point nearest to the anchor
    near_y = min(max(0.0, y - hy), y + hy)
    nearest = math.sqrt(near_x * near_x + near_y * near_y)
    if 0.5 * gamma * (nearest - distance) >= reach:
        return used
    if nearest == 0.0:
        return -1
    low, high = corner_angles(x, y, hx, hy, near_x, near_y)
    sectors = max(1, math.ceil((high - low) / SECTOR))
    step = (high - low) / sectors
    shrink = 0.5 * gamma * math.cos(0.5 * step)
    middle = min(max(math.floor(-low / step), 0), sectors - 1) if step > 0.0 else 0  # holds the nearest point
    cos, sin = math.cos(low), math.sin(low)
    ax, ay = (near_x * cos - near_y * sin) / nearest, (near_y * cos + near_x * sin) / nearest
    cos, sin = math.cos(step), math.sin(step)
    before = math.inf  # the largest move towards the sector before this ray
    previous = nearest  # distance along the ray before
    for k in range(sectors + 1):
        along = ray_distance(x, y, hx, hy, ax, ay, nearest)
        if k > 0:  # sector k - 1, between the ray before and this one; its inner ray is nearer to `middle`
            inner = nearest if k - 1 == middle else (along if k - 1 < middle else previous)
            after = shrink * max(inner - distance, 0.0)
            # the ray before has both its sectors now
            bound = min(before, after)
            if bound < reach:
                rows[used, 2] = bound
                used += 1
            before = after
        rows[used, 0], rows[used, 1] = ax, ay
        previous = along
        ax, ay = ax * cos - ay * sin, ay * cos + ax * sin
    if before < reach and step > 0.0:
        rows[used, 2] = before
        used += 1
    return used


@compiled
def corner_angles(x: float, y: float, hx: float, hy: float, near_x: float, near_y: float) -> tuple[float, float]:
    """Smallest and largest angle of a box's corners, seen from the origin, from the direction of a point of it."""
    low, high = 0.0, 0.0
    for corner in range(4):
        cx = x + (hx if corner & 1 else -hx)
        cy = y + (hy if corner & 2 else -hy)
        angle = math.atan2(near_x * cy - near_y * cx, near_x * cx + near_y * cy)
        low, high = min(low, angle), max(high, angle)
    return low, high


@compiled
def obstacle_rows(
    x: float, y: float, ahead: float, distance: float, turn: float, reach: float, rows: FloatArray, used: int
) -> int:
    """Rows that keep a move away from a convex obstacle, of which the point nearest to the agent is known.

    Args:
        x: direction to that point.
        y: likewise; together a unit vector.
        ahead: distance from the anchor to the line through that point across the direction.
        distance: to be kept from the obstacle.
        turn: largest angle by which the direction from the anchor can differ.
        reach: as for `box_rows`.
        rows: as for `box_rows`.
        used: as for `box_rows`.

    Returns:
        Rows that are in use then.
    """
    cos, sin = math.cos(turn), math.sin(turn)
    bound = max(ahead - distance, 0.0) * cos
    if bound >= reach:
        return used
    for side in range(2):
        turned = sin if side == 0 else -sin
        rows[used, 0], rows[used, 1], rows[used, 2] = x * cos - y * turned, y * cos + x * turned, bound
        used += 1
    return used


@compiled
def ray_distance(x: float, y: float, hx: float, hy: float, ax: float, ay: float, otherwise: float) -> float:
    """Distance to a box along a ray from the origin; `otherwise` where rounding lets the ray pass it."""
    enter, leave = 0.0, math.inf
    for axis in range(2):
        a, middle, half = (ax, x, hx) if axis == 0 else (ay, y, hy)
        if a == 0.0:
            if abs(middle) > half:
                return otherwise
            continue
        one, two = (middle - half) / a, (middle + half) / a
        enter, leave = max(enter, min(one, two)), min(leave, max(one, two))
    return max(enter, otherwise) if enter <= leave else otherwise


@compiled
def nearest_move(rows: FloatArray, used: int, wx: float, wy: float) -> tuple[float, float]:
    """The point nearest to (wx, wy) with a . z <= b for rows (a_x, a_y, b), b >= 0 and |a| = 1, in any order.

    Incremental projection in two dimensions: if a row is broken, the new optimum lies on its line. What rounding leaves
    is removed by scaling towards z = 0, which all rows admit.
    """
    zx, zy = wx, wy
    for m in range(used):
        ax, ay, b = rows[m, 0], rows[m, 1], rows[m, 2]
        if ax * zx + ay * zy <= b + TOLERANCE:
            continue
        low, high = -math.inf, math.inf
        px, py = ax * b, ay * b
        for k in range(m):
            slope = rows[k, 1] * ax - rows[k, 0] * ay
            room = rows[k, 2] - rows[k, 0] * px - rows[k, 1] * py
            if slope > 1e-14:
                high = min(high, room / slope)
            elif slope < -1e-14:
                low = max(low, room / slope)
        along = ax * wy - ay * wx
        along = min(max(along, low), high) if low <= high else 0.5 * (low + high)
        zx, zy = px - ay * along, py + ax * along
    scale = 1.0
    for m in range(used):
        ahead = rows[m, 0] * zx + rows[m, 1] * zy
        if ahead > rows[m, 2] + TOLERANCE:
            scale = min(scale, rows[m, 2] / ahead)
    return scale * zx, scale * zy
