"""Layout of observations: fields by name, so that no other code depends on the order of columns.

An agent's observation is its own state and one list of slots, a slot for each neighbour and each k-hop target, ordered
by relevance to its task: task edges first, then hop distance, then index.
"""

from __future__ import annotations

import copy
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import NamedTuple

import numpy as np
from numpy.typing import ArrayLike, NDArray

from khop_env.observers import IntArray, ObserverDesign
from khop_env.physics import AgentModel, did_you_mean, hops_from_targets, read_only

Float32Array = NDArray[np.float32]


class Field(NamedTuple):
    """One column of an observation.

    Attributes:
        name: e.g. "own.x", "slot0.valid", "slot0.position.x" or "slot0.bound.x".
        unit: e.g. "m"; "" where it has none.
        low: smallest value.
        high: largest value.
    """

    name: str
    unit: str
    low: float
    high: float


@dataclass(frozen=True, slots=True)
class Slot:
    """Constant properties of another agent within k hops.

    Attributes:
        agent: its index in the fleet.
        id: its id.
        heard: whether it is a neighbour (1 hop), whose state is received; otherwise its state is estimated. Under a
            network neighbours are estimated, too, from their messages.
        hops: distance in the communication graph, from it to the observing agent.
        task_edge: whether the observing agent's task has an edge to it.
    """

    agent: int
    id: str
    heard: bool
    hops: int
    task_edge: bool


class _Columns:
    """Columns that agents with equal observations share in memory."""

    def __init__(self, fields: Sequence[Field]) -> None:
        self.fields = tuple(fields)

    @cached_property
    def names(self) -> tuple[str, ...]:
        return tuple(field.name for field in self.fields)

    @cached_property
    def bounds(self) -> tuple[Float32Array, Float32Array]:
        low, high = (np.array([getattr(field, end) for field in self.fields], np.float32) for end in ("low", "high"))
        return read_only(low), read_only(high)

    @cached_property
    def place(self) -> dict[str, int]:
        return {name: column for column, name in enumerate(self.names)}


class ObservationLayout:
    """Names, units and bounds of every column of one agent's observation.

        layout = env.layout("drifter_0")
        values = layout.read(observation)            # {"own.x1": 0.3, "slot0.valid": 1.0, ...}
        layout.build(values)                         # the same vector again
        layout.index("slot0.position.x")             # its column
        layout.columns("slot0.position")             # its columns, where there are several

    Args:
        agent: the observing agent's id.
        fields: one per column.
        slots: its slots in order; further slots are padding, and all zero.
    """

    def __init__(self, agent: str, fields: Sequence[Field], slots: Sequence[Slot]) -> None:
        self.agent, self.slots = agent, tuple(slots)
        self._columns = _Columns(fields)

    def shared_by(self, agent: str, slots: Sequence[Slot]) -> ObservationLayout:
        """The layout of another `agent` with other `slots` and the same columns, which are in memory once."""
        other = copy.copy(self)
        other.agent, other.slots = agent, tuple(slots)
        return other

    def __repr__(self) -> str:
        return f"ObservationLayout({self.agent!r}, {len(self)} columns, {len(self.slots)} slots)"

    def __len__(self) -> int:
        """Number of columns."""
        return len(self.fields)

    @property
    def fields(self) -> tuple[Field, ...]:
        """One per column."""
        return self._columns.fields

    @property
    def names(self) -> tuple[str, ...]:
        """The fields' names, in order."""
        return self._columns.names

    @property
    def low(self) -> Float32Array:
        """(D,) smallest values, read-only."""
        return self._columns.bounds[0]

    @property
    def high(self) -> Float32Array:
        """(D,) largest values, read-only."""
        return self._columns.bounds[1]

    def index(self, name: str) -> int:
        """The column of a field.

        Raises:
            KeyError: if there is no such field; the message suggests the closest name.
        """
        place = self._columns.place
        if name not in place:
            raise self._unknown(name, self.names)
        return place[name]

    def columns(self, prefix: str) -> NDArray[np.int64]:
        """The columns of a field, or of all fields below it: "slot0.position" has one per axis.

        Raises:
            KeyError: if there is no such field; the message suggests the closest name.
        """
        found = [q for q, name in enumerate(self.names) if name == prefix or name.startswith(prefix + ".")]
        if not found:
            ends = [(name, q) for name in self.names for q, letter in enumerate(name) if letter == "."]
            raise self._unknown(prefix, dict.fromkeys([*(name[:q] for name, q in ends), *self.names]))
        return np.array(found, np.int64)

    def _unknown(self, name: str, known: Iterable[str]) -> KeyError:
        return KeyError(f"{self.agent!r} has no field {name!r}; {did_you_mean(name, known)}")

    def read(self, observation: ArrayLike) -> dict[str, NDArray[np.float32]]:
        """Values by name from observations (..., D); each has shape (...), a number for a single observation.

        Raises:
            ValueError: if the last axis isn't D long.
        """
        values = np.asarray(observation)
        if values.shape[-1:] != (len(self),):
            raise ValueError(f"observations of {self.agent!r} have {len(self)} columns; got shape {values.shape}")
        return {name: values[..., column][()] for column, name in enumerate(self.names)}  # [()]: not arrays of 0 axes

    def build(self, values: Mapping[str, ArrayLike]) -> Float32Array:
        """Observations (..., D) from values by name, which are broadcast against each other.

        Raises:
            KeyError: for missing or unknown names.
        """
        for name in values:
            self.index(name)
        missing = [name for name in self.names if name not in values]
        if missing:
            raise KeyError(f"observations of {self.agent!r} need {len(missing)} more fields, e.g. {missing[0]!r}")
        return np.stack(np.broadcast_arrays(*(np.asarray(values[name], np.float32) for name in self.names)), axis=-1)


@dataclass(frozen=True)
class Feature:
    """Representation of a state component in observations: its value, or the cosine or sine of an angle.

    Attributes:
        name: of the field.
        unit: of the field.
        component: index of the state component.
        how: "value", "cos" or "sin".
    """

    name: str
    unit: str
    component: int
    how: str = "value"


def features(model: AgentModel) -> tuple[list[Feature], list[Feature]]:
    """(position, rest) of a model's state: the position in the order of its axes, then the rest, angles as cos, sin."""
    names, position = list(model.states.items()), model.position_index.tolist()
    rest = []
    for component, (name, unit) in enumerate(names):
        if component in position:
            continue
        if unit == "rad":
            rest += [Feature(f"{name}.{how}", "", component, how) for how in ("cos", "sin")]
        else:
            rest.append(Feature(name, unit, component))
    return [Feature(names[component][0], names[component][1], component) for component in position], rest


def slots_of(design: ObserverDesign, edges: IntArray, agents: Sequence[int]) -> list[list[Slot]]:
    """The slots of each of `agents`: all agents within k hops, in order of relevance.

    Args:
        design: the observers, with the communication graph and k.
        edges: (E, 2) task edges (i, j): agent i's task depends on agent j.
        agents: the observing agents.

    Raises:
        ValueError: for a task edge to an agent more than k hops away.
    """
    hops = hops_from_targets(design.communication, design.k)
    related: list[set[int]] = [set() for _ in range(len(design.fleet))]
    for i, j in edges.tolist():
        related[i].add(j)
        if j not in hops[i]:
            raise ValueError(
                f"{design.fleet.ids[i]!r} has a task edge to {design.fleet.ids[j]!r}, which is more than "
                f"k = {design.k} hops away, so that it isn't estimated"
            )
    return [
        [
            Slot(j, design.fleet.ids[j], hops[i][j] == 1, hops[i][j], j in related[i])
            for j in sorted((j for j in hops[i] if j != i), key=lambda j: (j not in related[i], hops[i][j], j))
        ]
        for i in agents
    ]
