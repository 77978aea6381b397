"""Compiled: boxes of all differences of two agents' stopping boxes that are possible, and the rows they give.

docs/theory/safety.md, "Agents that have to brake", has the theorem. Lengths are in m.
"""

from __future__ import annotations

import math

from agents.safety.moves import EPSILON, ROUNDED, SLACK
from agents.safety.rows import obstacle_rows
from agents.safety.stopping import FORWARD, GAIN, KEEP, PUSH, separating_rows, stopping_distance
from agents.safety.tables import CART, INTEGRATOR, LEFT_OUT, SHIP, UNICYCLE, Team
from khop_env.compiled import inlined
from khop_env.env.layout import Float32Array
from khop_env.observers import FloatArray, IntArray


@inlined
def rows_around(
    team: Team,
    i: int,
    seen: Float32Array,
    off_x: float,
    off_y: float,
    box: FloatArray,
    gamma: float,
    reach: float,
    rows: FloatArray,
    used: int,
    boxes: FloatArray,
    known: IntArray,
) -> int:
    """Rows against all obstacles and others, from row `used` on; -1 if they leave only braking.

    Args:
        team: the tables.
        i: agent.
        seen: (D,) observations.
        off_x: from the anchor to where the agent is observed.
        off_y: likewise.
        box: (4,) the stopping box: lower and upper x, lower and upper y, from the anchor.
        gamma: share of the gap.
        reach: largest difference of support that any input has.
        rows: (R, 3) written.
        used: rows that are in use.
        boxes: (M, 4) of the others: lower and upper x, lower and upper y, from where this agent is observed.
        known: (M,) whether they are known, or `LEFT_OUT`.
    """
    radius = team.body
    if team.radius[i] >= 0:
        radius = ROUNDED * float(seen[team.radius[i]])
    keep = radius + team.off[i] + SLACK
    for q in range(team.obstacle.shape[1]):
        x, y = float(seen[team.obstacle[i, q, 0]]), float(seen[team.obstacle[i, q, 1]])
        near = math.sqrt(x * x + y * y)
        if not near > 0.0:
            return -1
        sure, limit = near * (1.0 - EPSILON) - team.rounding[i, 0] - team.rounding[i, 1], team.obstacle_limit[i, q]
        if abs(x) >= limit[0] or abs(y) >= limit[1]:  # clipped: at least as far away, in any direction
            farthest = math.hypot(max(-box[0], box[1]), max(-box[2], box[3])) + math.hypot(off_x, off_y)
            if sure - farthest - keep < reach:
                return -1
            continue
        x, y = x / near, y / near
        ahead = sure + x * off_x + y * off_y
        room = ahead - keep - (max(x * box[0], x * box[1]) + max(y * box[2], y * box[3]))
        if room >= reach:
            continue
        if room >= 0.0:
            rows[used, 0], rows[used, 1], rows[used, 2] = x, y, room
            used += 1
        elif box[0] == box[1] and box[2] == box[3]:
            turn = 2.0 * math.asin(min(1.0, 0.5 * team.off[i] / radius)) + 1e-6
            used = obstacle_rows(x, y, ahead, keep, turn, math.inf, rows, used)
        else:
            return -1
    for pair in range(team.first[i], team.first[i + 1]):
        k = pair - team.first[i]
        if known[k] == LEFT_OUT:
            continue
        if not known[k]:
            return -1
        low_x, high_x = boxes[k, 0] + off_x - box[1], boxes[k, 1] + off_x - box[0]
        low_y, high_y = boxes[k, 2] + off_y - box[3], boxes[k, 3] + off_y - box[2]
        keep = 2.0 * radius + team.apart[pair] + SLACK
        x, y = 0.5 * (low_x + high_x), 0.5 * (low_y + high_y)
        hx, hy = 0.5 * ROUNDED * (high_x - low_x), 0.5 * ROUNDED * (high_y - low_y)
        used = separating_rows(x, y, hx, hy, keep, gamma, reach, rows, used)
        if used < 0:
            return -1
    return used


@inlined
def others_box(
    columns: IntArray,
    limits: FloatArray,
    widen: FloatArray,
    axes: FloatArray,
    pair: int,
    seen: Float32Array,
    x: FloatArray,
    state: FloatArray,
    known: bool,
    memory: FloatArray,
    box: FloatArray,
) -> bool:
    """Write the box that holds another's stopping box for certain, from where this agent is observed.

    Args:
        columns: `Team.pair`.
        limits: `Team.pair_limit`.
        widen: `Team.widen`.
        axes: `Team.axes`.
        pair: this agent and the other.
        seen: (D,) observations.
        x: (7,) this agent's state.
        state: (2, 7) overwritten: what counts of the other's state, and its bounds.
        known: whether this agent knows anything of the other.
        memory: (8,) that; used while what is observed is old, since all is new when an episode begins.
        box: (4,) written: lower and upper x, lower and upper y.

    Returns:
        Whether all of it is known.
    """
    s, h = state[0], state[1]
    j, kind = columns[pair, 15], columns[pair, 16]
    for c in range(2 if kind in (INTEGRATOR, UNICYCLE) else (4 if kind == CART else 6)):
        s[c] = h[c] = 0.0
        if columns[pair, c] >= 0:
            s[c] = float(seen[columns[pair, c]])
            known = known and abs(s[c]) < limits[pair, c]
        if columns[pair, 7 + c] >= 0:
            h[c] = ROUNDED * float(seen[columns[pair, 7 + c]])
            known = known and (h[c] < limits[pair, 7 + c] or (kind == SHIP and c >= 2))  # whose speed is bounded anyway
    h[0] += abs(s[0]) * EPSILON + widen[pair, 0]
    h[1] += abs(s[1]) * EPSILON + widen[pair, 1]
    box[0], box[1], box[2], box[3] = s[0] - h[0], s[0] + h[0], s[1] - h[1], s[1] + h[1]
    if kind in (INTEGRATOR, UNICYCLE):
        return known
    if kind == SHIP:
        length = math.hypot(s[2], s[3])
        cos, sin = (s[2] / length, s[3] / length) if length > 0.0 else (1.0, 0.0)
        turned = min(h[2] + 1e-6, 2.0) * math.hypot(abs(s[4]) + h[4], abs(s[5]) + h[5])
        h[2], h[3] = abs(cos) * h[4] + abs(sin) * h[5] + turned, abs(sin) * h[4] + abs(cos) * h[5] + turned
        s[2], s[3] = cos * s[4] - sin * s[5], sin * s[4] + cos * s[5]
    if columns[pair, 17] < 0 or not seen[columns[pair, 17]] > 0.0:
        memory[:] = math.nan
    most, kept = widen[pair, 4], known and memory[0] == memory[0]
    for c in range(2):
        half = h[2 + c] + abs(s[2 + c]) * EPSILON + widen[pair, 2 + c]
        low_v, high_v = max(s[2 + c] - half, -most), min(s[2 + c] + half, most)
        low, high = x[c] + box[2 * c], x[c] + box[2 * c + 1]
        s[2 + c], h[2 + c], box[2 * c], box[2 * c + 1] = low_v, high_v, low, high
        before, speeds = memory[2 * c : 2 * c + 2], memory[4 + 2 * c : 6 + 2 * c]
        if before[0] == before[0]:  # where the anchor can have come since
            push, gain = axes[j, c, PUSH] * widen[pair, 5], axes[j, c, GAIN] * widen[pair, 5]
            before[0] += axes[j, c, FORWARD] * speeds[0] - push - 1e-9
            before[1] += axes[j, c, FORWARD] * speeds[1] + push + 1e-9
            speeds[0] = max(axes[j, c, KEEP] * speeds[0] - gain - 1e-9, -most)
            speeds[1] = min(axes[j, c, KEEP] * speeds[1] + gain + 1e-9, most)
            kept = kept and max(low, before[0]) <= min(high, before[1])
            kept = kept and max(low_v, speeds[0]) <= min(high_v, speeds[1])
    if not known:
        return known
    for c in range(2):
        low, high, low_v, high_v = box[2 * c], box[2 * c + 1], s[2 + c], h[2 + c]
        before, speeds = memory[2 * c : 2 * c + 2], memory[4 + 2 * c : 6 + 2 * c]
        if kept:
            low, high = max(low, before[0]), min(high, before[1])
            low_v, high_v = max(low_v, speeds[0]), min(high_v, speeds[1])
        before[0], before[1], speeds[0], speeds[1] = low, high, low_v, high_v
        box[2 * c] = low - x[c] - stopping_distance(axes, j, c, -low_v)
        box[2 * c + 1] = high - x[c] + stopping_distance(axes, j, c, high_v)
    return known
