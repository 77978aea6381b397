"""The columns of recorded episodes: names, types, units and meanings, and where their numbers come from."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from typing import NamedTuple

import numpy as np

from khop_env.env import BatchedEnv
from khop_env.env.state import SHARED_INFOS


class DataColumn(NamedTuple):
    """A column of a table: its type in Polars, its unit ("" where it has none), and its meaning."""

    dtype: str
    unit: str
    meaning: str


KEYS = {
    "policy": DataColumn("Categorical", "", "that acted, by its name"),
    "observe": DataColumn("Categorical", "", "what the slots of agents out of range hold: estimate, oracle or local"),
    "network": DataColumn("Categorical", "", "over which agents know of each other; none: continuous exchange"),
    "scenario": DataColumn("Categorical", "", "fleet, graphs, bounds and disturbances"),
    "seed": DataColumn("Int64", "", "of the episode"),
    "step": DataColumn("Int32", "", "number of control periods since the reset"),
    "time": DataColumn("Float64", "s", "since the reset"),
}
ESTIMATE_COLUMNS = {
    **KEYS,
    "observer": DataColumn("Categorical", "", "the agent that estimates"),
    "target": DataColumn("Categorical", "", "the agent that is estimated"),
    "component": DataColumn("Categorical", "", "of the target's state"),
    "state": DataColumn("Float64", "of the component", "true value"),
    "estimate": DataColumn("Float64", "of the component", "the observer's"),
    "bound": DataColumn("Float64", "of the component", "guaranteed bound on |estimate - state|; inf: none"),
    "age": DataColumn("Float64", "s", "since the newest state that has arrived was measured; inf: none has arrived"),
    "hops": DataColumn("Int32", "", "links over which it came; without messages the distance in the graph"),
    "heard": DataColumn("Boolean", "", "whether something new has arrived in the last control period"),
    "valid": DataColumn("Boolean", "", "whether anything has arrived since the reset"),
}


def step_columns(env: BatchedEnv) -> dict[str, DataColumn]:
    """The columns of the table of steps, in their order, of one environment."""
    columns = {
        **KEYS,
        "agent": DataColumn("Categorical", "", "its id"),
        "type": DataColumn("Categorical", "", "its model"),
    }
    found = {name: DataColumn(dtype, unit, meaning) for name, dtype, unit, meaning, *_ in quantities(env)}
    for name, dtype, unit, meaning, *_ in quantities(env):
        if unit not in found[name].unit.split(" or "):  # of agents of different models
            found[name] = DataColumn(dtype, f"{found[name].unit} or {unit}", meaning)
    return columns | {name: found[name] for name in _names_by_kind(env)}


def merged(several: Iterable[Sequence[str]]) -> list[str]:
    """All names, each next to those that it stands beside."""
    result: list[str] = []
    known: set[str] = set()
    for names in dict.fromkeys(tuple(names) for names in several):
        if known.issuperset(names):
            continue
        place = 0
        for name in names:
            if name in known:
                place = result.index(name) + 1
            else:
                result.insert(place, name)
                known.add(name)
                place += 1
    return result


def action_names(env: BatchedEnv) -> list[list[str]]:
    """Names of the entries of each acting agent's action; "" where an entry is padding."""
    found, said = [], env.settings.message_size
    for agent, size in zip(env.agents, np.diff(env.action_offset).tolist(), strict=True):
        own = list(env.fleet.models[env.fleet.agent(agent)].inputs)
        padding = [""] * (size - said - len(own))
        found.append([*own, *padding, *(f"message.{c}" for c in range(said))])
    return found


class Quantity(NamedTuple):
    """A number of an agent's step: its column, and where it is in the arrays of an environment.

    Attributes:
        name: of the column.
        dtype: in Polars.
        unit: "" where it has none.
        meaning: of the column.
        agent: index in the fleet.
        source: of the arrays.
        column: in it.
    """

    name: str
    dtype: str
    unit: str
    meaning: str
    agent: int
    source: str
    column: int


def quantities(env: BatchedEnv) -> Iterable[Quantity]:
    """Every number of a step, agent by agent."""
    fleet = env.fleet
    acting = {fleet.agent(agent): number for number, agent in enumerate(env.agents)}
    actions = action_names(env)
    if not env.begun.all():
        env.reset(0)  # tasks needn't be able to evaluate anything before
    infos = [name for name in env.task.evaluate(env.world).infos if name not in SHARED_INFOS]
    for i, model in enumerate(fleet.models):
        for c, (name, unit) in enumerate(model.states.items(), int(fleet.state_offset[i])):
            yield Quantity(f"state.{name}", "Float64", unit, "true state", i, "x", c)
        for c, (name, unit) in enumerate(model.inputs.items(), int(fleet.input_offset[i])):
            yield Quantity(f"input.{name}", "Float64", unit, "in force at the period's end", i, "u", c)
        if i not in acting:
            continue
        number = acting[i]
        for c, name in enumerate(actions[number], int(env.action_offset[number])):
            if name:
                unit = "of its limit" if name in model.inputs else ""
                yield Quantity(f"action.{name}", "Float64", unit, "as the policy chose it", i, "action", c)
        yield Quantity("reward", "Float64", "", "of the period that begins at this step", i, "reward", number)
        for name in infos:
            unit = env.task.error_unit(env.world) if name == "task_error" else ""
            yield Quantity(f"info.{name}", "Float64", unit, "the task's, after the period", i, f"info.{name}", number)
        for c, field in enumerate(env.layouts[number].fields, int(env.observation_offset[number])):
            yield Quantity(f"obs.{field.name}", "Float32", field.unit, "observed at this step", i, "obs", c)
    for i in range(len(fleet)):
        for name in ("terminated", "truncated"):
            yield Quantity(name, "Boolean", "", f"whether the period {name[:-2]}es the episode", i, name, 0)


def _names_by_kind(env: BatchedEnv) -> list[str]:
    """All names, kinds in the order of the table."""
    kinds = ("state.", "action.", "input.", "reward", "terminated", "truncated", "info.", "obs.")
    by: dict[tuple[int, int], list[str]] = {}
    for each in quantities(env):
        kind = next(k for k, beginning in enumerate(kinds) if each.name.startswith(beginning))
        by.setdefault((kind, each.agent), []).append(each.name)
    return [
        name
        for kind in range(len(kinds))
        for name in merged(names for (of, _), names in sorted(by.items()) if of == kind)
    ]
