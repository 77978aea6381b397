"""Schedules of links as tables of a scenario file: reading and writing."""

from __future__ import annotations

import functools
import operator
from dataclasses import fields

import tomlkit
from tomlkit.items import Table

from khop_env.network import SCHEDULES, Schedule
from khop_env.network.schedules import from_table
from khop_env.scenarios.checked import CheckedTable, NotedError


def read_schedule(tables: list[CheckedTable]) -> Schedule | None:
    """The schedule in all [[schedule]] tables, joined; None if there are none.

    Raises:
        NotedError: if a table has a mistake.
    """
    parts: list[Schedule] = []
    for table in tables:
        with table.gathering(), table.built():
            parts.append(from_table({"kind": table.choice("kind", SCHEDULES), **table.rest()}))
    if len(parts) < len(tables):
        raise NotedError
    return functools.reduce(operator.and_, parts) if parts else None


def schedule_table(part: Schedule) -> Table:
    """A schedule as a table of a scenario file.

    Raises:
        ValueError: if it is of the user's own class.
    """
    kinds = [kind for kind, known in SCHEDULES.items() if known is type(part)]
    if not kinds:
        raise ValueError(
            f"the schedule {part!r} can't be written to a file: it isn't one of the library's "
            f"({', '.join(SCHEDULES)}); keep this scenario in Python"
        )
    table = tomlkit.table()
    table.add("kind", kinds[0])
    for field in fields(part):
        value = getattr(part, field.name)
        if field.name in ("graph", "graphs") and value is not None:
            graphs = value if field.name == "graphs" else (value,)
            directed = any(graph.is_directed() for graph in graphs)
            if directed:
                table.add("directed", True)
            edges = [sorted(map(list, (graph.to_directed() if directed else graph).edges)) for graph in graphs]
            lines = edges if field.name == "graphs" else edges[0]
            text = "".join(f"\n    {line}," for line in lines)
            table.add(field.name, tomlkit.array(f"[{text}\n]" if lines else "[]"))
        elif value is not None:
            table.add(field.name, list(value) if isinstance(value, tuple) else value)
    return table
