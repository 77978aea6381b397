"""Reach goals without collisions, among agents that are out of range of one's own radio."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass
from types import MappingProxyType
from typing import Any, ClassVar, TypedDict

import numpy as np

from khop_env.observers import FloatArray, IntArray
from khop_env.simulation import Arena
from khop_env.tasks.base import Column, MapCanvas, Outcome, Signature, Task, World
from khop_env.tasks.edges import NUMBER, Reward, axis_names, require_positive
from khop_env.tasks.goals import Memory, evaluate_goals, follow_motion, observe_goals
from khop_env.tasks.motion import lower_distances

START = np.array([0.8, 0.5])  # of an arrow in the legend
RING = np.column_stack([np.cos(np.linspace(0.0, 2.0 * np.pi, 49)), np.sin(np.linspace(0.0, 2.0 * np.pi, 49))])
DISC, COLLIDED, OBSTACLE, ARROW, MARKED = "#8899aa", "#cc3311", "#999999", "#ee7733", "#aa3377"
GOAL, TO_GOAL = "#228833", "#99ccaa"
INFOS = ("task_error", "cost", "arrived", "min_distance", "obstacle_distance")


class NavigationArguments(TypedDict, total=False):
    """Keyword arguments of `Navigation`, for type checkers."""

    reward: Reward
    effort: float
    bonus: float
    penalty: float
    goal_radius: float
    end_at_collision: bool


@dataclass(eq=False, kw_only=True)
class Navigation(Task):
    """Each agent is to reach a goal of its own; agents are discs that must not touch each other or obstacles.

    Every control period an agent gets the distance in m by which it has come nearer to its goal, plus `bonus` when it
    arrives for the first time in the episode, minus control_period * `effort` * |u_i|^2, with its input u_i as
    fractions of the limits, minus `penalty` times its cost. The cost is 1 if the agent has collided, else 0: if within
    the period the distance to another agent was below two radii, or to an obstacle below one, on straight lines between
    the steps of the simulator. Size of agents, obstacles and goals are the scenario's `arena`; on a scenario without
    one goals are random within the initial set.

    Attributes:
        reward: "agent" for each agent's own, "team" for the mean of all.
        effort: weight of the squared input, in m/s.
        bonus: for the first arrival, in m.
        penalty: for a control period with a collision, in m.
        goal_radius: an agent has arrived while its distance to the goal is at most this, in m.
        end_at_collision: whether the episode terminates at the first collision. It terminates in any case when all
            agents are at their goals.

    Raises:
        ValueError: for an argument out of range; the message names it, its value and the valid range.
    """

    default_scenario: ClassVar[str] = "crossing"
    default_policy: ClassVar[str | None] = "go_to_goal"
    defaults = MappingProxyType({"max_cycles": None})
    reward: Reward = "agent"
    effort: float = 0.01
    bonus: float = 1.0
    penalty: float = 0.0
    goal_radius: float = 0.2
    end_at_collision: bool = False

    def __post_init__(self) -> None:
        if self.reward not in ("agent", "team"):
            raise ValueError(f"reward must be 'agent' or 'team'; got {self.reward!r}")
        for name in ("effort", "bonus", "penalty"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, NUMBER) or not 0.0 <= value < math.inf:
                raise ValueError(f"{name} must be finite and not negative; got {value!r}")
        require_positive("goal_radius", self.goal_radius)
        if not isinstance(self.end_at_collision, bool):
            raise ValueError(f"end_at_collision must be True or False; got {self.end_at_collision!r}")

    def bind(self, world: World) -> None:
        """Find the arena, and make room for goals and for what has happened within a control period."""
        fleet, initial = world.fleet, world.initial
        if initial is None:
            raise ValueError("navigation needs to know where agents start: give World the attribute initial")
        center, radius = initial.center[fleet.position_index], initial.radius[fleet.position_index]
        low, high = (center - radius).min(axis=0), (center + radius).max(axis=0)
        self._box = (low + high) / 2.0, (high - low) / 2.0
        self.arena = _default_arena(*self._box, len(fleet)) if initial.arena is None else initial.arena
        self._obstacles = self.arena.segments()
        shape = len(fleet), fleet.position_dim, world.num_envs
        self.memory = {
            "goal": np.zeros(shape),  # m
            "before": np.zeros(shape),  # m, positions at the beginning of the control period
            "place": np.zeros(shape),  # m, at the end of the last step of the simulator
            "nearest": np.zeros((len(fleet), world.num_envs)),  # m, smallest in the control period
            "clearance": np.zeros((len(fleet), world.num_envs)),
            "reached": np.zeros((len(fleet), world.num_envs)),  # 1 if it had arrived before this control period
        }
        self._input_owner = np.repeat(np.arange(len(fleet)), [model.m for model in fleet.models])
        self._numbers = len(fleet) * (len(fleet) * fleet.position_dim + 20 * len(self._obstacles))  # in `moved`
        self._after, self._effort = np.zeros(shape), np.zeros((len(fleet), world.num_envs))

    def columns(self, world: World, agent: int) -> Sequence[Column]:
        """Goal and nearest points of all obstacles, relative to the agent, the nearest first; the agents' radius."""
        axes, unit = axis_names(world.fleet.position_dim), world.fleet.position_unit()
        names = [f"goal.{axis}" for axis in axes]
        names += [f"obstacle{q}.{axis}" for q in range(len(self._obstacles)) for axis in axes]
        reach, first = 2.0 * world.limit, agent * len(names)
        columns = [Column(name, unit, -reach, reach, row=first + q) for q, name in enumerate(names)]
        return [*columns, Column("radius", unit, 0.0, max(world.limit, self.arena.radius), self.arena.radius)]

    def observe(self, world: World, out: FloatArray) -> None:
        """Fill these columns."""
        arrays = world.fleet.position_index, world.x, self.memory["goal"], self._obstacles, out
        world.each(lambda low, high: observe_goals(*arrays, low, high), len(out) * 5)

    def reset(self, world: World, env_ids: IntArray, rngs: Sequence[np.random.Generator]) -> None:
        """Draw the goals."""
        positions, memory = world.positions(), self.memory
        for env, rng in zip(env_ids.tolist(), rngs, strict=True):
            if self.arena.goals == "opposite":
                goal = -positions[..., env]
            else:
                center, radius = (np.broadcast_to(each, positions.shape[:2]) for each in self._box)
                goal = self.arena.draw(center, radius, rng)
            memory["goal"][..., env] = goal
        memory["reached"][:, env_ids] = 0.0
        here = np.ascontiguousarray(positions[..., env_ids])
        nearest, clearance = (np.full((len(here), len(env_ids)), world.limit) for _ in range(2))
        lower_distances(here, here, self._obstacles, nearest, clearance, 0, len(env_ids))
        for name, values in (("before", here), ("place", here), ("nearest", nearest), ("clearance", clearance)):
            memory[name][..., env_ids] = values

    def moved(self, world: World, number: int) -> None:
        """Lower the smallest distances of the control period."""
        memory, index, x = self._arrays(), world.fleet.position_index, world.x
        first, radius, limit = number == 0, float(self.goal_radius), float(world.limit)
        arrays = memory, index, x, self._obstacles, self._after
        world.each(lambda low, high: follow_motion(*arrays, first, radius, limit, low, high), self._numbers)

    def _arrays(self) -> Any:
        """The memory for compiled loops."""
        return tuple([self.memory[name] for name in Memory._fields])

    def evaluate(self, world: World) -> Outcome:
        """See the class; "task_error" is the distance to the goal."""
        shape = world.num_envs, len(self._effort)
        reward, terminated = np.empty(shape), np.empty(world.num_envs, bool)
        infos = {name: np.empty(shape) for name in INFOS}
        memory, index, x = self._arrays(), world.fleet.position_index, world.x
        arrays = memory, index, x, world.inputs, self._input_owner, self._effort
        results = reward, terminated, tuple(infos.values())
        weights = float(world.control_period * self.effort), float(self.bonus), float(self.penalty)
        sizes = float(self.goal_radius), float(self.arena.radius)
        ends = self.end_at_collision
        world.each(
            lambda low, high: evaluate_goals(*arrays, *results, weights, sizes, ends, low, high), 30 * len(self._effort)
        )
        if self.reward == "team":
            reward[...] = reward.mean(axis=1, keepdims=True)
        return Outcome(reward, terminated, infos)

    def signature(self, world: World) -> Signature:
        """Name, agents' size, goals and obstacles."""
        arena = self.arena
        return {
            "tasks": (self.name,),
            "arenas": (f"{arena.goals} goals, radius {arena.radius} m, {arena.apart} m apart",),
            "obstacles": tuple(map(repr, arena.obstacles)),
        }

    def draw(self, canvas: MapCanvas, world: World) -> None:
        """Obstacles, goals, agents as discs, red where they collide, `World.arrows`, and rings where `World.marked`."""
        memory, radius = self.memory, self.arena.radius
        positions = _in_plane(world.positions()[..., 0])
        for x1, y1, x2, y2, thick in self._obstacles:
            ends = np.array([[x1, y1], [x2, y2]])
            if (x1, y1) != (x2, y2):
                side = np.array([y1 - y2, x2 - x1]) * thick / math.hypot(x2 - x1, y2 - y1)
                canvas.line(ends + side, OBSTACLE, 3.0)
                canvas.line(ends - side, OBSTACLE, 3.0)
            for end in ends if thick else ():
                canvas.circle(end, thick, OBSTACLE, filled=True)
        collided = (memory["nearest"][:, 0] < 2.0 * radius) | (memory["clearance"][:, 0] < radius)
        marked = np.zeros(len(positions), bool) if world.marked is None else world.marked[:, 0]
        for own, goal, hit, mark in zip(positions, _in_plane(memory["goal"][..., 0]), collided, marked, strict=True):
            canvas.circle(goal, self.goal_radius, GOAL)
            canvas.line(np.array([own, goal]), TO_GOAL, 0.5)
            visible = max(radius, 1.6 * canvas.marker) if hit or mark else radius
            _disc(canvas, own, visible, bool(hit), bool(mark))
        canvas.legend("body of an agent", lambda symbol: _disc(symbol, np.zeros(2), 0.7, False, False))
        canvas.legend("in a collision", lambda symbol: _disc(symbol, np.zeros(2), 0.7, True, False))
        canvas.legend("goal", lambda symbol: symbol.circle(np.zeros(2), 0.7, GOAL))
        if len(self._obstacles):
            canvas.legend("obstacle", lambda symbol: symbol.circle(np.zeros(2), 0.5, OBSTACLE, filled=True))
        if world.marked is not None:
            canvas.legend("filter infeasible", lambda symbol: _disc(symbol, np.zeros(2), 0.7, False, True))
        if world.arrows is not None:
            for own, arrow in zip(positions, _in_plane(world.arrows[..., 0]), strict=True):
                _arrow(canvas, own, arrow)
            canvas.legend("change by a filter", lambda symbol: _arrow(symbol, -START, 2.0 * START))


def _default_arena(center: FloatArray, radius: FloatArray, agents: int) -> Arena:
    """For a scenario without one: goals so far apart as fit easily into the initial set, at most 2.5 radii."""
    dim = len(center)
    volume = float(np.prod(2.0 * radius))
    return Arena(apart=min(2.5 * Arena.radius, 0.5 * (volume / agents) ** (1.0 / dim)))


def _in_plane(points: FloatArray) -> FloatArray:
    """(N, 2) as frames show positions: on a line, or from above."""
    return points[:, :2] if points.shape[1] > 1 else np.pad(points, ((0, 0), (0, 1)))


def _disc(canvas: MapCanvas, center: FloatArray, radius: float, hit: bool, mark: bool) -> None:
    """An agent's body; in a ring if it is marked."""
    canvas.circle(center, radius, COLLIDED if hit else DISC, filled=hit)
    if mark:
        canvas.line(center + 1.25 * radius * RING, MARKED, 3.0)


def _arrow(canvas: MapCanvas, start: FloatArray, arrow: FloatArray) -> None:
    """An arrow with a head, unless it is shorter than 1 cm."""
    if float(np.hypot(*arrow)) < 0.01:
        return
    tip, side = start + arrow, np.array([-arrow[1], arrow[0]])
    canvas.line(np.array([start, tip]), ARROW, 2.5)
    canvas.line(np.array([tip - 0.25 * arrow + 0.15 * side, tip, tip - 0.25 * arrow - 0.15 * side]), ARROW, 2.5)
