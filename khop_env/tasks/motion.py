"""Smallest distances along straight motion, exact between samples too."""

from __future__ import annotations

import numpy as np

from khop_env.compiled import compiled, place
from khop_env.observers import FloatArray


@compiled
def point_to_segment(px: float, py: float, ax: float, ay: float, bx: float, by: float) -> float:
    """Distance in m from the point p to the segment from a to b."""
    dx, dy = bx - ax, by - ay
    length = dx * dx + dy * dy
    share = 0.0
    if length > 0.0:
        share = min(max(((px - ax) * dx + (py - ay) * dy) / length, 0.0), 1.0)
    return float(np.hypot(ax + share * dx - px, ay + share * dy - py))


@compiled
def segment_to_segment(px: float, py: float, qx: float, qy: float, ax: float, ay: float, bx: float, by: float) -> float:
    """Distance in m between the segments from p to q and from a to b; 0 where they cross."""
    side_a = (qx - px) * (ay - py) - (qy - py) * (ax - px)
    side_b = (qx - px) * (by - py) - (qy - py) * (bx - px)
    side_p = (bx - ax) * (py - ay) - (by - ay) * (px - ax)
    side_q = (bx - ax) * (qy - ay) - (by - ay) * (qx - ax)
    if side_a * side_b < 0.0 and side_p * side_q < 0.0:
        return 0.0
    return min(
        min(point_to_segment(px, py, ax, ay, bx, by), point_to_segment(qx, qy, ax, ay, bx, by)),
        min(point_to_segment(ax, ay, px, py, qx, qy), point_to_segment(bx, by, px, py, qx, qy)),
    )


@compiled
def lower_distances(
    before: FloatArray,
    after: FloatArray,
    obstacles: FloatArray,
    nearest: FloatArray,
    clearance: FloatArray,
    low: int,
    high: int,
) -> None:
    """Lower the smallest distances by those of one step, in which all move straight, at constant speed and at once.

    The distance of two agents is that of a moving point, their difference, from the origin.

    Args:
        before: (N, d, B) positions in m.
        after: (N, d, B) positions at the end of the step.
        obstacles: (M, 5) ends and radius of each, in the plane.
        nearest: (N, B) distance to the nearest other agent, lowered in place.
        clearance: (N, B) distance to the nearest obstacle, lowered in place; negative inside of one.
        low: first environment.
        high: one past the last.
    """
    agents, dim, _ = before.shape
    for i in range(agents):
        for j in range(i):
            for b in range(high - low):
                env = place(low + b)
                square, along, length = 0.0, 0.0, 0.0
                for c in range(dim):
                    gap = before[i, c, env] - before[j, c, env]
                    change = after[i, c, env] - after[j, c, env] - gap
                    square += gap * gap
                    along += gap * change
                    length += change * change
                if along < 0.0:
                    share = min(-along / length, 1.0)
                    square = 0.0
                    for c in range(dim):
                        gap = before[i, c, env] - before[j, c, env]
                        gap += share * (after[i, c, env] - after[j, c, env] - gap)
                        square += gap * gap
                distance = np.sqrt(square)
                nearest[i, env] = min(nearest[i, env], distance)
                nearest[j, env] = min(nearest[j, env], distance)
        for m in range(obstacles.shape[0]):
            for env in range(low, high):
                distance = segment_to_segment(
                    before[i, 0, env],
                    before[i, 1, env],
                    after[i, 0, env],
                    after[i, 1, env],
                    obstacles[m, 0],
                    obstacles[m, 1],
                    obstacles[m, 2],
                    obstacles[m, 3],
                )
                clearance[i, env] = min(clearance[i, env], distance - obstacles[m, 4])
