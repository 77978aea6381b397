"""Tasks along edges: agent i is to reach p_j - p_i = d_ij for each of its edges (i, j)."""

from __future__ import annotations

import abc
import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any, Literal, NamedTuple, TypedDict

import numpy as np

from khop_env.compiled import compiled, place
from khop_env.observers import FloatArray, IntArray
from khop_env.tasks.base import Column, Outcome, Signature, Task, World

Reward = Literal["agent", "team"]
NUMBER = (int, float, np.integer, np.floating)
_TILE = 32  # environments whose rewards are written together


class EdgeArguments(TypedDict, total=False):
    """Keyword arguments of every `EdgeTask`, for type checkers."""

    reward: Reward
    effort: float
    success_radius: float | None


class EdgeArrays(NamedTuple):
    """The edges of acting agents, and the owner of each input, for the compiled loop.

    Attributes:
        agent: (E,) number of the acting agent that an edge belongs to.
        own: (E, d) its position in the states.
        other: (E, d) the other agent's position in the states.
        displacement: (E, d) desired p_other - p_own, in m.
        weight: (E,) one over the number of the agent's edges.
        input_owner: (m,) number of the acting agent that each input belongs to; -1 for agents that don't act.
    """

    agent: IntArray
    own: IntArray
    other: IntArray
    displacement: FloatArray
    weight: FloatArray
    input_owner: IntArray


@dataclass(eq=False, kw_only=True)
class EdgeTask(Task):
    """Agents keep displacements along directed task edges, which a subclass defines in `relations`.

    Every control period agent i gets -control_period (mean over its edges of |p_j - p_i - d_ij|^2 + effort |u_i|^2),
    with true positions at the end of the period and inputs u_i as fractions of their limits.

    Attributes:
        reward: "agent" for each agent's own, "team" for the mean of all.
        effort: weight of the squared input, in m^2.
        success_radius: terminate when no agent's task error exceeds it, in m; None to go on to the horizon.
        displacement: (E, d) d_ij of `edges` in m. Set by `bind`.

    Raises:
        ValueError: for an argument out of range; the message names it, its value and the valid range.
    """

    reward: Reward = "agent"
    effort: float = 0.1
    success_radius: float | None = None

    def __post_init__(self) -> None:
        if self.reward not in ("agent", "team"):
            raise ValueError(f"reward must be 'agent' or 'team'; got {self.reward!r}")
        if not isinstance(self.effort, NUMBER) or not 0.0 <= self.effort < math.inf:
            raise ValueError(f"effort must be finite and not negative; got {self.effort!r}")
        if self.success_radius is not None:
            require_positive("success_radius", self.success_radius)

    @abc.abstractmethod
    def relations(self, world: World) -> tuple[IntArray, FloatArray]:
        """The directed task edges (E, 2), sorted, and the displacement (E, d) to keep along each, in m."""

    def bind(self, world: World) -> None:
        """Find the edges, and index arrays for the compiled loop."""
        super().bind(world)
        self.edges, self.displacement = self.relations(world)
        fleet, members = world.fleet, list(self.acting(world))
        # of each edge a number that grows with it, for `_desired`
        code = self.edges[:, 0] * len(fleet) + self.edges[:, 1]
        self._by_number = np.argsort(code, kind="stable")
        self._codes = code[self._by_number]
        self._reach = max(world.limit, float(np.abs(self.displacement).max(initial=0.0)))
        number = {agent: order for order, agent in enumerate(members)}
        counted = np.array([i in number for i in self.edges[:, 0].tolist()], bool)
        edges, position = self.edges[counted], fleet.position_index
        agent = np.array([number[i] for i in edges[:, 0].tolist()], np.int64)
        input_owner = np.full(fleet.m, -1, np.int64)
        for i, owner in number.items():
            input_owner[fleet.input_slice(i)] = owner
        arrays = EdgeArrays(
            agent,
            np.ascontiguousarray(position[edges[:, 0]]),
            np.ascontiguousarray(position[edges[:, 1]]),
            np.ascontiguousarray(self.displacement[counted]),
            1.0 / np.bincount(agent, minlength=len(members))[agent],
            input_owner,
        )
        self._arrays: Any = tuple(arrays)  # Numba recognises the types of a plain tuple more quickly
        self._work = arrays.own.size + fleet.m + len(members)
        self._period = world.control_period
        self._squares = np.zeros((len(members), world.num_envs))
        self._efforts = np.zeros((len(members), world.num_envs))

    def slot_columns(self, world: World, agent: int, other: int) -> Sequence[Column]:
        """The desired displacement along the edge; zeros without an edge."""
        reach, desired = self._reach, self._desired(world, agent, other)
        names = axis_names(world.fleet.position_dim)
        model = world.fleet.models[other]
        units = [model.states[name] for name in model.position]
        return [
            Column(f"displacement.{axis}", unit, -reach, reach, d)
            for axis, unit, d in zip(names, units, desired, strict=True)
        ]

    def evaluate(self, world: World) -> Outcome:
        """See the class; "task_error" is the root mean square error along the agent's own edges in m."""
        shape = world.num_envs, len(self._squares)
        reward, error = np.empty(shape), np.empty(shape)
        period, effort = float(world.control_period), float(self.effort)
        arrays = self._arrays, world.x, world.inputs, self._squares, self._efforts, reward, error
        world.each(lambda low, high: evaluate_edges(*arrays, period, effort, low, high), self._work)
        if self.reward == "team":
            reward[...] = reward.mean(axis=1, keepdims=True)
        terminated = np.zeros(world.num_envs, bool)
        if self.success_radius is not None:
            terminated = error.max(axis=1) <= self.success_radius
        return Outcome(reward, terminated, {"task_error": error})

    def robust_reward(self, reward: FloatArray, infos: Mapping[str, FloatArray], limit: float) -> FloatArray:
        """Huber's form of the squared task error: quadratic up to `limit`, linear beyond."""
        excess = np.maximum(infos["task_error"] - limit, 0.0)  # error^2 - huber(error) = excess^2
        return reward + (self._period * excess * excess).astype(reward.dtype)

    def signature(self, world: World) -> Signature:
        """Name, edges and displacements."""
        ids, places = world.fleet.ids, self.displacement.tolist()
        edges = [f"{ids[i]} to {ids[j]} by {d} m" for (i, j), d in zip(self.edges.tolist(), places, strict=True)]
        return {**super().signature(world), "task edges": tuple(edges)}

    def _desired(self, world: World, agent: int, other: int) -> list[float]:
        number = agent * len(world.fleet) + other
        place = int(self._codes.searchsorted(number))
        if place < len(self._codes) and self._codes[place] == number:
            return self.displacement[self._by_number[place]].tolist()
        return [0.0] * self.displacement.shape[1]


def require_positive(name: str, value: object) -> None:
    """Refuse an argument that isn't a positive, finite number.

    Raises:
        ValueError: naming the argument and the value.
    """
    if not isinstance(value, NUMBER) or not 0.0 < value <= 1e30:  # observations are float32, which ends at 3e38
        raise ValueError(f"{name} must be a positive, finite number of at most 1e30; got {value!r}")


def axis_names(dim: int) -> list[str]:
    """Names of the position's axes, common to all models."""
    return list("xyz"[:dim]) if dim <= 3 else [f"axis{q}" for q in range(dim)]


def ring(count: int, dim: int) -> FloatArray:
    """`count` points on a circle of radius 1 in the first two axes; on a line alternately left and right."""
    points = np.zeros((count, dim))
    if dim == 1:
        points[:, 0] = [(1 + q // 2) * (-1) ** q for q in range(count)]
    else:
        angle = 2.0 * math.pi * np.arange(count) / max(count, 1)
        points[:, 0], points[:, 1] = np.cos(angle), np.sin(angle)
    return points


@compiled
def evaluate_edges(
    edges: Any,
    x: FloatArray,
    inputs: FloatArray,
    squares: FloatArray,
    efforts: FloatArray,
    reward: FloatArray,
    error: FloatArray,
    period: float,
    effort: float,
    low: int,
    high: int,
) -> None:
    """Write every agent's reward, and its root mean square error along its task edges, in environments low to high.

    Args:
        edges: of the acting agents, the fields of `EdgeArrays` as a plain tuple.
        x: (n, B) states.
        inputs: (m, B) inputs as fractions of their limits.
        squares: (N, B) scratch.
        efforts: (N, B) scratch.
        reward: (B, N) overwritten with -period * (mean square error + effort * |u|^2).
        error: (B, N) overwritten with the root mean square error in m.
        period: control period in s.
        effort: weight of the squared inputs in m^2.
        low: first environment.
        high: one past the last.
    """
    edges = EdgeArrays(*edges)
    for i in range(squares.shape[0]):
        for b in range(high - low):
            squares[i, place(low + b)] = 0.0
            efforts[i, place(low + b)] = 0.0
    for edge in range(edges.agent.size):
        agent, weight = edges.agent[edge], edges.weight[edge]
        for c in range(edges.own.shape[1]):
            for b in range(high - low):
                env = place(low + b)
                miss = x[edges.other[edge, c], env] - x[edges.own[edge, c], env] - edges.displacement[edge, c]
                squares[agent, env] += weight * miss * miss
    for column in range(edges.input_owner.size):
        owner = edges.input_owner[column]
        if owner >= 0:
            for b in range(high - low):
                env = place(low + b)
                efforts[owner, env] += inputs[column, env] * inputs[column, env]
    for first in range(low, high, _TILE):
        for i in range(reward.shape[1]):
            for env in range(first, min(first + _TILE, high)):
                reward[env, i] = -period * (squares[i, env] + effort * efforts[i, env])
                error[env, i] = np.sqrt(squares[i, env])
