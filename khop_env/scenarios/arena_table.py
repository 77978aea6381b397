"""The [arena] table of scenario files: read and written."""

from __future__ import annotations

import tomlkit
from tomlkit.items import Table

from khop_env.scenarios.checked import CheckedTable
from khop_env.simulation import Arena, Obstacle
from khop_env.simulation.arena import Goals

_Numbers = tuple[float, ...]


def read_arena(table: CheckedTable) -> Arena:
    """A scenario's arena.

    Args:
        table: its [arena].

    Raises:
        ScenarioFileError: for a mistake, which is noted.
    """
    radius, apart = (table.take(key, float, getattr(Arena, key)) for key in ("radius", "apart"))
    goals = table.take("goals", Goals, Arena.goals)
    obstacles = []
    for number, row in enumerate(table.take("obstacles", tuple[_Numbers, ...], ())):
        if len(row) not in (3, 5):
            table.note(
                f"obstacles[{number}]",
                f"got {list(row)}, expected x, y, radius of a disc, or x, y, x, y, half thickness of a wall",
            )
            continue
        with table.built(f"obstacles[{number}]"):
            obstacles.append(Obstacle(row[:2], row[2:4] if len(row) == 5 else None, row[-1]))
    table.finish()
    with table.built():
        return Arena(radius, apart, goals, tuple(obstacles))
    raise AssertionError


def write_arena(arena: Arena) -> Table:
    """The table of an arena."""
    table = tomlkit.table()
    table.add("radius", tomlkit.item(arena.radius).comment("m, of every agent"))
    table.add("apart", tomlkit.item(arena.apart).comment("m, smallest distance between initial positions, and goals"))
    table.add("goals", tomlkit.item(arena.goals).comment("opposite of the initial position, or random"))
    rows = [
        [*each.start, each.radius] if each.start == each.end else [*each.start, *each.end, each.radius]  # type: ignore[misc]
        for each in arena.obstacles
    ]
    text = "".join(f"\n    {row}," for row in rows)
    table.add("obstacles", tomlkit.array(f"[{text}\n]" if rows else "[]"))
    return table
