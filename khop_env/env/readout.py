"""From the simulator's arrays to flat float32 vectors: a table of columns, and the compiled loop that reads it."""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, NamedTuple

import numpy as np

from khop_env.compiled import compiled
from khop_env.env.layout import Field, Float32Array
from khop_env.observers import FloatArray, IntArray

# sources of a column's value: none, states, estimates, their guaranteed bounds, inputs, the task's own rows, what is
# known of the messages that an estimate rests on, and a policy's data in them
CONSTANT, STATE, STATE_COS, STATE_SIN, STATE_RELATIVE = range(5)
ESTIMATE, ESTIMATE_COS, ESTIMATE_SIN, ESTIMATE_RELATIVE, BOUND, INPUT, TASK, KNOWN, DATA = range(5, 14)
# quantities of a column KNOWN, whose row is quantity * pairs + pair
VALID, HEARD, HOPS, AGE = range(4)
_TILE = 32  # number of environments whose values of a column are computed before they are written


class Column(NamedTuple):
    """A field and the source of its value.

    Attributes:
        field: name, unit and bounds.
        kind: CONSTANT, STATE, ...
        row: of the states, estimates, bounds, inputs, task values or known quantities that it reads.
        origin: the row of the states that a relative position is taken from, or -1.
        value: of a constant.
        clip: smallest and largest value, if narrower than the field's: where agents of several types share one space.
        gate: row of the known quantities that the value is multiplied by, or -1.
    """

    field: Field
    kind: int = CONSTANT
    row: int = -1
    origin: int = -1
    value: float = 0.0
    clip: tuple[float, float] | None = None
    gate: int = -1

    @property
    def bounds(self) -> tuple[float, float]:
        """Smallest and largest value."""
        return self.clip or (self.field.low, self.field.high)


class Sources(NamedTuple):
    """The arrays that observations are read from, batch last.

    Attributes:
        x: (n, B) states.
        estimate: (P, B) estimates.
        bound: (P, B) guaranteed bounds on their errors; not read unless `Readout.uses_bounds`.
        inputs: (m, B) inputs in force, as fractions of their limits.
        task: (rows, B) values of the task's live columns.
        known: (4 pairs, B) the quantities that `summarize` writes, of observers that exchange messages; without
            messages (L, B) whether each link is up, where links come and go.
        data: (rows, B) of policies, as it has arrived with messages.
    """

    x: FloatArray
    estimate: FloatArray
    bound: FloatArray
    inputs: FloatArray
    task: FloatArray
    known: FloatArray
    data: FloatArray


class Readout:
    """Fills (B, columns) vectors; every value lies within its field's bounds.

    Args:
        columns: in order.
        owner: per column the number of the agent whose observation it belongs to, for the counts of clipped values.

    Attributes:
        template: (columns,) the constants.
        uses_bounds: whether any column reads guaranteed bounds.
        size: number of columns that aren't constant.
        task_rows: rows of the task's live columns.
    """

    def __init__(self, columns: Sequence[Column], owner: Sequence[int]) -> None:
        self.template = np.array([column.value for column in columns], np.float32)
        live = [q for q, column in enumerate(columns) if column.kind != CONSTANT]
        kinds, rows = [columns[q].kind for q in live], [columns[q].row for q in live]
        # float32 bounds, so that values clipped to them in float64 are inside them as float32, too
        bounds = np.array([columns[q].bounds for q in live], np.float32).reshape(-1, 2).astype(float)
        owners = [owner[q] for q in live]
        origins, gates = ([getattr(columns[q], name) for q in live] for name in ("origin", "gate"))
        self._live = np.array([live, kinds, rows, origins, gates, owners], np.int64)
        self._bounds = np.ascontiguousarray(bounds.T)
        self.uses_bounds, self.size = BOUND in kinds, len(live)
        self.task_rows = 1 + max((row for kind, row in zip(kinds, rows, strict=True) if kind == TASK), default=-1)

    def empty(self, num_envs: int) -> Float32Array:
        """(B, columns) new memory for `write`."""
        return np.empty((num_envs, len(self.template)), np.float32)

    def write(self, sources: Sources, out: Float32Array, clipped: IntArray, low: int, high: int) -> None:
        """Write the vectors of environments `low` to `high` into `out` (B, columns).

        Args:
            sources: of all environments.
            out: overwritten.
            clipped: (B, owners), to which the number of clipped values is added.
            low: first environment.
            high: one past the last.
        """
        fill(self._live, self._bounds, self.template, tuple(sources), out, clipped, low, high)


@compiled
def fill(
    live: IntArray,
    bounds: FloatArray,
    template: Float32Array,
    sources: Any,
    out: Float32Array,
    clipped: IntArray,
    low: int,
    high: int,
) -> None:
    """Write `template` and the live columns, C of them, into `out`; count values out of bounds per owner.

    Args:
        live: (6, C) where each column stands in `out`, then its kind, row, origin, gate and owner, as in `Column`.
        bounds: (2, C) its smallest and largest value.
        template: (columns,) the constants.
        sources: the fields of `Sources` as a plain tuple, which Numba recognises more quickly.
        out: (B, columns) overwritten.
        clipped: (B, owners) added to.
        low: first environment.
        high: one past the last.
    """
    sources = Sources(*sources)
    x, estimate = sources.x, sources.estimate
    values = np.empty(_TILE)
    for first in range(low, high, _TILE):
        width = min(_TILE, high - first)
        for e in range(width):
            out[first + e] = template
        for q in range(live.shape[1]):
            column, kind, row, origin, gate, owner = (
                live[0, q],
                live[1, q],
                live[2, q],
                live[3, q],
                live[4, q],
                live[5, q],
            )
            least, most = bounds[0, q], bounds[1, q]
            if kind == STATE_RELATIVE:
                for e in range(width):
                    values[e] = x[row, first + e] - x[origin, first + e]
            elif kind == ESTIMATE_RELATIVE:
                for e in range(width):
                    values[e] = estimate[row, first + e] - x[origin, first + e]
            elif kind == STATE:
                for e in range(width):
                    values[e] = x[row, first + e]
            elif kind == ESTIMATE:
                for e in range(width):
                    values[e] = estimate[row, first + e]
            elif kind == BOUND:
                for e in range(width):
                    bound = sources.bound[row, first + e]
                    values[e] = bound if bound < np.inf else most  # no bound: the largest value, and nothing clipped
            elif kind == INPUT:
                for e in range(width):
                    values[e] = sources.inputs[row, first + e]
            elif kind == TASK:
                for e in range(width):
                    values[e] = sources.task[row, first + e]
            elif kind == KNOWN:
                for e in range(width):
                    values[e] = sources.known[row, first + e]
            elif kind == DATA:
                for e in range(width):
                    values[e] = sources.data[row, first + e]
            elif kind == STATE_COS:
                for e in range(width):
                    values[e] = np.cos(x[row, first + e])
            elif kind == STATE_SIN:
                for e in range(width):
                    values[e] = np.sin(x[row, first + e])
            elif kind == ESTIMATE_COS:
                for e in range(width):
                    values[e] = np.cos(estimate[row, first + e])
            else:
                for e in range(width):
                    values[e] = np.sin(estimate[row, first + e])
            if gate >= 0:
                for e in range(width):
                    values[e] = values[e] * sources.known[gate, first + e] + 0.0  # no -0.0, whose sign would tell
            outside = 0
            for e in range(width):
                outside += (values[e] < least) | (values[e] > most)
            if outside:
                for e in range(width):
                    clipped[first + e, owner] += (values[e] < least) | (values[e] > most)
            for e in range(width):
                values[e] = min(max(values[e], least), most)
            for e in range(width):
                out[first + e, column] = values[e]


@compiled
def summarize(
    age: FloatArray,
    hops: FloatArray,
    since: FloatArray,
    t: FloatArray,
    out: FloatArray,
    period: float,
    low: int,
    high: int,
) -> None:
    """Write what agents know of the information that their estimates rest on, from `observers.Information`.

    Args:
        age: (pairs, B) time since the newest state that has arrived was measured, in s; inf where none has.
        hops: (pairs, B) links over which it came.
        since: (pairs, B) time since it arrived, in s.
        t: (B,) time since reset in s.
        out: (4 pairs, B) overwritten: VALID, whether anything has arrived; HEARD, whether something newer has within
            the last control period; HOPS; AGE in s, and where nothing has arrived the time since reset.
        period: the control period in s.
        low: first environment.
        high: one past the last.
    """
    pairs = age.shape[0]
    recent = period * (1.0 - 1e-6)  # what arrived with the observation before is a whole period old, but for rounding
    for q in range(pairs):
        for e in range(low, high):
            valid = age[q, e] < np.inf
            out[VALID * pairs + q, e] = valid
            out[HEARD * pairs + q, e] = since[q, e] < recent
            out[HOPS * pairs + q, e] = hops[q, e]
            out[AGE * pairs + q, e] = age[q, e] if valid else t[e]
