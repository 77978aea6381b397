"""Compiled loop of the safety filter over environments, agents and slots.

docs/theory/safety.md has the program. Lengths are in m, moves are of one control period.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.safety.rows import MOST_ROWS, TOLERANCE, box_rows, nearest_move, obstacle_rows
from khop_env.compiled import compiled
from khop_env.env.layout import Float32Array
from khop_env.observers import FloatArray, IntArray

REST = 0.1  # of the pace: what an agent at rest announces as its pace for the next `REST_TIME`
REST_TIME = 2.0  # s
SLACK = 1e-6  # m: added to distances for that, and for rounding, of more periods than an episode has
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
        radius: (N,) column of the radius of the agents' bodies; -1 where it is `body`.
        body: radius in m.
        apart: (P,) distance that the anchors have to keep, less two radii.
        obstacle: (N, M, 2) columns of the vectors to the nearest points of static convex obstacles.
        obstacle_limit: (N, M, 2) as `own_limit`.
        rounding: (N, 2) of observed positions.
        off: (N,) largest distance from the anchor by the theory.
        speed: (N, 2) input limits in m/s.
        tracking: (N, 2) largest observed distance from the anchor by the theory, per axis.
        announced: (P, 4) columns of the other's anchor, as a share of `scale`, of a flag, and whether it is at rest;
            (0, 4) where nothing is announced.
        age: (P,) columns of the age of what was announced, in s.
        age_limit: (P,) ages from here on may have been clipped.
        scale: (2,) in m.
        pace: (N, 2) fastest that anchors move, in m/s; inf where they aren't announced.
        pace_of_other: (P, 2) likewise, of the pair's other.
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
    radius: IntArray
    body: float
    apart: FloatArray
    obstacle: IntArray
    obstacle_limit: FloatArray
    rounding: FloatArray
    off: FloatArray
    speed: FloatArray
    tracking: FloatArray
    announced: IntArray
    age: IntArray
    age_limit: FloatArray
    scale: FloatArray
    pace: FloatArray
    pace_of_other: FloatArray


@compiled
def filter_moves(
    columns: Any,
    observations: Float32Array,
    wanted: FloatArray,
    drift: FloatArray,
    period: float,
    gamma: float,
    anchor: FloatArray,
    started: NDArray[np.bool_],
    resting: IntArray,
    chosen: FloatArray,
    infeasible: NDArray[np.bool_],
) -> None:
    """Choose every agent's input in every environment, and move its anchor.

    Args:
        columns: the fields of `Columns` as a plain tuple.
        observations: (B, D) of all agents, side by side.
        wanted: (B, N, 2) wanted inputs in m/s, within the limits.
        drift: (B, N, 2) velocity of an agent without an input, at its place, in m/s.
        period: the control period in s.
        gamma: share of the gap that two agents together may use up in a period.
        anchor: (B, N, 2) moved; set where an agent has none.
        started: (B, N) whether an agent has an anchor.
        resting: (B, N) control periods for which an agent has still to keep the pace that it announced; changed.
        chosen: (B, N, 2) overwritten with the inputs; exactly `wanted` where nothing is near.
        infeasible: (B, N) overwritten: the agent isn't where its last move should have brought it, or may be outside of
            what observations show.
    """
    columns = Columns(*columns)
    agents = columns.own.shape[0]
    most_resting = 0  # from the next control period on
    if columns.announced.shape[0]:
        most_resting = periods_of_rest(period)
    most = 0
    for i in range(agents):
        most = max(most, columns.first[i + 1] - columns.first[i])
    obstacles = columns.obstacle.shape[1]
    rows = np.empty((4 + 2 * obstacles + most * MOST_ROWS + 1, 3))
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
            to_x, to_y = off_x + drift[b, i, 0] * period, off_y + drift[b, i, 1] * period  # the anchor's without input
            wx, wy = wanted[b, i, 0] * period + to_x, wanted[b, i, 1] * period + to_y
            reach = math.sqrt((most_x + abs(to_x)) ** 2 + (most_y + abs(to_y)) ** 2)
            used = 4  # the input's limits
            for row in range(4):
                rows[row, 0], rows[row, 1] = (0.0, 0.0)
                rows[row, row // 2] = 1.0 if row % 2 == 0 else -1.0
            pace_x, pace_y = columns.pace[i, 0] * period, columns.pace[i, 1] * period
            at_rest = abs(wx) <= REST * pace_x and abs(wy) <= REST * pace_y
            if resting[b, i] > 0:
                pace_x, pace_y = REST * pace_x, REST * pace_y
                resting[b, i] -= 1
            if at_rest:
                resting[b, i] = most_resting
            rows[0, 2], rows[1, 2] = min(max(most_x + to_x, 0.0), pace_x), min(max(most_x - to_x, 0.0), pace_x)
            rows[2, 2], rows[3, 2] = min(max(most_y + to_y, 0.0), pace_y), min(max(most_y - to_y, 0.0), pace_y)
            radius = columns.body
            if columns.radius[i] >= 0:
                radius = ROUNDED * float(observations[b, columns.radius[i]])
            turn = 2.0 * math.asin(min(1.0, 0.5 * columns.off[i] / radius))
            for q in range(obstacles):
                x = float(observations[b, columns.obstacle[i, q, 0]])
                y = float(observations[b, columns.obstacle[i, q, 1]])
                near = math.sqrt(x * x + y * y)
                if near == 0.0 or turn >= 0.5 * math.pi:
                    used = -1
                    break
                keep = radius + columns.off[i] + SLACK
                sure = near * (1.0 - EPSILON) - columns.rounding[i, 0] - columns.rounding[i, 1]
                limit = columns.obstacle_limit[i, q]
                if abs(x) >= limit[0] or abs(y) >= limit[1]:  # clipped: at least as far away, in any direction
                    if sure - math.hypot(off_x, off_y) - keep < reach:
                        used = -1
                        break
                    continue
                x, y = x / near, y / near
                used = obstacle_rows(x, y, sure + x * off_x + y * off_y, keep, turn, reach, rows, used)
            for pair in range(columns.first[i], columns.first[i + 1]):
                if used < 0:
                    break
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
                if columns.announced.shape[0] and observations[b, columns.announced[pair, 2]] > 0.5:
                    age = float(observations[b, columns.age[pair]])
                    if age < columns.age_limit[pair]:
                        way = age * ROUNDED  # at full pace
                        if observations[b, columns.announced[pair, 3]] > 0.5:
                            way = max(way - (1.0 - REST) * REST_TIME, REST * way)
                        x, half_x = _meet(
                            x,
                            half_x,
                            columns.scale[0] * float(observations[b, columns.announced[pair, 0]]) - px,
                            columns.pace_of_other[pair, 0] * way + EPSILON * columns.scale[0],
                        )
                        y, half_y = _meet(
                            y,
                            half_y,
                            columns.scale[1] * float(observations[b, columns.announced[pair, 1]]) - py,
                            columns.pace_of_other[pair, 1] * way + EPSILON * columns.scale[1],
                        )
                distance = 2.0 * radius + columns.apart[pair] + SLACK
                used = box_rows(x + off_x, y + off_y, half_x, half_y, distance, gamma, reach, rows, used)
            broken = used < 0
            for m in range(used):
                broken = broken or rows[m, 0] * wx + rows[m, 1] * wy > rows[m, 2] + TOLERANCE
            if broken:
                zx = zy = 0.0
                if used > 0:
                    zx, zy = nearest_move(rows, used, wx, wy)
                chosen[b, i, 0], chosen[b, i, 1] = (zx - to_x) / period, (zy - to_y) / period
            else:
                zx, zy = wx, wy
                chosen[b, i, 0], chosen[b, i, 1] = wanted[b, i, 0], wanted[b, i, 1]
            anchor[b, i, 0] += zx
            anchor[b, i, 1] += zy


@compiled
def periods_of_rest(period: float) -> int:
    """Control periods, after the present one, in which an agent keeps the pace that it announces now."""
    return math.ceil(REST_TIME / period - 1e-9)


@compiled
def _meet(x: float, half: float, other: float, other_half: float) -> tuple[float, float]:
    """Centre and half width of what two intervals have in common; the first if they are disjoint."""
    low, high = max(x - half, other - other_half), min(x + half, other + other_half)
    if low > high:
        return x, half
    return 0.5 * (low + high), 0.5 * (high - low) * ROUNDED
