"""Columns of observations and of the global state, for layouts and readouts alike."""

from __future__ import annotations

from collections.abc import Sequence

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
from khop_env.observers import IntArray, Observers
from khop_env.physics import Fleet
from khop_env.simulation import Observe
from khop_env.tasks import Column as TaskColumn
from khop_env.tasks import Task, World
from khop_env.tasks.edges import axis_names

_STATE = {"value": STATE, "cos": STATE_COS, "sin": STATE_SIN}
_ESTIMATE = {"value": ESTIMATE, "cos": ESTIMATE_COS, "sin": ESTIMATE_SIN}


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
        self._most_rest = max(len(features(model)[1]) for model in models)
        self._most_states, self._most_inputs = max(model.n for model in models), max(model.m for model in models)
        start = design.states.delta.evaluate(np.zeros(1), np.empty((design.states.layout.rows, 1)))
        self._largest_bound = max(world.limit, float(start.max(initial=0.0)))

        slots = slots_of(design, task.edges, agents)
        columns = [
            self._own(i) + [column for number, slot in enumerate(its_slots) for column in self._slot(i, number, slot)]
            for i, its_slots in zip(agents, slots, strict=True)
        ]
        if uniform:
            self._require_equal_counts(agents)
            columns = self._padded(columns, [len(its_slots) for its_slots in slots])
        self.layouts = [
            ObservationLayout(self._fleet.ids[i], [column.field for column in its_columns], its_slots)
            for i, its_columns, its_slots in zip(agents, columns, slots, strict=True)
        ]
        self.readout = Readout(
            [column for its_columns in columns for column in its_columns],
            [number for number, its_columns in enumerate(columns) for _ in its_columns],
        )
        self.offset: IntArray = np.concatenate([[0], np.cumsum([len(its_columns) for its_columns in columns])])

    def _own(self, i: int) -> list[Column]:
        model, first = self._fleet.models[i], int(self._fleet.input_offset[i])
        columns = state_columns(self._fleet, i, "own", self._limit)
        columns += self._padding("own", self._most_rest - len(features(model)[1]))
        if self._inputs:
            columns += [
                Column(Field(f"own.input.{name}", "of its limit", -1.0, 1.0), INPUT, first + c)
                for c, name in enumerate(model.inputs)
            ]
            columns += self._padding("own.input", self._most_inputs - model.m)
        columns += self._type("own", model.type)
        return columns + [_from_task("", column) for column in self._task.columns(self._world, i)]

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

    def _slot(self, i: int, number: int, slot: Slot) -> list[Column]:
        fleet, name, model = self._fleet, f"slot{number}", self._fleet.models[slot.agent]
        estimated = self._by_messages or not slot.heard  # otherwise its state is received
        link = gate = -1  # of a neighbour, whose state is received while it is up
        if self._changing and slot.heard and self._observe != "oracle":
            link = self._design.links.index[slot.agent, i]
            if self._observe == "estimate" and (i, slot.agent) in self._layout.slot:
                estimated = True  # without relays; `ReceivedStates` has its state while it is received
            else:
                gate = link
        estimate = estimated and self._observe != "oracle"
        columns = [
            *self._known_columns(i, name, slot, estimate, link, gate),
            _flag(f"{name}.task_edge", slot.task_edge),
            *(self._type(name, model.type) if len(self._types) > 1 else ()),
        ]
        columns += [_from_task(f"{name}.", column) for column in self._task.slot_columns(self._world, i, slot.agent)]
        origin = self._layout.slot[i, slot.agent] if estimate else int(fleet.state_offset[slot.agent])
        position, rest = features(model)
        relative = ESTIMATE_RELATIVE if estimate else STATE_RELATIVE
        columns += [
            Column(
                Field(f"{name}.position.{axis}", feature.unit, -2.0 * self._limit, 2.0 * self._limit),
                relative,
                origin + feature.component,
                int(own),
                gate=gate,
            )
            for axis, feature, own in zip(self._axes, position, fleet.position_index[i], strict=True)
        ]
        columns += [
            _state(name, feature, (_ESTIMATE if estimate else _STATE)[feature.how], origin, self._limit, gate)
            for feature in rest
        ]
        columns += self._padding(name, self._most_rest - len(rest))
        if self._bounds:
            columns += self._bound_columns(i, name, slot, estimated)
        if self._message_size:
            first = int(self._layout.column_pair[self._layout.slot[i, slot.agent]]) * self._message_size
            columns += [
                Column(Field(f"{name}.message.{c}", "", -1.0, 1.0), DATA, first + c) for c in range(self._message_size)
            ]
        if self._observe == "local" and not slot.heard:
            return [Column(column.field) for column in columns]
        return columns

    def _known_columns(self, i: int, name: str, slot: Slot, estimate: bool, link: int, gate: int) -> list[Column]:
        """Whether, when and over how many links something has arrived about the agent: constants without messages,
        but for the `link` from a neighbour that comes and goes, and `gate` where nothing is known while it is down.
        """
        if not self._by_messages:
            valid, heard = _flag(f"{name}.valid", True), _flag(f"{name}.heard", slot.heard)
            hops = Column(Field(f"{name}.hops", "", 0.0, float(self._design.k)), value=float(slot.hops))
            return [
                valid if gate < 0 else Column(valid.field, KNOWN, gate),
                heard if link < 0 else Column(heard.field, KNOWN, link),
                hops,
            ]
        layout, most_hops = self._layout, float(max(self._design.k, len(self._fleet) - 1))  # detours are possible
        pair = int(layout.column_pair[layout.slot[i, slot.agent]])
        valid, *others = (
            Column(Field(f"{name}.{quantity}", unit, 0.0, high), KNOWN, number * layout.pairs + pair)
            for quantity, unit, high, number in (
                ("valid", "", 1.0, VALID),
                ("heard", "", 1.0, HEARD),
                ("hops", "", most_hops, HOPS),
                ("age", "s", self._limit, AGE),
            )
        )
        return [valid if estimate else _flag(f"{name}.valid", True), *others]

    def _bound_columns(self, i: int, name: str, slot: Slot, estimated: bool) -> list[Column]:
        """Bounds in the order of the state: position, then the rest; 0 where the state itself is received."""
        model = self._fleet.models[slot.agent]
        states, position = list(model.states.items()), model.position_index.tolist()
        columns = []
        for component in [*position, *(c for c in range(model.n) if c not in position)]:
            state, unit = states[component]
            field = Field(f"{name}.bound.{state}", unit, 0.0, self._largest_bound)
            if estimated:
                columns.append(Column(field, BOUND, self._layout.slot[i, slot.agent] + component))
            else:
                columns.append(Column(field))
        return columns + self._padding(f"{name}.bound", self._most_states - model.n)

    def _type(self, name: str, kind: str) -> list[Column]:
        return [_flag(f"{name}.type.{known}", known == kind) for known in self._types] if self._uniform else []

    def _padding(self, name: str, count: int) -> list[Column]:
        return [_zero(f"{name}.padding{q}") for q in range(count if self._uniform else 0)]

    def _padded(self, columns: list[list[Column]], slots: list[int]) -> list[list[Column]]:
        """Columns padded to equally many slots for every agent, with common bounds: one Box."""
        width, most = max(map(len, columns)), max(slots)
        padding: dict[tuple[int, int], list[Column]] = {}  # of a slot, by its number and width
        for its_columns, count in zip(columns, slots, strict=True):
            slot_width = (width - len(its_columns)) // max(most - count, 1)
            for number in range(count, most):
                if (number, slot_width) not in padding:
                    name = f"slot{number}"
                    padding[number, slot_width] = [_flag(f"{name}.valid", False), *self._padding(name, slot_width - 1)]
                its_columns += padding[number, slot_width]
        low = np.min([[column.field.low for column in its_columns] for its_columns in columns], axis=0).tolist()
        high = np.max([[column.field.high for column in its_columns] for its_columns in columns], axis=0).tolist()
        return [list(map(_within, its_columns, low, high)) for its_columns in columns]


def state_columns(fleet: Fleet, i: int, name: str, limit: float) -> list[Column]:
    """Agent i's own state: its position, then the rest; angles as cosine and sine."""
    position, rest = features(fleet.models[i])
    origin = int(fleet.state_offset[i])
    return [_state(name, feature, _STATE[feature.how], origin, limit) for feature in [*position, *rest]]


def global_state(fleet: Fleet, limit: float, inputs: bool) -> tuple[list[Field], Readout]:
    """Columns of the true state of all agents, leaders included, in order; with their inputs where these are states."""
    columns = [column for i, name in enumerate(fleet.ids) for column in state_columns(fleet, i, name, limit)]
    if inputs:
        columns += [
            Column(Field(f"{agent}.input.{name}", "of its limit", -1.0, 1.0), INPUT, c)
            for c, (agent, name, _) in enumerate(fleet.input_names())
        ]
    return [column.field for column in columns], Readout(columns, [0] * len(columns))


def _state(name: str, feature: Feature, kind: int, origin: int, limit: float, gate: int = -1) -> Column:
    limit = limit if feature.how == "value" else 1.0
    field = Field(f"{name}.{feature.name}", feature.unit, -limit, limit)
    return Column(field, kind, origin + feature.component, gate=gate)


def _from_task(prefix: str, column: TaskColumn) -> Column:
    field = Field(f"{prefix}{column.name}", column.unit, column.low, column.high)
    return Column(field, value=float(column.value)) if column.row is None else Column(field, TASK, column.row)


def _within(column: Column, low: float, high: float) -> Column:
    """A column of a Box with wider bounds; its values keep to its own."""
    field = column.field
    if field.low == low and field.high == high:
        return column
    return column._replace(field=Field(field.name, field.unit, low, high), clip=column.bounds)


def _flag(name: str, value: bool) -> Column:
    return Column(Field(name, "", 0.0, 1.0), value=float(value))


def _zero(name: str) -> Column:
    return Column(Field(name, "", 0.0, 1.0))  # always 0, but Gymnasium warns of spaces without width
