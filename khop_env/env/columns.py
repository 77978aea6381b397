"""Columns of observations and of the global state, for layouts and readouts alike."""

from __future__ import annotations

from collections.abc import Sequence
from typing import NamedTuple

import numpy as np

from khop_env.env.layout import Feature, Field, ObservationLayout, Slot, features, slots_of
from khop_env.env.readout import (
    AGE,
    BOUND,
    DATA,
    ESTIMATE,
    ESTIMATE_COS,
    ESTIMATE_RELATIVE,
    ESTIMATE_SIN,
    HEARD,
    HOPS,
    INPUT,
    KNOWN,
    STATE,
    STATE_COS,
    STATE_RELATIVE,
    STATE_SIN,
    TASK,
    VALID,
    Column,
    Readout,
)
from khop_env.env.sharing import alike, kinds, unify_bounds
from khop_env.observers import IntArray, Observers
from khop_env.physics import Fleet
from khop_env.simulation import Observe
from khop_env.tasks import Column as TaskColumn
from khop_env.tasks import Task, World
from khop_env.tasks.edges import axis_names

_STATE = {"value": STATE, "cos": STATE_COS, "sin": STATE_SIN}
_ESTIMATE = {"value": ESTIMATE, "cos": ESTIMATE_COS, "sin": ESTIMATE_SIN}


class _SlotFields(NamedTuple):
    """The fields of a slot, by its number and the kind of agent in it: thousands of slots share them.

    Attributes:
        known: valid, heard and hops, and the age under a network.
        flags: whether there is no task edge, or one.
        kind: of agent.
        position: fields and components.
        rest: fields, components, and how these are represented.
        padding: of the rest.
        bounds: fields and components, in the order of the state: position, then the rest.
        bound_padding: of these.
        data: of policies.
    """

    known: list[Field]
    flags: tuple[Column, Column]
    kind: list[Column]
    position: list[tuple[Field, int]]
    rest: list[tuple[Field, int, str]]
    padding: list[Column]
    bounds: list[tuple[Field, int]]
    bound_padding: list[Column]
    data: list[Field]


class ObservationColumns:
    """The observations of the agents that act.

    Args:
        world: fleet and design of the observers.
        observers: where estimates are, and whether they are all that an agent knows of others.
        task: bound to the fleet; its edges order the slots, and it may add columns.
        agents: the agents that observe, by index.
        observe: content of the slots of agents that are estimated: their estimates, their true states, or zeros for
            those that aren't neighbours.
        bounds: whether slots hold the guaranteed bound on the estimate's error.
        uniform: True for the same columns for every agent, padded; False for each agent's own columns.
        inputs: whether an agent observes its input in force, which an actuator may make a state.
        message_size: numbers of policies in messages.

    Attributes:
        layouts: one per agent.
        readout: fills the observations of all agents, side by side.
        offset: (N + 1,) where each agent's columns begin.
    """

    def __init__(
        self,
        world: World,
        observers: Observers,
        task: Task,
        agents: Sequence[int],
        *,
        observe: Observe,
        bounds: bool,
        uniform: bool,
        inputs: bool,
        message_size: int = 0,
    ) -> None:
        design = world.design
        self._world, self._task, self._design, self._fleet, self._observe = world, task, design, design.fleet, observe
        self._layout, self._by_messages = observers.layout, observers.by_messages
        self._changing = design.schedule is not None and not observers.by_messages
        self._bounds, self._uniform, self._limit, self._inputs = bounds, uniform, world.limit, inputs
        self._message_size = message_size
        models = self._fleet.models
        self._types = list(dict.fromkeys(model.type for model in models))
        self._axes = axis_names(self._fleet.position_dim)
        self._kinds = kinds(self._fleet)
        different = set(self._kinds)
        self._features = {kind: features(models[kind]) for kind in different}
        self._most_rest = max(len(rest) for _, rest in self._features.values())
        self._most_states, self._most_inputs = (max(getattr(models[i], size) for i in different) for size in "nm")
        self._slot_fields: dict[tuple[int, int], _SlotFields] = {}
        self._fields: dict[Field, Field] = {}
        start = design.states.delta.evaluate(np.zeros(1), np.empty((design.states.layout.rows, 1)))
        self._largest_bound = max(world.limit, float(start.max(initial=0.0)))

        self._state_offset = self._fleet.state_offset.tolist()
        self._position_index, self._column_pair = self._fleet.position_index.tolist(), self._layout.column_pair.tolist()
        slots = slots_of(design, task.edges, agents)
        columns = [
            self._own(i) + [column for number, slot in enumerate(its_slots) for column in self._slot(i, number, slot)]
            for i, its_slots in zip(agents, slots, strict=True)
        ]
        if uniform:
            self._require_equal_counts(agents)
            self._pad(columns, [len(its_slots) for its_slots in slots])
        group_of, groups = alike(columns)
        if uniform:
            unify_bounds(columns, group_of, groups)
        first = [ObservationLayout(self._fleet.ids[agents[0]], fields, ()) for fields in groups]
        self.layouts = [
            first[group].shared_by(self._fleet.ids[i], its_slots)
            for i, its_slots, group in zip(agents, slots, group_of, strict=True)
        ]
        sizes = [len(its_columns) for its_columns in columns]
        self.readout = Readout(
            [column for its_columns in columns for column in its_columns],
            np.repeat(np.arange(len(sizes)), sizes).tolist(),
        )
        self.offset: IntArray = np.concatenate([[0], np.cumsum(sizes)])

    def _own(self, i: int) -> list[Column]:
        model, first = self._fleet.models[i], int(self._fleet.input_offset[i])
        columns = state_columns(self._fleet, i, "own", self._limit)
        columns += self._padding("own", self._most_rest - len(self._features[self._kinds[i]][1]))
        if self._inputs:
            columns += [
                Column(Field(f"own.input.{name}", "of its limit", -1.0, 1.0), INPUT, first + c)
                for c, name in enumerate(model.inputs)
            ]
            columns += self._padding("own.input", self._most_inputs - model.m)
        columns += self._type("own", model.type)
        columns = [column._replace(field=self._one(column.field)) for column in columns]
        return columns + [self._from_task("", column) for column in self._task.columns(self._world, i)]

    def _one(self, field: Field) -> Field:
        """The same object for equal fields."""
        return self._fields.setdefault(field, field)

    def _require_equal_counts(self, agents: Sequence[int]) -> None:
        """Refuse a task with different numbers of columns for different agents, where observations are uniform."""
        counts = {self._fleet.ids[i]: len(self._task.columns(self._world, i)) for i in agents}
        if len(set(counts.values())) > 1:
            few, many = min(counts, key=counts.__getitem__), max(counts, key=counts.__getitem__)
            raise ValueError(
                f"task {self._task.name!r}: uniform observations need as many columns for every agent, and columns() "
                f"gives {few!r} {counts[few]} and {many!r} {counts[many]}; pad them, or make the environment with "
                "uniform=False"
            )

    def _fields_of(self, number: int, agent: int) -> _SlotFields:
        """The fields of slot `number` with an agent like `agent`."""
        kind = self._kinds[agent]
        if (number, kind) in self._slot_fields:
            return self._slot_fields[number, kind]
        name, model, (position, rest) = f"slot{number}", self._fleet.models[kind], self._features[kind]
        states, places = list(model.states.items()), [feature.component for feature in position]
        most_hops = float(self._design.k)
        if self._by_messages:  # detours are possible
            most_hops = float(max(self._design.k, len(self._fleet) - 1))
        edge = _flag(f"{name}.task_edge", False)
        ranges = (("valid", "", 1.0), ("heard", "", 1.0), ("hops", "", most_hops), ("age", "s", self._limit))
        found = self._slot_fields[number, kind] = _SlotFields(
            [Field(f"{name}.{what}", unit, 0.0, high) for what, unit, high in ranges],
            (edge, edge._replace(value=1.0)),
            self._type(name, model.type) if len(self._types) > 1 else [],
            [
                (
                    Field(f"{name}.position.{axis}", feature.unit, -2.0 * self._limit, 2.0 * self._limit),
                    feature.component,
                )
                for axis, feature in zip(self._axes, position, strict=True)
            ],
            [(_field(name, feature, self._limit), feature.component, feature.how) for feature in rest],
            self._padding(name, self._most_rest - len(rest)),
            [
                (Field(f"{name}.bound.{states[c][0]}", states[c][1], 0.0, self._largest_bound), c)
                for c in [*places, *(c for c in range(model.n) if c not in places)]
            ],
            self._padding(f"{name}.bound", self._most_states - model.n),
            [Field(f"{name}.message.{c}", "", -1.0, 1.0) for c in range(self._message_size)],
        )
        return found

    def _slot(self, i: int, number: int, slot: Slot) -> list[Column]:
        fields = self._fields_of(number, slot.agent)
        estimated = self._by_messages or not slot.heard  # otherwise its state is received
        link = gate = -1  # of a neighbour, whose state is received while it is up
        if self._changing and slot.heard and self._observe != "oracle":
            link = self._design.links.index[slot.agent, i]
            if self._observe == "estimate" and (i, slot.agent) in self._layout.slot:
                estimated = True  # without relays; `ReceivedStates` has its state while it is received
            else:
                gate = link
        estimate = estimated and self._observe != "oracle"
        columns = self._known_columns(i, fields.known, slot, estimate, link, gate)
        columns.append(fields.flags[slot.task_edge])
        columns += fields.kind
        prefix = f"slot{number}."
        columns += [self._from_task(prefix, column) for column in self._task.slot_columns(self._world, i, slot.agent)]
        origin = self._layout.slot[i, slot.agent] if estimate else self._state_offset[slot.agent]
        relative, kinds = (ESTIMATE_RELATIVE, _ESTIMATE) if estimate else (STATE_RELATIVE, _STATE)
        columns += [
            Column(field, relative, origin + component, own, gate=gate)
            for (field, component), own in zip(fields.position, self._position_index[i], strict=True)
        ]
        columns += [Column(field, kinds[how], origin + component, gate=gate) for field, component, how in fields.rest]
        columns += fields.padding
        if self._bounds:  # 0 where the state itself is received
            place = self._layout.slot[i, slot.agent] if estimated else -1
            columns += [
                Column(field, BOUND, place + component) if estimated else Column(field)
                for field, component in fields.bounds
            ]
            columns += fields.bound_padding
        if self._message_size:
            first = self._column_pair[self._layout.slot[i, slot.agent]] * self._message_size
            columns += [Column(field, DATA, first + c) for c, field in enumerate(fields.data)]
        if self._observe == "local" and not slot.heard:
            return [Column(column.field) for column in columns]
        return columns

    def _known_columns(
        self, i: int, fields: list[Field], slot: Slot, estimate: bool, link: int, gate: int
    ) -> list[Column]:
        """Whether, when and over how many links something has arrived about the agent: constants without messages,
        but for the `link` from a neighbour that comes and goes, and `gate` where nothing is known while it is down.
        """
        valid, heard, hops, age = fields
        if not self._by_messages:
            return [
                Column(valid, value=1.0) if gate < 0 else Column(valid, KNOWN, gate),
                Column(heard, value=float(slot.heard)) if link < 0 else Column(heard, KNOWN, link),
                Column(hops, value=float(slot.hops)),
            ]
        pairs = self._layout.pairs
        pair = self._column_pair[self._layout.slot[i, slot.agent]]
        return [
            Column(valid, KNOWN, VALID * pairs + pair) if estimate else Column(valid, value=1.0),
            Column(heard, KNOWN, HEARD * pairs + pair),
            Column(hops, KNOWN, HOPS * pairs + pair),
            Column(age, KNOWN, AGE * pairs + pair),
        ]

    def _type(self, name: str, kind: str) -> list[Column]:
        return [_flag(f"{name}.type.{known}", known == kind) for known in self._types] if self._uniform else []

    def _padding(self, name: str, count: int) -> list[Column]:
        return [_zero(f"{name}.padding{q}") for q in range(count if self._uniform else 0)]

    def _from_task(self, prefix: str, column: TaskColumn) -> Column:
        field = self._one(Field(f"{prefix}{column.name}", column.unit, column.low, column.high))
        return Column(field, value=float(column.value)) if column.row is None else Column(field, TASK, column.row)

    def _pad(self, columns: list[list[Column]], slots: list[int]) -> None:
        """Add columns, up to equally many slots for every agent."""
        width, most = max(map(len, columns)), max(slots)
        padding: dict[tuple[int, int], list[Column]] = {}  # of a slot, by its number and width
        for its_columns, count in zip(columns, slots, strict=True):
            slot_width = (width - len(its_columns)) // max(most - count, 1)
            for number in range(count, most):
                if (number, slot_width) not in padding:
                    name = f"slot{number}"
                    padding[number, slot_width] = [_flag(f"{name}.valid", False), *self._padding(name, slot_width - 1)]
                its_columns += padding[number, slot_width]


def state_columns(fleet: Fleet, i: int, name: str, limit: float) -> list[Column]:
    """Agent i's own state: its position, then the rest; angles as cosine and sine."""
    position, rest = features(fleet.models[i])
    origin = int(fleet.state_offset[i])
    return [
        Column(_field(name, feature, limit), _STATE[feature.how], origin + feature.component)
        for feature in [*position, *rest]
    ]


def global_state(fleet: Fleet, limit: float, inputs: bool) -> tuple[list[Field], Readout]:
    """Columns of the true state of all agents, leaders included, in order; with their inputs where these are states."""
    columns = [column for i, name in enumerate(fleet.ids) for column in state_columns(fleet, i, name, limit)]
    if inputs:
        columns += [
            Column(Field(f"{agent}.input.{name}", "of its limit", -1.0, 1.0), INPUT, c)
            for c, (agent, name, _) in enumerate(fleet.input_names())
        ]
    return [column.field for column in columns], Readout(columns, [0] * len(columns))


def _field(name: str, feature: Feature, limit: float) -> Field:
    limit = limit if feature.how == "value" else 1.0
    return Field(f"{name}.{feature.name}", feature.unit, -limit, limit)


def _flag(name: str, value: bool) -> Column:
    return Column(Field(name, "", 0.0, 1.0), value=float(value))


def _zero(name: str) -> Column:
    return Column(Field(name, "", 0.0, 1.0))  # always 0, but Gymnasium warns of spaces without width
