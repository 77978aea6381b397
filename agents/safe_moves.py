"""Compiled part of the safety filter: the move nearest to the wanted one that keeps a distance to boxes of others.

docs/theory_safety.md has the program and why its rows imply it. Lengths are in m, moves are of one control period.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from khop_env.compiled import compiled
from khop_env.env.layout import Float32Array
from khop_env.observers import FloatArray, IntArray

SECTOR = math.pi / 24.0  # largest angle between two rows of one box
MOST_ROWS = 25  # of one box, which is seen under less than half a turn from outside
TOLERANCE = 1e-12  # m: rows that are broken by less count as kept; `SafetyFilter` has a margin of a micrometre for it
EPSILON = 2.0**-23  # twice the relative rounding of a float32
ROUNDED = 1.0 + EPSILON


class Columns(NamedTuple):
    """Where the filter reads, per agent (N) and per pair (P) of an agent and one of its slots, pairs sorted by agent.

    Attributes:
        own: (N, 2) columns of the agent's position.
        own_limit: (N, 2) positions from here on may have been clipped.
        first: (N + 1,) the agent's first pair.
        position: (P, 2) columns of the relative position.
        position_limit: (P, 2) as `own_limit`.
        bound: (P, 2) columns of its bounds; -1 where it is exact or taken as such.
        bound_limit: (P, 2) as `own_limit`.
        valid: (P,) column of the flag that something is known; -1 where the bound says all.
        unknown_stops: whether an agent of which nothing is known stops this one, instead of being left out.
        widen: (P, 2) half widths that are added to each bound.
        distance: (P,) that the anchors have to keep.
        speed: (N, 2) input limits in m/s.
        tracking: (N, 2) largest observed distance from the anchor by the theory, per axis.
    """

    own: IntArray
    own_limit: FloatArray
    first: IntArray
    position: IntArray
    position_limit: FloatArray
    bound: IntArray
    bound_limit: FloatArray
    valid: IntArray
    unknown_stops: bool
    widen: FloatArray
    distance: FloatArray
    speed: FloatArray
    tracking: FloatArray


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
    low, high = 0.0, 0.0  # angles of the corners, from the direction of the nearest point
    for corner in range(4):
        cx = x + (hx if corner & 1 else -hx)
        cy = y + (hy if corner & 2 else -hy)
        angle = math.atan2(near_x * cy - near_y * cx, near_x * cx + near_y * cy)
        low, high = min(low, angle), max(high, angle)
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


@compiled
def filter_moves(
    columns: Any,
    observations: Float32Array,
    wanted: FloatArray,
    period: float,
    gamma: float,
    anchor: FloatArray,
    started: NDArray[np.bool_],
    chosen: FloatArray,
    infeasible: NDArray[np.bool_],
) -> None:
    """Choose every agent's input in every environment, and move its anchor.

    Args:
        columns: the fields of `Columns` as a plain tuple.
        observations: (B, D) of all agents, side by side.
        wanted: (B, N, 2) wanted inputs in m/s, within the limits.
        period: the control period in s.
        gamma: share of the gap that two agents together may use up in a period.
        anchor: (B, N, 2) moved; set where an agent has none.
        started: (B, N) whether an agent has an anchor.
        chosen: (B, N, 2) overwritten with the inputs; exactly `wanted` where nothing is near.
        infeasible: (B, N) overwritten: the agent isn't where its last move should have brought it, or may be outside of
            what observations show.
    """
    columns = Columns(*columns)
    agents = columns.own.shape[0]
    most = 0
    for i in range(agents):
        most = max(most, columns.first[i + 1] - columns.first[i])
    rows = np.empty((4 + most * MOST_ROWS + 2, 3))
    for b in range(observations.shape[0]):
        for i in range(agents):
            px, py = float(observations[b, columns.own[i, 0]]), float(observations[b, columns.own[i, 1]])
            infeasible[b, i] = False
            if not (abs(px) < columns.own_limit[i, 0] and abs(py) < columns.own_limit[i, 1]):
                infeasible[b, i], started[b, i] = True, False
                chosen[b, i, 0] = chosen[b, i, 1] = 0.0
                continue
            off_x, off_y = px - anchor[b, i, 0], py - anchor[b, i, 1]
            lost = not (abs(off_x) <= columns.tracking[i, 0] and abs(off_y) <= columns.tracking[i, 1])
            if lost or not started[b, i]:
                infeasible[b, i] = started[b, i]
                started[b, i] = True
                anchor[b, i, 0], anchor[b, i, 1] = px, py
                off_x = off_y = 0.0
            most_x, most_y = columns.speed[i, 0] * period, columns.speed[i, 1] * period
            wx, wy = wanted[b, i, 0] * period + off_x, wanted[b, i, 1] * period + off_y  # the anchor's wanted move
            reach = math.sqrt((most_x + abs(off_x)) ** 2 + (most_y + abs(off_y)) ** 2)
            used = 4  # the input's limits
            for row in range(4):
                rows[row, 0], rows[row, 1] = (0.0, 0.0)
                rows[row, row // 2] = 1.0 if row % 2 == 0 else -1.0
            rows[0, 2], rows[1, 2] = max(most_x + off_x, 0.0), max(most_x - off_x, 0.0)
            rows[2, 2], rows[3, 2] = max(most_y + off_y, 0.0), max(most_y - off_y, 0.0)
            for pair in range(columns.first[i], columns.first[i + 1]):
                known = columns.valid[pair] < 0 or observations[b, columns.valid[pair]] > 0.5
                if not known and not columns.unknown_stops:
                    continue
                x = float(observations[b, columns.position[pair, 0]])
                y = float(observations[b, columns.position[pair, 1]])
                hx = hy = 0.0
                if columns.bound[pair, 0] >= 0:
                    hx = float(observations[b, columns.bound[pair, 0]])
                    hy = float(observations[b, columns.bound[pair, 1]])
                    known = known and hx < columns.bound_limit[pair, 0] and hy < columns.bound_limit[pair, 1]
                known = known and abs(x) < columns.position_limit[pair, 0] and abs(y) < columns.position_limit[pair, 1]
                if not known:
                    used = -1
                    break
                half_x = hx * ROUNDED + abs(x) * EPSILON + columns.widen[pair, 0]
                half_y = hy * ROUNDED + abs(y) * EPSILON + columns.widen[pair, 1]
                used = box_rows(x + off_x, y + off_y, half_x, half_y, columns.distance[pair], gamma, reach, rows, used)
                if used < 0:
                    break
            broken = used < 0
            for m in range(4, used):
                broken = broken or rows[m, 0] * wx + rows[m, 1] * wy > rows[m, 2] + TOLERANCE
            if broken:
                zx = zy = 0.0
                if used > 0:
                    zx, zy = nearest_move(rows, used, wx, wy)
                chosen[b, i, 0], chosen[b, i, 1] = (zx - off_x) / period, (zy - off_y) / period
            else:
                zx, zy = wx, wy
                chosen[b, i, 0], chosen[b, i, 1] = wanted[b, i, 0], wanted[b, i, 1]
            anchor[b, i, 0] += zx
            anchor[b, i, 1] += zy
