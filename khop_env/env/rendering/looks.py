"""Looks of agents and edges in rendered frames: colours, shapes, short names."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from khop_env.observers import FloatArray, IntArray
from khop_env.physics import AgentModel, Fleet

# M. Okabe and K. Ito, Color Universal Design, 2008: distinct for colour-blind readers, too; without yellow (too pale)
# and with reddish purple reserved for task edges
COLORS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#56B4E9", "#000000")
TASK_COLOR = "#CC79A7"
EDGE_COLOR = "#6A6A6A"  # darker than task edges also where pink looks grey
LEADER_COLOR = "#F0E442"
ALARM_COLOR = "#D55E00"
INK, SOFT, PALE = "#222222", "#666666", "#ECECEC"

TRAIL = 2.0  # s

CIRCLE = np.stack([np.cos(np.arange(48) * np.pi / 24), np.sin(np.arange(48) * np.pi / 24)], axis=-1)


def _regular(corners: int) -> FloatArray:
    turns = np.arange(corners) * 2.0 * np.pi / corners
    return np.stack([np.cos(turns), np.sin(turns)], axis=-1)


_SHAPES = {  # corners for a radius of about one, heading along the first axis
    "circle": _regular(32),
    "square": 0.88 * np.array([[1, 1], [-1, 1], [-1, -1], [1, -1]]),
    "arrow": np.array([[1.4, 0], [-0.95, 0.9], [-0.5, 0], [-0.95, -0.9]]),
    "ship": np.array([[1.6, 0], [0.6, 0.75], [-1.1, 0.75], [-1.1, -0.75], [0.6, -0.75]]),
    "diamond": 1.25 * _regular(4),
    "triangle": 1.3 * _regular(3)[:, ::-1],
    "hexagon": 1.1 * _regular(6),
}
_USUAL_SHAPE = {"integrator": "circle", "drifter": "circle", "cart": "square", "unicycle": "arrow", "vessel": "ship"}
_POINTED, _ROUND = ("arrow", "ship", "triangle"), ("diamond", "triangle", "hexagon", "square", "circle")
_FAR = 1e9  # m: a state that ran further away, or isn't finite, isn't drawn


@dataclass(frozen=True)
class Look:
    """How the agents of one type are drawn.

    Attributes:
        color: "#RRGGBB".
        outline: (K, 2) corners of the marker, heading along the first axis, for a radius of one.
    """

    color: str
    outline: FloatArray


def looks(models: Sequence[AgentModel]) -> dict[str, Look]:
    """A colour and a shape for each type, no two alike while there are any left; agents with a heading are pointed."""
    free = list(_SHAPES)
    found: dict[str, Look] = {}
    for model in models:
        if model.type in found:
            continue
        fitting = [_USUAL_SHAPE.get(model.type), *(_POINTED if "heading" in model.states else _ROUND), *_SHAPES]
        shape = next(name for name in fitting if name in free)
        free = [name for name in free if name != shape] or list(_SHAPES)
        found[model.type] = Look(COLORS[len(found) % len(COLORS)], _SHAPES[shape])
    return found


def short_names(fleet: Fleet) -> list[str]:
    """Per agent the first letters of its type, as many as distinguish the types, and its number."""
    kinds = list(dict.fromkeys(model.type for model in fleet.models))
    length = next(n for n in range(len(max(kinds, key=len)) + 1) if len({kind[:n] for kind in kinds}) == len(kinds))
    return [model.type[:length] + name.rpartition("_")[2] for model, name in zip(fleet.models, fleet.ids, strict=True)]


def mix(color: str, share: float) -> tuple[int, int, int]:
    """A share of a colour "#RRGGBB" in white."""
    red, green, blue = (round(255 + share * (int(color[k : k + 2], 16) - 255)) for k in (1, 3, 5))
    return red, green, blue


def undirected(edges: IntArray) -> list[tuple[int, int]]:
    """Each undirected pair of (E, 2) edges once."""
    return sorted({(min(i, j), max(i, j)) for i, j in edges.tolist() if i != j})


def headings(fleet: Fleet) -> IntArray:
    """(N,) index of each agent's heading in the fleet's state; -1 for agents without a heading."""
    offsets = fleet.state_offset[:-1].tolist()
    return np.array(
        [
            offset + list(model.states).index("heading") if "heading" in model.states else -1
            for offset, model in zip(offsets, fleet.models, strict=True)
        ]
    )


def sensible(positions: FloatArray) -> FloatArray:
    """(K, d) positions, nan where they are not finite or further away than can be drawn."""
    with np.errstate(invalid="ignore"):
        near = np.all(np.abs(positions) < _FAR, axis=-1, keepdims=True)
    return np.where(near, positions, np.nan)


def angles(columns: Sequence[int] | IntArray, values: FloatArray) -> FloatArray:
    """(K,) `values` at the columns, and 0 where the column is -1 or the value isn't finite."""
    columns = np.asarray(columns, int)
    chosen = values[np.maximum(columns, 0)] if columns.size else np.zeros(0)
    return np.where((columns >= 0) & np.isfinite(chosen), chosen, 0.0)
