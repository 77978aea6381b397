"""Columns and fields that agents share: in memory once, however many thousand agents have them."""

from __future__ import annotations

from operator import attrgetter

from khop_env.env.layout import Field
from khop_env.env.readout import Column
from khop_env.physics import Fleet


def kinds(fleet: Fleet) -> list[int]:
    """Per agent the first with the same states, inputs and position."""
    first: dict[tuple[str, ...], int] = {}
    known: dict[int, int] = {}  # by the model's identity, which is found more quickly
    for i, model in enumerate(fleet.models):
        if id(model) not in known:
            known[id(model)] = first.setdefault((model.type, *model.position), i)
    return [known[id(model)] for model in fleet.models]


def alike(columns: list[list[Column]]) -> tuple[list[int], list[tuple[Field, ...]]]:
    """Different sequences of fields, and per agent which of them is its own."""
    numbers: dict[tuple[int, ...], int] = {}
    groups: list[tuple[Field, ...]] = []
    group_of = []
    for its_columns in columns:
        fields = tuple(map(attrgetter("field"), its_columns))
        number = numbers.setdefault(tuple(map(id, fields)), len(groups))
        if number == len(groups):
            groups.append(fields)
        group_of.append(number)
    return group_of, groups


def unify_bounds(columns: list[list[Column]], group_of: list[int], groups: list[tuple[Field, ...]]) -> None:
    """Give columns, and the groups' fields, common bounds for all agents, in place: one Box."""
    low = [float(min(field.low for field in each)) for each in map(set, zip(*groups, strict=True))]
    high = [float(max(field.high for field in each)) for each in map(set, zip(*groups, strict=True))]
    one: dict[Field, Field] = {}
    wider = []  # per group, the places of the fields whose bounds change
    for number, fields in enumerate(groups):
        places = [q for q, field in enumerate(fields) if field[2:] != (low[q], high[q])]
        changed = list(fields)
        for q in places:
            field = Field(*fields[q][:2], low[q], high[q])
            changed[q] = one.setdefault(field, field)
        groups[number] = tuple(changed)
        wider.append(places)
    shared: dict[tuple[int, int], tuple[Column, Column]] = {}  # by place and identity; the old ones are kept alive
    for its_columns, number in zip(columns, group_of, strict=True):
        fields = groups[number]
        for q in wider[number]:
            column = its_columns[q]
            if (q, id(column)) not in shared:  # its values keep to their own bounds
                shared[q, id(column)] = column, column._replace(field=fields[q], clip=column.bounds)
            its_columns[q] = shared[q, id(column)][1]
