"""From the simulator's arrays to flat float32 vectors: a table of columns, and the compiled loop that walks it."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from khop_env.compiled import compiled
from khop_env.env.layout import Field, Float32Array
from khop_env.observers import FloatArray, IntArray

# what a column reads: nothing, states, estimates, bounds, inputs
CONSTANT, STATE, STATE_COS, STATE_SIN, STATE_RELATIVE = range(5)
ESTIMATE, ESTIMATE_COS, ESTIMATE_SIN, ESTIMATE_RELATIVE, DELTA, INPUT = range(5, 11)
_TILE = 32  # environments: a column's values of so many are computed before they are written


@dataclass(frozen=True)
class Column:
    """A field and where its value comes from.

    Attributes:
        field: name, unit and bounds.
        kind: CONSTANT, STATE, ...
        a: the row that it reads, of the states, estimates, bounds or inputs.
        b: the row of the states that a relative position is taken from, or -1.
        value: of a constant.
    """

    field: Field
    kind: int = CONSTANT
    a: int = -1
    b: int = -1
    value: float = 0.0


class Readout:
    """Fills (B, columns) vectors; every value lies within its field's bounds.

    Args:
        columns: what each column is.
        owner: per column the number of the agent whose observation it belongs to, for the counts of clipped values.
    """

    def __init__(self, columns: Sequence[Column], owner: Sequence[int]) -> None:
        self.template = np.array([one.value for one in columns], np.float32)
        live = [q for q, one in enumerate(columns) if one.kind != CONSTANT]
        self._table = np.array([[q, columns[q].kind, columns[q].a, columns[q].b, owner[q]] for q in live], np.int64)
        self._table = self._table.reshape(-1, 5)
        self._low = np.array([columns[q].field.low for q in live], np.float32).astype(np.float64)
        self._high = np.array([columns[q].field.high for q in live], np.float32).astype(np.float64)
        self.uses_delta = bool((self._table[:, 1] == DELTA).any())

    def __call__(
        self, x: FloatArray, estimate: FloatArray, delta: FloatArray, u: FloatArray, clipped: IntArray
    ) -> Float32Array:
        """Vectors (B, columns), new memory, of states (n, B), estimates (P, B), bounds (rows, B) and inputs (m, B).

        Adds to `clipped` (B, owners) how many values had to be brought back into their bounds.
        """
        out = np.empty((x.shape[1], len(self.template)), np.float32)
        fill(self._table, self._low, self._high, self.template, x, estimate, delta, u, out, clipped)
        return out


@compiled
def fill(
    table: IntArray,
    low: FloatArray,
    high: FloatArray,
    template: Float32Array,
    x: FloatArray,
    estimate: FloatArray,
    delta: FloatArray,
    u: FloatArray,
    out: Float32Array,
    clipped: IntArray,
) -> None:
    """Write `template` and the columns of `table` into `out` (B, columns); count values out of bounds per owner."""
    values = np.empty(_TILE)
    for first in range(0, out.shape[0], _TILE):
        width = min(_TILE, out.shape[0] - first)
        for e in range(width):
            out[first + e] = template
        for q in range(table.shape[0]):
            column, kind, a, b, owner = table[q, 0], table[q, 1], table[q, 2], table[q, 3], table[q, 4]
            if kind == STATE_RELATIVE:
                for e in range(width):
                    values[e] = x[a, first + e] - x[b, first + e]
            elif kind == ESTIMATE_RELATIVE:
                for e in range(width):
                    values[e] = estimate[a, first + e] - x[b, first + e]
            elif kind == STATE:
                for e in range(width):
                    values[e] = x[a, first + e]
            elif kind == ESTIMATE:
                for e in range(width):
                    values[e] = estimate[a, first + e]
            elif kind == DELTA:
                for e in range(width):
                    values[e] = delta[a, first + e]
            elif kind == INPUT:
                for e in range(width):
                    values[e] = u[a, first + e]
            elif kind == STATE_COS:
                for e in range(width):
                    values[e] = np.cos(x[a, first + e])
            elif kind == STATE_SIN:
                for e in range(width):
                    values[e] = np.sin(x[a, first + e])
            elif kind == ESTIMATE_COS:
                for e in range(width):
                    values[e] = np.cos(estimate[a, first + e])
            else:
                for e in range(width):
                    values[e] = np.sin(estimate[a, first + e])
            outside = 0
            for e in range(width):
                outside += (values[e] < low[q]) | (values[e] > high[q])
            if outside:
                for e in range(width):
                    clipped[first + e, owner] += (values[e] < low[q]) | (values[e] > high[q])
            for e in range(width):
                values[e] = min(max(values[e], low[q]), high[q])
            for e in range(width):
                out[first + e, column] = values[e]
