"""Compiled loop of the safety filter for teams with agents that have to brake: carts, unicycles and ships.

docs/theory/safety.md, "Agents that have to brake", has the theorem. Lengths are in m.
"""

from __future__ import annotations

import math
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.safety.differences import others_box, rows_around
from agents.safety.moves import EPSILON
from agents.safety.rows import TOLERANCE, nearest_move
from agents.safety.stopping import (
    ERROR_GAIN,
    FORWARD,
    GAIN,
    KEEP,
    MOST_RAYS,
    PUSH,
    SPEED_GAIN,
    admitted,
    axis_ends,
    braking_input,
    stopping_distance,
)
from agents.safety.tables import (
    CART,
    DRAG,
    INTEGRATOR,
    LEFT_OUT,
    MUNK,
    SEEN_SPEED,
    SEEN_YAW_RATE,
    SHIP,
    SLOWING,
    TURNED,
    UNICYCLE,
    YAW_GAIN,
    YAW_KEEP,
    YAW_RATE,
    Team,
)
from khop_env.compiled import compiled
from khop_env.env.layout import Float32Array
from khop_env.observers import FloatArray, IntArray

GRID = 7  # candidates along each input
HALVINGS = 5  # of the way from the best of them to the wish


@compiled
def drive(
    team: Any,
    observations: Float32Array,
    wanted: FloatArray,
    drift: FloatArray,
    period: float,
    gamma: float,
    anchor: FloatArray,
    started: NDArray[np.bool_],
    memory: FloatArray,
    chosen: FloatArray,
    infeasible: NDArray[np.bool_],
    correction: FloatArray,
) -> None:
    """Choose every agent's input in every environment, and move its anchor.

    Args:
        team: the fields of `Team` as a plain tuple.
        observations: (B, D) of all agents, side by side.
        wanted: (B, N, 3) wanted inputs in the units of `Team.limit`, within the limits.
        drift: (B, N, 2) velocity of an integrator without an input, at its place, in m/s.
        period: the control period in s.
        gamma: share of the gap that two agents together may use up in a period.
        anchor: (B, N, 4) moved: place and velocity; set where an agent has none.
        started: (B, N) whether an agent has an anchor.
        memory: (B, P, 8) moved: lower and upper x and y, and their velocities, of others' anchors that have to brake;
            nan where nothing is known yet.
        chosen: (B, N, 3) overwritten with the inputs; exactly `wanted` where nothing is near.
        infeasible: (B, N) overwritten: the agent isn't where its last input should have brought it, or may be outside
            of what observations show, or a ship is outside of its operating region.
        correction: (B, N, 2) overwritten with chosen less wanted input along the axes of the world: of a velocity in
            m/s, of an acceleration in m/s^2.
    """
    team = Team(*team)
    agents, most = team.kind.size, 0
    for i in range(agents):
        most = max(most, team.first[i + 1] - team.first[i])
    rows = np.empty((4 + 2 * team.obstacle.shape[1] + most * MOST_RAYS + 1, 3))
    x, own, box, state = np.empty(7), np.empty(4), np.empty(4), np.empty((2, 7))
    boxes, known = np.empty((most, 4)), np.empty(most, np.int64)
    for b in range(observations.shape[0]):
        seen = observations[b]
        for i in range(agents):
            kind, inside = team.kind[i], True
            for c in range(7):
                x[c] = 0.0
                if team.own[i, c] >= 0:
                    x[c] = float(seen[team.own[i, c]])
                    inside = inside and abs(x[c]) < team.own_limit[i, c]
            velocity_x, velocity_y = x[2], x[3]
            if kind == SHIP:
                velocity_x, velocity_y = x[2] * x[4] - x[3] * x[5], x[3] * x[4] + x[2] * x[5]
                inside = inside and math.hypot(x[4], x[5]) <= team.ship[i, SEEN_SPEED]
                inside = inside and abs(x[6]) <= team.ship[i, SEEN_YAW_RATE]
            elif kind != CART:
                velocity_x = velocity_y = 0.0
            place = anchor[b, i]
            lost = not (abs(x[0] - place[0]) <= team.tracking[i, 0] and abs(x[1] - place[1]) <= team.tracking[i, 1])
            lost = lost or not abs(velocity_x - place[2]) <= team.tracking[i, 2]
            lost = lost or not abs(velocity_y - place[3]) <= team.tracking[i, 3]
            infeasible[b, i] = not inside or (started[b, i] and lost)
            if lost or not inside or not started[b, i]:
                memory[b, team.first[i] : team.first[i + 1]] = math.nan
            if lost or not inside or not started[b, i] or kind == UNICYCLE:
                place[0], place[1], place[2], place[3] = x[0], x[1], velocity_x, velocity_y
            started[b, i] = inside
            own[0], own[1] = x[0] - place[0], x[1] - place[1]
            own[2], own[3] = velocity_x - place[2], velocity_y - place[3]
            for pair in range(team.first[i], team.first[i + 1]):
                k, valid = pair - team.first[i], team.pair[pair, 14]
                valid_now = valid < 0 or seen[valid] > 0.5
                known[k] = LEFT_OUT
                if valid_now or team.unknown_stops:
                    known[k] = others_box(
                        team.pair,
                        team.pair_limit,
                        team.widen,
                        team.axes,
                        pair,
                        seen,
                        x,
                        state,
                        valid_now,
                        memory[b, pair],
                        boxes[k],
                    )
            want, u = wanted[b, i], chosen[b, i]
            if kind == UNICYCLE:
                _unicycle(team, i, seen, x, want, period, gamma, inside, rows, box, boxes, known, u)
            elif kind == INTEGRATOR:
                to = drift[b, i]
                _integrator(team, i, seen, own, place, want, to, period, gamma, inside, rows, box, boxes, known, u)
            else:
                _braking(team, i, seen, x, own, place, want, gamma, inside, rows, box, boxes, known, u)
            dx, dy = u[0] - want[0], u[1] - want[1]
            if kind == UNICYCLE:
                dx, dy = dx * x[2], dx * x[3]
            elif kind == SHIP:
                dx, dy = x[2] * dx - x[3] * dy, x[3] * dx + x[2] * dy
            correction[b, i, 0], correction[b, i, 1] = dx, dy


@compiled
def _unicycle(
    team: Team,
    i: int,
    seen: Float32Array,
    x: FloatArray,
    wanted: FloatArray,
    period: float,
    gamma: float,
    inside: bool,
    rows: FloatArray,
    box: FloatArray,
    boxes: FloatArray,
    known: IntArray,
    chosen: FloatArray,
) -> None:
    """The wanted turn rate, and the speed nearest to the wanted one: within a period a cone of directions is driven."""
    chosen[0], chosen[1], chosen[2] = wanted[0], wanted[1], 0.0
    box[:] = 0.0
    used = -1
    if inside:
        used = rows_around(team, i, seen, 0.0, 0.0, box, gamma, team.limit[i, 0] * period, rows, 0, boxes, known)
    length = math.hypot(x[2], x[3])
    if used < 0 or not length > 0.5:
        chosen[0] = 0.0
        return
    turn = 0.5 * wanted[1] * period
    half = abs(turn) + team.turning[i]
    cos, sin = math.cos(turn), math.sin(turn)
    ahead_x, ahead_y = (x[2] * cos - x[3] * sin) / length, (x[3] * cos + x[2] * sin) / length
    cos, sin = math.cos(half), math.sin(half)
    if half >= 0.5 * math.pi:
        cos, sin = -1.0, 0.0
    forward = backward = team.limit[i, 0] * period
    for m in range(used):
        along = rows[m, 0] * ahead_x + rows[m, 1] * ahead_y
        across = math.sqrt(max(1.0 - along * along, 0.0))
        most = 1.0 if along >= cos else along * cos + across * sin
        if most * forward > rows[m, 2]:
            forward = rows[m, 2] / most
        most = 1.0 if -along >= cos else -along * cos + across * sin
        if most * backward > rows[m, 2]:
            backward = rows[m, 2] / most
    way = wanted[0] * period
    if way > forward:
        chosen[0] = forward * (1.0 - EPSILON) / period
    elif way < -backward:
        chosen[0] = -backward * (1.0 - EPSILON) / period


@compiled
def _integrator(
    team: Team,
    i: int,
    seen: Float32Array,
    own: FloatArray,
    place: FloatArray,
    wanted: FloatArray,
    drift: FloatArray,
    period: float,
    gamma: float,
    inside: bool,
    rows: FloatArray,
    box: FloatArray,
    boxes: FloatArray,
    known: IntArray,
    chosen: FloatArray,
) -> None:
    """As `moves.filter_moves`, among agents that have to brake."""
    chosen[:] = 0.0
    if not inside:
        return
    box[:] = 0.0
    to_x, to_y = own[0] + drift[0] * period, own[1] + drift[1] * period
    most_x, most_y = team.limit[i, 0] * period, team.limit[i, 1] * period
    for row in range(4):
        rows[row, 0] = rows[row, 1] = 0.0
        rows[row, row // 2] = 1.0 if row % 2 == 0 else -1.0
    rows[0, 2], rows[1, 2] = max(most_x + to_x, 0.0), max(most_x - to_x, 0.0)
    rows[2, 2], rows[3, 2] = max(most_y + to_y, 0.0), max(most_y - to_y, 0.0)
    wx, wy = wanted[0] * period + to_x, wanted[1] * period + to_y
    reach = math.hypot(most_x + abs(to_x), most_y + abs(to_y))
    used = rows_around(team, i, seen, own[0], own[1], box, gamma, reach, rows, 4, boxes, known)
    broken = used < 0
    for m in range(4, used):
        broken = broken or rows[m, 0] * wx + rows[m, 1] * wy > rows[m, 2] + TOLERANCE
    chosen[0], chosen[1] = wanted[0], wanted[1]
    if broken:
        wx = wy = 0.0
        if used > 0:
            wx, wy = nearest_move(rows, used, wanted[0] * period + to_x, wanted[1] * period + to_y)
        chosen[0], chosen[1] = (wx - to_x) / period, (wy - to_y) / period
    place[0] += wx
    place[1] += wy


@compiled
def _braking(
    team: Team,
    i: int,
    seen: Float32Array,
    x: FloatArray,
    own: FloatArray,
    place: FloatArray,
    wanted: FloatArray,
    gamma: float,
    inside: bool,
    rows: FloatArray,
    box: FloatArray,
    boxes: FloatArray,
    known: IntArray,
    chosen: FloatArray,
) -> None:
    """A cart or a ship: accelerations of the anchor, along the axes of the world, are chosen among candidates."""
    axes, vx, vy, fastest = team.axes, place[2], place[3], team.fastest[i]
    back_x = axes[i, 0, ERROR_GAIN] * own[0] + axes[i, 0, SPEED_GAIN] * own[2]
    back_y = axes[i, 1, ERROR_GAIN] * own[1] + axes[i, 1, SPEED_GAIN] * own[3]
    # the anchor's acceleration is  frame . inputs + more
    cos, sin, more_x, more_y = 1.0, 0.0, -back_x, -back_y
    if team.kind[i] == SHIP:
        length = math.hypot(x[2], x[3])
        cos, sin = x[2] / length, x[3] / length
        ship = team.ship[i]
        surge = -(ship[SLOWING] + ship[DRAG] * abs(x[4])) * x[4] + ship[TURNED] * x[5] * x[6]
        sway = -(ship[SLOWING + 1] + ship[DRAG + 1] * abs(x[5])) * x[5] + ship[TURNED + 1] * x[4] * x[6]
        more_x += cos * surge - sin * sway
        more_y += sin * surge + cos * sway
    brake_x, brake_y = braking_input(axes, i, 0, vx), braking_input(axes, i, 1, vy)
    wish_x, wish_y = cos * wanted[0] - sin * wanted[1] + more_x, sin * wanted[0] + cos * wanted[1] + more_y
    chosen[0], chosen[1], chosen[2] = wanted[0], wanted[1], wanted[2]
    if team.kind[i] == SHIP:
        free = team.ship[i, YAW_KEEP] * x[6] + team.ship[i, YAW_GAIN] * team.ship[i, MUNK] * x[4] * x[5]
        lowest = (-team.ship[i, YAW_RATE] - free) / team.ship[i, YAW_GAIN]
        highest = (team.ship[i, YAW_RATE] - free) / team.ship[i, YAW_GAIN]
        chosen[2] = min(max(min(max(wanted[2], lowest), highest), -team.limit[i, 2]), team.limit[i, 2])
    best_x, best_y, changed, used = brake_x, brake_y, True, -1
    if inside:
        box[0] = -stopping_distance(axes, i, 0, -vx)
        box[1] = stopping_distance(axes, i, 0, vx)
        box[2] = -stopping_distance(axes, i, 1, -vy)
        box[3] = stopping_distance(axes, i, 1, vy)
        span_x = abs(cos) * team.limit[i, 0] + abs(sin) * team.limit[i, 1]
        span_y = abs(sin) * team.limit[i, 0] + abs(cos) * team.limit[i, 1]
        side_x = max(
            axis_ends(axes, i, 0, vx, more_x + span_x)[1] - box[1],
            box[0] - axis_ends(axes, i, 0, vx, more_x - span_x)[0],
        )
        side_y = max(
            axis_ends(axes, i, 1, vy, more_y + span_y)[1] - box[3],
            box[2] - axis_ends(axes, i, 1, vy, more_y - span_y)[0],
        )
        reach = math.hypot(max(side_x, 0.0), max(side_y, 0.0))
        used = rows_around(team, i, seen, own[0], own[1], box, gamma, reach, rows, 0, boxes, known)
    if used >= 0:
        if admitted(axes, i, vx, vy, wish_x, wish_y, box, fastest, rows, used):
            best_x, best_y, changed = wish_x, wish_y, False
        else:
            nearest = (best_x - wish_x) ** 2 + (best_y - wish_y) ** 2
            for q in range(GRID * GRID + 2):
                if q < GRID * GRID:
                    one = (2.0 * (q // GRID) / (GRID - 1) - 1.0) * team.limit[i, 0]
                    two = (2.0 * (q % GRID) / (GRID - 1) - 1.0) * team.limit[i, 1]
                    ux, uy = cos * one - sin * two + more_x, sin * one + cos * two + more_y
                elif team.kind[i] == CART:  # one axis as wanted, the other brakes
                    ux, uy = (wish_x, brake_y) if q == GRID * GRID else (brake_x, wish_y)
                else:
                    break
                far = (ux - wish_x) ** 2 + (uy - wish_y) ** 2
                if far < nearest and admitted(axes, i, vx, vy, ux, uy, box, fastest, rows, used):
                    nearest, best_x, best_y = far, ux, uy
            low, high = 0.0, 1.0
            for _ in range(HALVINGS):
                share = 0.5 * (low + high)
                ux, uy = best_x + share * (wish_x - best_x), best_y + share * (wish_y - best_y)
                if admitted(axes, i, vx, vy, ux, uy, box, fastest, rows, used):
                    low = share
                else:
                    high = share
            best_x, best_y = best_x + low * (wish_x - best_x), best_y + low * (wish_y - best_y)
    if changed:
        chosen[0] = cos * (best_x - more_x) + sin * (best_y - more_y)
        chosen[1] = cos * (best_y - more_y) - sin * (best_x - more_x)
    place[0] += axes[i, 0, FORWARD] * vx + axes[i, 0, PUSH] * best_x
    place[1] += axes[i, 1, FORWARD] * vy + axes[i, 1, PUSH] * best_y
    place[2] = axes[i, 0, KEEP] * vx + axes[i, 0, GAIN] * best_x
    place[3] = axes[i, 1, KEEP] * vy + axes[i, 1, GAIN] * best_y
