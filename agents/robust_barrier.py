"""A textbook barrier on estimated distances less their bounds, robust against any motion of others: a baseline.

Sources: L. Wang, A. D. Ames and M. Egerstedt, Safety Barrier Certificates for Collisions-Free Multirobot Systems, IEEE
Trans. Robotics 33(3), 2017 (arXiv 2016); M. Jankovic, Robust control barrier functions for constrained stabilization of
nonlinear systems, Automatica 96, 2018.
"""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from agents.half_planes import BOX, best_velocity, box_limits
from agents.navigation import KeepRight, towards
from agents.orca import bodies_of, obstacle_limits
from agents.others import Others, fastest
from agents.policy import EnvDescription, Observations
from agents.velocity_law import VELOCITY_INPUTS
from khop_env.compiled import compiled
from khop_env.env.layout import Float32Array
from khop_env.observers import FloatArray, IntArray


class RobustBarrier(KeepRight):
    """`keep_right`, with inputs changed as little as a barrier for each other agent demands.

    h = |p_j - p_i| - B_j - 2 r, with the estimate of p_j, and B_j the distance from it to a corner of its certified
    box. It demands h' >= -alpha h for every motion of the other: as if it drove at full speed towards the agent, which
    is how fast its bound grows. With e, the direction to the estimate, that is

        e . v_i <= alpha h - (largest speed of j along e) - (largest disturbance of i along e)

    and for the nearest points of obstacles the same without a speed of j.

    It isn't always solvable: surrounded by others, or by large bounds, an agent can't retreat from all. It then takes
    the velocity at which the largest violation is smallest, within its input limits and what obstacles leave: it
    retreats as well as it can. So it has no guarantee, and collides where losses come in bursts (docs/theory/safety.md,
    "Not this"). For agents whose input is a velocity.

    Args:
        alpha: in 1/s, above 0.

    Attributes:
        needs_bounds: True: it reads certified bounds.
        correction: by agent (..., 2), chosen input less that of `keep_right`, in m/s, of the last `act`.
        intervention: by agent (...), its length.
        infeasible: by agent (...), whether the program had no solution.

    Raises:
        ValueError: for an argument out of range.
    """

    needs_bounds = True

    def __init__(self, alpha: float = 10.0) -> None:
        if not 0.0 < alpha < math.inf:
            raise ValueError(f"alpha must be positive and finite; got {alpha!r}")
        self.alpha = float(alpha)
        self.correction: dict[str, FloatArray] = {}
        self.intervention: dict[str, FloatArray] = {}
        self.infeasible: dict[str, NDArray[np.bool_]] = {}

    def reset(self, env: EnvDescription, seeds: Sequence[int]) -> None:
        """Find goals, others, their bounds and obstacles in the observations.

        Raises:
            ValueError: if an agent has no goal, observations have no bounds, or inputs aren't velocities.
        """
        super().reset(env, seeds)
        bounds, fast, valid, start = [], [], [], 0
        for agent, layout in env.layouts.items():
            model = env.models[agent]
            if model.type not in VELOCITY_INPUTS:
                raise ValueError(
                    f"robust_barrier is for agents whose input is a velocity ({', '.join(VELOCITY_INPUTS)}); {agent!r} "
                    f"is a {type(model).__name__}"
                )
            for number, slot in enumerate(layout.slots):
                if slot.id not in env.models:
                    raise ValueError(f"robust_barrier needs to know how fast others are, and {slot.id!r} doesn't act")
                other = env.models[slot.id]
                names = [f"slot{number}.bound.{axis}" for axis in other.position]
                if any(name not in layout.names for name in names):
                    raise ValueError("robust_barrier reads certified bounds: make the environment with bounds=True")
                bounds.append([start + layout.index(name) for name in names])
                fast.append(fastest(other) + env.disturbance[slot.id])
                # by messages bounds are right before anything has arrived, too
                age = f"slot{number}.age" in layout.names
                valid.append(-1 if age else start + layout.index(f"slot{number}.valid"))
            start += len(layout)
        self._pairs, self._bodies = Others(env), bodies_of(env)
        self._bounds, self._fast, self._valid = np.array(bounds), np.array(fast), np.array(valid)
        self._pushed = np.array([env.disturbance[agent] for agent in env.agents], float)

    def act(self, observations: Observations) -> dict[str, Float32Array]:
        """Inputs as fractions of their limits."""
        actions = super().act(observations)
        for i, (agent, action) in enumerate(actions.items()):
            shape = action.shape[:-1]
            self.correction[agent] = self._change[:, i].reshape(*shape, 2)
            self.intervention[agent] = np.linalg.norm(self.correction[agent], axis=-1)
            self.infeasible[agent] = self._infeasible[:, i].reshape(shape)
        return actions

    def inputs(self, flat: Float32Array, states: FloatArray, ways: dict[str, FloatArray]) -> dict[str, FloatArray]:
        """See the class."""
        pairs, time = self._pairs, np.zeros(len(flat))
        wish = np.stack([towards(model, states[:, s], ways[agent]) for agent, model, s in self._agents()], axis=1)
        drift = np.stack([model.drift(time, states[:, s]) for _, model, s in self._agents()], axis=1)
        limit = np.stack([model.input_limit for _, model, _ in self._agents()])
        chosen, self._infeasible = np.empty_like(wish), np.empty(wish.shape[:2], np.bool_)
        _choose(
            pairs.first,
            pairs.position,
            self._valid,
            self._bounds,
            self._fast,
            self._pushed,
            *self._bodies,
            flat,
            wish + drift,
            drift - limit,
            drift + limit,
            self.alpha,
            chosen,
            self._infeasible,
        )
        u = np.clip(chosen - drift, -limit, limit)
        self._change = u - wish
        return {agent: u[:, i] for i, agent in enumerate(ways)}


@compiled
def _choose(
    first: IntArray,
    position: IntArray,
    valid: IntArray,
    bound: IntArray,
    fast: FloatArray,
    pushed: FloatArray,
    radius_column: IntArray,
    obstacle: IntArray,
    flat: Float32Array,
    wish: FloatArray,
    low: FloatArray,
    high: FloatArray,
    alpha: float,
    chosen: FloatArray,
    infeasible: NDArray[np.bool_],
) -> None:
    """Overwrite `chosen` (B, N, 2), every agent's velocity, and `infeasible` (B, N)."""
    rows = np.empty((BOX + obstacle.shape[1] + len(bound), 3))
    for b in range(flat.shape[0]):
        for i in range(len(radius_column)):
            radius = float(flat[b, radius_column[i]])
            box_limits(low[b, i, 0], high[b, i, 0], low[b, i, 1], high[b, i, 1], rows)
            push = math.sqrt(pushed[i, 0] ** 2 + pushed[i, 1] ** 2)
            used = obstacle_limits(flat, b, obstacle[i], radius, alpha, push, rows, BOX)
            hard = used
            for pair in range(first[i], first[i + 1]):
                if valid[pair] >= 0 and flat[b, valid[pair]] < 0.5:
                    continue
                x, y = float(flat[b, position[pair, 0]]), float(flat[b, position[pair, 1]])
                distance = math.sqrt(x * x + y * y)
                ex, ey = (x / distance, y / distance) if distance > 0.0 else (1.0, 0.0)
                corner = math.sqrt(float(flat[b, bound[pair, 0]]) ** 2 + float(flat[b, bound[pair, 1]]) ** 2)
                across = abs(ex) * (fast[pair, 0] + pushed[i, 0]) + abs(ey) * (fast[pair, 1] + pushed[i, 1])
                rows[used, 0], rows[used, 1] = ex, ey
                rows[used, 2] = alpha * (distance - corner - 2.0 * radius) - across
                used += 1
            x, y, kept = best_velocity(rows, hard, used, wish[b, i, 0], wish[b, i, 1])
            chosen[b, i, 0], chosen[b, i, 1], infeasible[b, i] = x, y, not kept
