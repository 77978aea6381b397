"""Base class of tasks: acting agents, rewards, termination, infos, and additional columns of observations.

A task is one file. It is bound to a fleet once, and evaluated after every control period; an environment
(`khop_env.env`) does the rest: observations, actions, seeds, rendering, saving and restoring.
"""

from __future__ import annotations

import abc
import re
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from types import MappingProxyType
from typing import Any, ClassVar, NamedTuple, Protocol

import networkx as nx
import numpy as np
from numpy.typing import NDArray

from khop_env.brief import brief
from khop_env.observers import FloatArray, IntArray, ObserverDesign
from khop_env.physics import Fleet
from khop_env.simulation import InitialSet
from khop_env.threads import Threads

Signature = dict[str, tuple[str, ...]]
"""Properties in words, by a plural noun, which two environments must have in common to exchange states."""


@dataclass(eq=False)
class World:
    """The true state of B environments for tasks: arrays with the batch as their last axis.

    Attributes:
        design: the observers, with the fleet and the communication graph.
        graph: the scenario's task graph on the agents' indices.
        num_envs: number of environments B.
        control_period: time between actions in s.
        limit: bound on positions and other states in observations, in their own units.
        t: (B,) time since reset in s.
        x: (n, B) states.
        inputs: (m, B) inputs in force, as fractions of their limits.
        initial: where states start, with the scenario's arena if it has one.
        arrows: (N, d, B) in m, drawn from each agent in frames; None for none. Whoever changes actions may set it.
        marked: (N, B) agents that are to stand out in frames; None for none. Set like `arrows`.
        threads: that share the environments.
    """

    design: ObserverDesign
    graph: nx.Graph
    num_envs: int
    control_period: float
    limit: float
    t: FloatArray
    x: FloatArray
    inputs: FloatArray
    initial: InitialSet | None = None
    arrows: FloatArray | None = None
    marked: NDArray[np.bool_] | None = None
    threads: Threads = field(default_factory=lambda: Threads(1))

    __repr__ = brief

    def each(self, function: Callable[[int, int], object], numbers: int) -> None:
        """Call `function(low, high)` with ranges of environments, which together are all, in the threads.

        Args:
            function: compiled code, which doesn't hold the GIL, or NumPy's on many environments; what it writes for an
                environment must not depend on the range.
            numbers: about how many it computes for an environment; a sine counts as ten.
        """
        if self.threads.count == 1 or len(ranges := self.threads.worthwhile(self.num_envs, numbers)) == 1:
            function(0, self.num_envs)
        else:
            self.threads.run(lambda part: function(*part), ranges)

    @property
    def fleet(self) -> Fleet:
        """All agents."""
        return self.design.fleet

    def positions(self) -> FloatArray:
        """(N, d, B) positions in m, in new memory."""
        return self.x[self.fleet.position_index]


class Outcome(NamedTuple):
    """The result of one control period.

    Attributes:
        reward: (B, N) of each acting agent.
        terminated: (B,) whether the episode has ended, for the whole team.
        infos: (B, N) each, by name; must have "task_error", the distance of an agent from its goal in the task's unit.
    """

    reward: FloatArray
    terminated: NDArray[np.bool_]
    infos: dict[str, FloatArray]


@dataclass(frozen=True)
class Column:
    """A column that a task adds to an observation: a constant, or live.

    Attributes:
        name: of the field, e.g. "goal.x".
        unit: e.g. "m"; "" where it has none.
        low: smallest value; smaller ones are clipped, and counted in the infos.
        high: largest value.
        value: of a constant.
        row: of a live column, the row that `Task.observe` writes.
    """

    name: str
    unit: str
    low: float
    high: float
    value: float = 0.0
    row: int | None = None


class MapCanvas(Protocol):
    """Draws on the map of a frame, in metres; colours are "#RRGGBB".

    Attributes:
        marker: radius of an agent's marker in m.
    """

    marker: float

    def circle(self, center: FloatArray, radius: float, color: str, *, filled: bool = False) -> None:
        """A circle about `center` (2,) with `radius` in m and a `color`; its inside, too, if `filled`."""
        ...

    def line(self, points: FloatArray, color: str, width: float = 2.0) -> None:
        """A line through `points` (K, 2) in m of a `color`, `width` pixels wide."""
        ...

    def cross(self, center: FloatArray, color: str) -> None:
        """A cross at `center` (2,) of a `color`, as large as an agent's marker."""
        ...

    def legend(self, text: str, symbol: Callable[[MapCanvas], None]) -> None:
        """A line of the legend, with a `symbol` that is drawn within +-1 m."""
        ...


class _NoEdges:
    """(0, 2), as long as a task has set no edges: not as an array, whose long description `help` would print."""

    _none = np.zeros((0, 2), np.int64)

    def __get__(self, task: object, owner: type) -> object:
        return self if task is None else self._none


class Task(abc.ABC):
    """A task for a team. A subclass implements `evaluate`; everything else has a default.

    Attributes:
        name: of the environment without its version; by default the class's name in snake case.
        version: of the environment.
        default_scenario: name of the scenario that is used if none is specified.
        driven_label: name in messages and legends of an agent that doesn't act.
        default_policy: name of the policy that acts if none is named; None for the law of the scenario.
        defaults: of arguments of the environment that aren't the task's own, where they differ from `env.Settings`.
        edges: (E, 2) directed pairs (i, j), sorted: agent i's task depends on agent j. Set by `bind`. Slots of
            observations begin with these agents, laws act along these edges (where slots have no `displacement`, to
            meet), and frames draw them.
        memory: arrays that the next steps depend on, e.g. numbers drawn by `reset`; saved and restored with the state.
    """

    name: ClassVar[str] = ""
    version: ClassVar[int] = 0
    default_scenario: ClassVar[str] = "paper"
    driven_label: ClassVar[str] = "driven agent"
    default_policy: ClassVar[str | None] = None
    defaults: ClassVar[Mapping[str, Any]] = MappingProxyType({})
    edges: IntArray = _NoEdges()  # type: ignore[assignment]
    memory: dict[str, FloatArray]

    def __init_subclass__(cls, **arguments: object) -> None:
        super().__init_subclass__(**arguments)
        if "name" not in vars(cls):
            cls.name = re.sub(r"(?<=[a-z0-9])(?=[A-Z])|(?<=[A-Z])(?=[A-Z][a-z])", "_", cls.__name__).lower()

    @property
    def environment(self) -> str:
        """Name of the environment, e.g. "consensus_v0"."""
        return f"{self.name}_v{self.version}"

    def bind(self, world: World) -> None:
        """Bind to a fleet: index arrays, `edges`, zeroed `memory`. Called once, before everything else.

        Args:
            world: of the environment; its arrays hold no values yet.

        Raises:
            ValueError: if the task can't be done by this fleet.
        """
        self.memory = {}

    def acting(self, world: World) -> Sequence[int]:
        """Indices of the agents that act, ascending; all by default. `drive` moves the others."""
        return range(len(world.fleet))

    def columns(self, world: World, agent: int) -> Sequence[Column]:
        """Columns of an agent's observation beside its own state and slots; none by default.

        Args:
            world: for names, models and limits.
            agent: index of the observing agent; with uniform observations all agents need as many columns.
        """
        return ()

    def slot_columns(self, world: World, agent: int, other: int) -> Sequence[Column]:
        """Columns of a slot beside the other agent's state; none by default.

        Args:
            world: for names, models and limits.
            agent: index of the observing agent.
            other: index of the agent in the slot; all slots need as many columns.
        """
        return ()

    def observe(self, world: World, out: FloatArray) -> None:  # noqa: B027
        """Write the values of live columns.

        Args:
            world: at the time of the observation.
            out: (rows, B) to be overwritten.
        """

    def reset(self, world: World, env_ids: IntArray, rngs: Sequence[np.random.Generator]) -> None:  # noqa: B027
        """Draw the random numbers of an episode; does nothing by default.

        Args:
            world: at the beginning of the new episodes; initial states are drawn before, from the same generators.
            env_ids: (R,) indices of the environments that are reset.
            rngs: (R,) their generators.
        """

    def drive(self, world: World, u: FloatArray) -> None:  # noqa: B027
        """Write the inputs of agents that don't act; called before every step of the simulator.

        Args:
            world: at the beginning of the step.
            u: (m, B) physical inputs, to be overwritten in the rows of these agents.
        """

    def moved(self, world: World, number: int) -> None:  # noqa: B027
        """Follow the motion within a control period; called after every step of the simulator.

        Args:
            world: at the end of the step.
            number: of the step within the control period, from 0.
        """

    @abc.abstractmethod
    def evaluate(self, world: World) -> Outcome:
        """Rewards, termination and infos.

        It is also called after resets, of some environments or all, and whenever the task error is read: a second call
        at the same instant must return the same values and change nothing.

        Args:
            world: at the end of a control period.
        """

    def error_unit(self, world: World) -> str:
        """Unit of "task_error"; by default that of positions."""
        return world.fleet.position_unit()

    def robust_reward(self, reward: FloatArray, infos: Mapping[str, FloatArray], limit: float) -> FloatArray:
        """Rewards for training, in which rare large errors don't dominate; by default the rewards as they are.

        Args:
            reward: (B, N) of `evaluate`.
            infos: (B, N) each, of `evaluate`.
            limit: error from which the reward should grow linearly only, in the unit of "task_error".
        """
        return reward

    def signature(self, world: World) -> Signature:
        """Properties, in words, that two tasks must have in common to continue from each other's state."""
        ids = world.fleet.ids
        return {
            "tasks": (self.name,),
            "task edges": tuple(f"{ids[i]} to {ids[j]}" for i, j in self.edges.tolist()),
        }

    def draw(self, canvas: MapCanvas, world: World) -> None:  # noqa: B027
        """Draw on a frame, below the agents; nothing by default. All that is drawn is in view, boxes maybe not.

        Args:
            canvas: in metres.
            world: of one environment.
        """


def directed(graph: nx.Graph) -> IntArray:
    """(E, 2) both directions of each edge of an undirected graph, sorted."""
    return np.array(sorted([*graph.edges, *((j, i) for i, j in graph.edges)]), np.int64).reshape(-1, 2)
