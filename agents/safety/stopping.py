"""Compiled geometry of stopping boxes: where an agent comes to rest, and rows that keep such boxes apart.

docs/theory/safety.md, "Agents that have to brake", has the theorem. Boxes are relative to the agent's anchor, in m.
"""

from __future__ import annotations

import math

import numpy as np

from agents.safety.rows import TOLERANCE, corner_angles, ray_distance
from khop_env.compiled import compiled
from khop_env.observers import FloatArray

RAYS = 48  # directions of rows, the axes among them
STEP = 2.0 * math.pi / RAYS
MOST_RAYS = RAYS // 2 + 4  # of one box, which is seen under less than half a turn from outside
SHRINK = math.cos(0.5 * STEP)
NUMBERS = 10
KEEP, FORWARD, PUSH, GAIN, ERROR_GAIN, SPEED_GAIN, STRENGTH, TURNING, LAST, CELLS = range(NUMBERS)  # of an axis

_QUARTER = np.cos(STEP * np.arange(RAYS // 4 + 1))
_QUARTER[-1] = 0.0
COS = np.concatenate([_QUARTER[:-1], -_QUARTER[:0:-1], -_QUARTER[:-1], _QUARTER[:0:-1]])
SIN = np.roll(COS, RAYS // 4)


@compiled
def stopping_distance(axes: FloatArray, i: int, c: int, speed: float) -> float:
    """How far an anchor still goes along an axis when it brakes; 0 for a speed that isn't positive.

    Args:
        axes: (N, 2, L) of agents' axes the NUMBERS, then knots, distances and cells of their `Brake`; LAST is the last
            knot's number, CELLS where cells begin.
        i: agent.
        c: axis.
        speed: in m/s.
    """
    far, last = 0.0, int(axes[i, c, LAST])
    if not speed > 0.0:
        return far
    while speed > axes[i, c, NUMBERS + last]:
        far += axes[i, c, FORWARD] * speed - axes[i, c, PUSH] * axes[i, c, STRENGTH]
        speed = axes[i, c, KEEP] * speed - axes[i, c, GAIN] * axes[i, c, STRENGTH]
    knot = NUMBERS + int(axes[i, c, int(axes[i, c, CELLS]) + int(speed / axes[i, c, NUMBERS + 1])])
    while knot < NUMBERS + last - 1 and axes[i, c, knot + 1] < speed:
        knot += 1
    below, above = axes[i, c, knot + last + 1], axes[i, c, knot + last + 2]
    share = (speed - axes[i, c, knot]) / (axes[i, c, knot + 1] - axes[i, c, knot])
    return far + below + share * (above - below)


@compiled
def braking_input(axes: FloatArray, i: int, c: int, speed: float) -> float:
    """The input that stops an axis at the end of the period, or as soon as it can."""
    wanted = -axes[i, c, KEEP] * speed / axes[i, c, GAIN]
    return min(max(wanted, -axes[i, c, STRENGTH]), axes[i, c, STRENGTH])


@compiled
def axis_ends(axes: FloatArray, i: int, c: int, speed: float, u: float) -> tuple[float, float]:
    """The lower and upper end along an axis of all that an anchor covers: in a period of input u, and braking then."""
    moved = axes[i, c, FORWARD] * speed + axes[i, c, PUSH] * u
    after = axes[i, c, KEEP] * speed + axes[i, c, GAIN] * u
    low, high = min(moved, 0.0), max(moved, 0.0)
    if after > 0.0:
        high = max(high, moved + stopping_distance(axes, i, c, after))
        low = min(low, max(axes[i, c, TURNING] * speed, moved - axes[i, c, TURNING] * after))  # if it turned round
    elif after < 0.0:
        low = min(low, moved - stopping_distance(axes, i, c, -after))
        high = max(high, min(axes[i, c, TURNING] * speed, moved - axes[i, c, TURNING] * after))
    return low, high


@compiled
def separating_rows(
    x: float, y: float, hx: float, hy: float, distance: float, gamma: float, reach: float, rows: FloatArray, used: int
) -> int:
    """Rows (e_x, e_y, b), b >= 0, for the box of all differences of two stopping boxes that are possible.

    Suppose that an agent's covered box S' has sigma_S'(e) - sigma_S(e) <= b in the rows' directions, sigma being
    support functions and S its stopping box. Then it is at most gamma max(|y| - distance, 0) / 2 for every point y =
    |y| e of the box. The axes are among the directions, between which sigma_S is linear.

    Args:
        x: the box's centre.
        y: likewise.
        hx: its half widths.
        hy: likewise.
        distance: to be kept.
        gamma: share of the gap that both agents together may use up.
        reach: largest difference of support that any input has.
        rows: (R, 3) written from row `used` on.
        used: rows that are in use.

    Returns:
        Rows that are in use then; -1 if the origin is in the box, which leaves only braking.
    """
    near_x = min(max(0.0, x - hx), x + hx)
    near_y = min(max(0.0, y - hy), y + hy)
    nearest = math.sqrt(near_x * near_x + near_y * near_y)
    if 0.5 * gamma * (nearest - distance) >= reach:
        return used
    if not nearest > 0.0:
        return -1
    low, high = corner_angles(x, y, hx, hy, near_x, near_y)
    middle = math.atan2(near_y, near_x) / STEP
    begin, end = math.floor(middle + low / STEP - 1e-9), math.ceil(middle + high / STEP + 1e-9)
    sector = min(max(math.floor(middle), begin), end - 1)  # holds the nearest point, between its rays and the next
    on_ray = abs(middle - round(middle)) < 1e-9  # then a ray is towards it, up to rounding, and both its sectors do
    before, share = math.inf, 0.5 * gamma * SHRINK
    for k in range(begin, end + 1):
        after = math.inf
        if k < end:  # the sector from this ray on, of which the ray nearer to the nearest point counts
            inner = nearest
            if not (k == sector or (on_ray and abs(k + 0.5 - middle) < 1.0)):
                ray = (k + 1 if k < sector else k) % RAYS
                inner = ray_distance(x, y, hx, hy, COS[ray], SIN[ray], nearest)
            after = share * max(inner - distance, 0.0)
        bound = min(before, after)
        if bound < reach:
            rows[used, 0], rows[used, 1], rows[used, 2] = COS[k % RAYS], SIN[k % RAYS], bound
            used += 1
        before = after
    return used


@compiled
def admitted(
    axes: FloatArray,
    i: int,
    vx: float,
    vy: float,
    ux: float,
    uy: float,
    box: FloatArray,
    fastest: float,
    rows: FloatArray,
    used: int,
) -> bool:
    """Whether all rows admit accelerations (ux, uy) of an anchor that moves at (vx, vy).

    Args:
        axes: see `stopping_distance`.
        i: agent.
        vx: m/s.
        vy: m/s.
        ux: m/s^2.
        uy: m/s^2.
        box: (4,) the stopping box: lower and upper x, lower and upper y.
        fastest: largest speed after the period.
        rows: as `separating_rows` writes them.
        used: rows that are in use.
    """
    after_x = axes[i, 0, KEEP] * vx + axes[i, 0, GAIN] * ux
    after_y = axes[i, 1, KEEP] * vy + axes[i, 1, GAIN] * uy
    if after_x * after_x + after_y * after_y > fastest * fastest:
        return False
    if used == 0:
        return True
    low_x, high_x = axis_ends(axes, i, 0, vx, ux)
    low_y, high_y = axis_ends(axes, i, 1, vy, uy)
    low_x, high_x, low_y, high_y = box[0] - low_x, high_x - box[1], box[2] - low_y, high_y - box[3]
    for m in range(used):
        ex, ey = rows[m, 0], rows[m, 1]
        more = ex * high_x if ex > 0.0 else -ex * low_x
        more += ey * high_y if ey > 0.0 else -ey * low_y
        if more > rows[m, 2] + TOLERANCE:
            return False
    return True
