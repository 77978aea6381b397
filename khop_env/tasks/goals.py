"""Compiled loops of navigation: progress to goals, arrivals, collisions, and what agents observe."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from khop_env.compiled import compiled
from khop_env.observers import FloatArray, IntArray
from khop_env.tasks.motion import lower_distances

_TILE = 32  # environments whose results are written together


class Memory(NamedTuple):
    """`Navigation.memory`, whose arrays the loops take as a plain tuple, which Numba recognises more quickly.

    Attributes:
        goal: (N, d, B) in m.
        before: (N, d, B) positions in m at the beginning of the control period.
        place: (N, d, B) positions in m at the end of the last step of the simulator.
        nearest: (N, B) smallest distance to another agent in the control period, in m.
        clearance: (N, B) likewise to an obstacle.
        reached: (N, B) 1 if the agent had arrived before this control period.
    """

    goal: FloatArray
    before: FloatArray
    place: FloatArray
    nearest: FloatArray
    clearance: FloatArray
    reached: FloatArray


@compiled
def _distance(goal: FloatArray, place: FloatArray, i: int, env: int) -> float:
    """Distance in m of agent i's place from its goal, both (N, d, B)."""
    square = 0.0
    for c in range(goal.shape[1]):
        gap = goal[i, c, env] - place[i, c, env]
        square += gap * gap
    return float(np.sqrt(square))


@compiled
def follow_motion(
    memory: Any,
    positions: IntArray,
    x: FloatArray,
    obstacles: FloatArray,
    after: FloatArray,
    first: bool,
    goal_radius: float,
    limit: float,
    low: int,
    high: int,
) -> None:
    """Bring the memory up to date with one step of the simulator.

    Args:
        memory: the fields of `Memory`, overwritten.
        positions: (N, d) rows of the positions in the states.
        x: (n, B) states at the end of the step.
        obstacles: (M, 5), as `lower_distances` takes them.
        after: (N, d, B) scratch.
        first: whether it is the first step of a control period, in which distances start anew.
        goal_radius: in m.
        limit: where distances start, in m.
        low: first environment.
        high: one past the last.
    """
    memory = Memory(*memory)
    place, nearest, clearance = memory.place, memory.nearest, memory.clearance
    for i in range(positions.shape[0]):
        for c in range(positions.shape[1]):
            for env in range(low, high):
                after[i, c, env] = x[positions[i, c], env]
        if first:
            for env in range(low, high):
                if _distance(memory.goal, place, i, env) <= goal_radius:
                    memory.reached[i, env] = 1.0
                nearest[i, env] = limit
                clearance[i, env] = limit
            for c in range(positions.shape[1]):
                for env in range(low, high):
                    memory.before[i, c, env] = place[i, c, env]
    lower_distances(place, after, obstacles, nearest, clearance, low, high)
    for i in range(positions.shape[0]):
        for c in range(positions.shape[1]):
            for env in range(low, high):
                place[i, c, env] = after[i, c, env]


@compiled
def evaluate_goals(
    memory: Any,
    positions: IntArray,
    x: FloatArray,
    inputs: FloatArray,
    input_owner: IntArray,
    effort: FloatArray,
    reward: FloatArray,
    terminated: NDArray[np.bool_],
    infos: Any,
    weights: tuple[float, float, float],
    sizes: tuple[float, float],
    end_at_collision: bool,
    low: int,
    high: int,
) -> None:
    """Rewards, terminations and infos of navigation.

    Args:
        memory: the fields of `Memory`.
        positions: (N, d) rows of the positions in the states.
        x: (n, B) states.
        inputs: (m, B) as fractions of their limits.
        input_owner: (m,) number of the agent that each input belongs to.
        effort: (N, B) scratch.
        reward: (B, N) overwritten.
        terminated: (B,) overwritten.
        infos: arrays (B, N) overwritten: distance to the goal, cost, arrived, and the two smallest distances.
        weights: of the squared input (in m), of the first arrival, and of the cost.
        sizes: radius in m of goals and of agents.
        end_at_collision: whether a collision terminates the episode.
        low: first environment.
        high: one past the last.
    """
    memory = Memory(*memory)
    error, costs, arrivals, smallest, to_obstacle = infos
    of_effort, bonus, penalty = weights
    goal_radius, radius = sizes
    agents, dim = positions.shape
    for i in range(agents):
        for env in range(low, high):
            effort[i, env] = 0.0
    for column in range(input_owner.size):
        for env in range(low, high):
            effort[input_owner[column], env] += inputs[column, env] * inputs[column, env]
    collided = np.empty(_TILE, np.bool_)
    for first in range(low, high, _TILE):
        last = min(first + _TILE, high)
        for env in range(first, last):
            terminated[env], collided[env - first] = True, False
        for i in range(agents):
            for env in range(first, last):
                square = 0.0
                for c in range(dim):
                    gap = memory.goal[i, c, env] - x[positions[i, c], env]
                    square += gap * gap
                distance = np.sqrt(square)
                arrived = distance <= goal_radius
                hit = memory.nearest[i, env] < 2.0 * radius or memory.clearance[i, env] < radius
                terminated[env] &= arrived
                collided[env - first] |= hit
                value = _distance(memory.goal, memory.before, i, env) - distance - of_effort * effort[i, env]
                reward[env, i] = value + (bonus * arrived * (1.0 - memory.reached[i, env]) - penalty * hit)
                error[env, i], costs[env, i], arrivals[env, i] = distance, hit, arrived
                smallest[env, i], to_obstacle[env, i] = memory.nearest[i, env], memory.clearance[i, env]
        for env in range(first, last):
            terminated[env] = terminated[env] or (end_at_collision and collided[env - first])


@compiled
def observe_goals(
    positions: IntArray, x: FloatArray, goal: FloatArray, obstacles: FloatArray, out: FloatArray, low: int, high: int
) -> None:
    """Where the goal and the nearest points of all obstacles are, from each agent, the nearest first.

    From inside an obstacle the point is the nearest one of its surface, in the other direction.

    Args:
        positions: (N, d) rows of the positions in the states.
        x: (n, B) states.
        goal: (N, d, B) in m.
        obstacles: (M, 5) ends and radius of each, in the plane.
        out: (N (1 + M) d, B) overwritten, in m.
        low: first environment.
        high: one past the last.
    """
    agents, dim = positions.shape
    count = len(obstacles)
    points, distances = np.empty((count, 2)), np.empty(count)
    for i in range(agents):
        row = i * (dim + 2 * count)
        for c in range(dim):
            for env in range(low, high):
                out[row + c, env] = goal[i, c, env] - x[positions[i, c], env]
        for env in range(low, high):
            for m in range(count):
                ax, ay, radius = obstacles[m, 0], obstacles[m, 1], obstacles[m, 4]
                along_x, along_y = obstacles[m, 2] - ax, obstacles[m, 3] - ay
                px, py = x[positions[i, 0], env], x[positions[i, 1], env]
                length = along_x * along_x + along_y * along_y
                share = ((px - ax) * along_x + (py - ay) * along_y) / (length if length > 0.0 else 1.0)
                share = min(max(share, 0.0), 1.0)
                gap_x, gap_y = ax + share * along_x - px, ay + share * along_y - py
                distance = np.sqrt(gap_x * gap_x + gap_y * gap_y)
                outside = 1.0 - radius / (distance if distance > 0.0 else np.inf)
                gap_x, gap_y = gap_x * outside, gap_y * outside
                far, q = np.hypot(gap_x, gap_y), m
                while q > 0 and distances[q - 1] > far:
                    distances[q], points[q, 0], points[q, 1] = distances[q - 1], points[q - 1, 0], points[q - 1, 1]
                    q -= 1
                distances[q], points[q, 0], points[q, 1] = far, gap_x, gap_y
            for m in range(count):
                out[row + dim + 2 * m, env] = points[m, 0]
                out[row + dim + 2 * m + 1, env] = points[m, 1]
