"""Optimal reciprocal collision avoidance (ORCA) on what an agent knows of others: a baseline without a guarantee.

Source: J. van den Berg, S. J. Guy, M. Lin and D. Manocha, Reciprocal n-Body Collision Avoidance, Robotics Research
(ISRR 2009), Springer, 2011.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from agents.half_planes import BOX, best_velocity, box_limits
from agents.navigation import SLOW_GAIN, GoToGoal, require_plane, towards
from agents.others import Others
from agents.policy import EnvDescription
from agents.safety.columns import bodies
from agents.velocity_law import VELOCITY_INPUTS
from khop_env.compiled import compiled
from khop_env.env.layout import Float32Array
from khop_env.observers import FloatArray, IntArray
from khop_env.physics import velocity_to_input


class Orca(GoToGoal):
    """To the goal at full speed, with the velocity nearest to that which no other's forbids, if it takes its share.

    For each other of whom something is known, an agent takes half of the smallest change of their relative velocity
    after which they don't touch within `horizon`. So both have to do so, and to know where the other is and how fast:
    here that is an estimate, moved on by dead reckoning (`Others`), and the agent's own velocity is that of its last
    input. Where the half planes contradict each other, it takes the velocity that violates them least. The velocity
    towards an obstacle's nearest point is at most the distance over `horizon`; obstacles go first.

    Agents whose input is a velocity choose within their input limits, which here are a box, not a disc; others within
    `speed` along each axis, and follow their choice by `physics.velocity_to_input`, which takes them a while: for them
    it is further from its assumptions. It knows of no disturbance, for which `margin` makes room.

    Args:
        horizon: in s.
        margin: added to the sum of two radii, and to the distance from obstacles, in m.
        speed: in m/s, of agents whose input isn't a velocity.

    Raises:
        ValueError: for an argument out of range.
    """

    def __init__(self, horizon: float = 2.0, margin: float = 0.0, speed: float = 1.0) -> None:
        for name, value, valid in (
            ("horizon", horizon, 0.0 < horizon < math.inf),
            ("margin", margin, 0.0 <= margin < math.inf),
            ("speed", speed, 0.0 < speed < math.inf),
        ):
            if not valid:
                what = "positive" if name != "margin" else "0 or more"
                raise ValueError(f"{name} must be {what} and finite; got {value!r}")
        self.horizon, self.margin, self.speed = float(horizon), float(margin), float(speed)

    def reset(self, env: EnvDescription, seeds: Sequence[int]) -> None:
        """Find goals, others and obstacles in the observations.

        Raises:
            ValueError: if an agent has no goal, or positions aren't in the plane.
        """
        super().reset(env, seeds)
        require_plane("orca", env)
        self._others, self._period = Others(env), env.control_period
        self._bodies = bodies_of(env)
        self._last: dict[str, FloatArray] = {}

    def inputs(self, flat: Float32Array, states: FloatArray, ways: dict[str, FloatArray]) -> dict[str, FloatArray]:
        """See the class."""
        others, batch, time = self._others, len(flat), np.zeros(len(flat))
        others.update(flat)
        wish, current, chosen = (np.zeros((batch, len(ways), 2)) for _ in range(3))
        low, high = np.empty_like(wish), np.empty_like(wish)
        drifts = {}
        for i, (agent, model, part) in enumerate(self._agents()):
            x = states[:, part]
            drift = drifts[agent] = model.drift(time, x)
            last = self._last.get(agent)
            rate = drift if last is None or len(last) != batch else drift + model.input_map(time, x, last)
            current[:, i] = rate[:, [list(model.states).index(axis) for axis in model.position]]
            if model.type in VELOCITY_INPUTS:
                low[:, i], high[:, i] = drift - model.input_limit, drift + model.input_limit
                wish[:, i] = towards(model, x, ways[agent]) + drift
            else:
                low[:, i], high[:, i] = -self.speed, self.speed
                wanted = SLOW_GAIN * ways[agent]
                wish[:, i] = wanted * np.minimum(1.0, self.speed / np.abs(wanted).max(axis=1, initial=1e-9))[:, None]
        _choose(
            others.first,
            others.position,
            others.valid,
            *self._bodies,
            flat,
            others.ahead,
            others.velocity,
            current,
            wish,
            low,
            high,
            self.horizon,
            self.margin,
            self._period,
            chosen,
        )
        for i, (agent, model, part) in enumerate(self._agents()):
            x, velocity = states[:, part], chosen[:, i]
            if model.type in VELOCITY_INPUTS:
                self._last[agent] = np.clip(velocity - drifts[agent], -model.input_limit, model.input_limit)
            else:
                self._last[agent] = velocity_to_input(model, x, velocity)
        return dict(self._last)

    def begin(self, batch: int, env_ids: IntArray | None = None) -> None:
        """New episodes have begun in these of `batch` environments; None for all."""
        self._others.begin(batch, env_ids)
        if env_ids is None:
            self._last = {agent: np.zeros((batch, model.m)) for agent, model, _ in self._agents()}
            return
        for last in self._last.values():
            last[env_ids] = 0.0

    def get_state(self) -> dict[str, Any]:
        """What it remembers between actions: its last inputs, and what arrived of others."""
        return {"last": self._last, "others": self._others.get_state()}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continue from `get_state()`'s result, after a reset in the same environment."""
        self._last = dict(state["last"])
        self._others.set_state(state["others"])


def bodies_of(env: EnvDescription) -> tuple[IntArray, IntArray]:
    """(N,) columns of radii, and (N, M, 2) of vectors to obstacles' nearest points, in all observations side by side.

    Raises:
        ValueError: if observations are without a radius.
    """
    found, start = [], 0
    for agent, layout in env.layouts.items():
        found.append(bodies(agent, env, start, None))
        start += len(layout)
    return np.array([radius for radius, _, _ in found]), np.array([obstacles for _, obstacles, _ in found])


@compiled
def half_plane(
    x: float, y: float, vx: float, vy: float, radius: float, horizon: float, period: float
) -> tuple[float, float, float, float]:
    """The smallest change of a relative velocity after which two discs don't touch within the horizon.

    Args:
        x: where the other is, from the agent, in m.
        y: likewise.
        vx: the agent's velocity less the other's, in m/s.
        vy: likewise.
        radius: sum of both radii.
        horizon: in s; if they touch already, they are to be apart within `period`.
        period: in s.

    Returns:
        The normal (n_x, n_y) out of the forbidden velocities, and the change (u_x, u_y), along the normal or against.
    """
    squared = x * x + y * y
    touching = squared <= radius * radius
    time = period if touching else horizon
    wx, wy = vx - x / time, vy - y / time  # from the centre of the disc that cuts the cone off
    length, along = math.sqrt(wx * wx + wy * wy), wx * x + wy * y
    if touching or (along < 0.0 and along * along > radius * radius * length * length):
        if length > 0.0:
            nx, ny = wx / length, wy / length
        else:
            distance = math.sqrt(squared)
            nx, ny = (-x / distance, -y / distance) if distance > 0.0 else (1.0, 0.0)
        change = radius / time - length
        return nx, ny, change * nx, change * ny
    leg = math.sqrt(squared - radius * radius)
    if x * wy - y * wx > 0.0:  # the leg on the left
        dx, dy = (x * leg - y * radius) / squared, (x * radius + y * leg) / squared
    else:
        dx, dy = -(x * leg + y * radius) / squared, -(y * leg - x * radius) / squared
    onto = vx * dx + vy * dy
    return -dy, dx, onto * dx - vx, onto * dy - vy


@compiled
def _choose(
    first: IntArray,
    position: IntArray,
    valid: IntArray,
    radius_column: IntArray,
    obstacle: IntArray,
    flat: Float32Array,
    ahead: FloatArray,
    velocity: FloatArray,
    current: FloatArray,
    wish: FloatArray,
    low: FloatArray,
    high: FloatArray,
    horizon: float,
    margin: float,
    period: float,
    chosen: FloatArray,
) -> None:
    """Overwrite `chosen` (B, N, 2) with every agent's velocity in every environment."""
    rows = np.empty((BOX + obstacle.shape[1] + len(valid), 3))
    for b in range(flat.shape[0]):
        for i in range(len(radius_column)):
            vx, vy = current[b, i, 0], current[b, i, 1]
            radius = float(flat[b, radius_column[i]])
            box_limits(low[b, i, 0], high[b, i, 0], low[b, i, 1], high[b, i, 1], rows)
            used = obstacle_limits(flat, b, obstacle[i], radius + margin, 1.0 / horizon, 0.0, rows, BOX)
            hard = used
            for pair in range(first[i], first[i + 1]):
                if flat[b, valid[pair]] < 0.5:
                    continue
                x = float(flat[b, position[pair, 0]]) + ahead[b, pair, 0]
                y = float(flat[b, position[pair, 1]]) + ahead[b, pair, 1]
                relative_x, relative_y = vx - velocity[b, pair, 0], vy - velocity[b, pair, 1]
                nx, ny, ux, uy = half_plane(x, y, relative_x, relative_y, 2.0 * radius + margin, horizon, period)
                rows[used, 0], rows[used, 1] = -nx, -ny
                rows[used, 2] = -(nx * (vx + 0.5 * ux) + ny * (vy + 0.5 * uy))
                used += 1
            chosen[b, i, 0], chosen[b, i, 1], _ = best_velocity(rows, hard, used, wish[b, i, 0], wish[b, i, 1])


@compiled
def obstacle_limits(
    flat: Float32Array,
    b: int,
    obstacle: IntArray,
    distance: float,
    rate: float,
    pushed: float,
    rows: FloatArray,
    used: int,
) -> int:
    """Rows that limit the velocity towards obstacles' nearest points to what is left of the distance times `rate`.

    Args:
        flat: (B, D) observations.
        b: the environment.
        obstacle: (M, 2) columns of vectors to the nearest points.
        distance: to be kept, in m.
        rate: in 1/s.
        pushed: largest velocity of a disturbance, in m/s.
        rows: written from row `used` on.
        used: rows in use.

    Returns:
        Rows in use then.
    """
    for q in range(len(obstacle)):
        x, y = float(flat[b, obstacle[q, 0]]), float(flat[b, obstacle[q, 1]])
        near = math.sqrt(x * x + y * y)
        if near > 0.0:
            rows[used, 0], rows[used, 1] = x / near, y / near
            rows[used, 2] = rate * (near - distance) - pushed
            used += 1
    return used
