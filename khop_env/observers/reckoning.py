"""Dead reckoning of many states at once, with its certified error, in the steps of the simulated plant.

A simulated plant is the difference equation x+ = x + h (f(x) + g + w), so what is certain of it is certain of that. A
prediction p+ = p + h f(p) parts from it by at most r, component by component:

    r+ = min((I + h Lambda) r, r + h spread) + h (g_bar + w_bar)

wherever -h df_j/dx_j <= 1, which `longest_step` keeps (docs/theory/certificates.md, "Sampled systems").
"""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from khop_env.compiled import compiled, place
from khop_env.observers.certificate import Certificate
from khop_env.observers.dead_reckoning import extended_drift
from khop_env.observers.layout import FloatArray, IntArray, PairLayout
from khop_env.physics import AgentModel, read_only
from khop_env.threads import Range

_ROUNDING = 1e-15  # of a state, per step


class _Run(NamedTuple):
    """Consecutive targets with equal models that drift."""

    drift: Callable[[FloatArray, FloatArray], FloatArray]
    columns: slice
    pairs: slice
    components: int


class Reckoning:
    """Moves predictions and their certified errors by one interval of the simulator's grid.

    Args:
        layout: of the predictions.
        certificates: per agent of the fleet, with its growth, disturbance and region.
        num_envs: number of environments B.

    Attributes:
        longest_step: longest interval, in s.
    """

    def __init__(self, layout: PairLayout, certificates: Sequence[Certificate], num_envs: int) -> None:
        self._num_envs, self._layout = num_envs, layout
        of_targets = [certificates[i] for i in layout.target.tolist()]
        self.longest_step = min((each.longest_step for each in of_targets), default=math.inf)
        self._runs: list[_Run] = []
        last: tuple[AgentModel, bytes] | None = None
        matrices: list[FloatArray] = []
        for block, certificate in zip(layout.blocks, of_targets, strict=True):
            model, growth, n = certificate.model, certificate.growth, block.components
            region = certificate.region.tobytes()
            matrices.append(np.zeros((n, n)) if growth is None else growth.matrix)
            if growth is not None and not growth.matrix.any() and not growth.spread.any():
                continue
            columns, pairs = block.columns, block.pairs
            if last == (model, region) and self._runs[-1].columns.stop == columns.start:
                first = self._runs.pop()
                columns, pairs = slice(first.columns.start, columns.stop), slice(first.pairs.start, pairs.stop)
            self._runs.append(_Run(extended_drift(model, growth), columns, pairs, n))
            last = model, region
        nothing = [np.zeros(0)]
        arrays = layout.arrays
        self._arrays: Any = (
            arrays.observers,
            arrays.components,
            arrays.column,
            arrays.pair,
            arrays.row,
            np.cumsum([0, *(m.size for m in matrices)])[:-1],
            np.concatenate([*nothing, *(m.ravel() for m in matrices)]),
            np.concatenate(
                [*nothing, *(np.zeros(c.model.n) if c.growth is None else c.growth.spread for c in of_targets)]
            ),
            np.concatenate(
                [*nothing, *(np.full(c.model.n, math.inf) if c.growth is None else c.rate for c in of_targets)]
            ),
        )
        self._rate = np.zeros((layout.size, num_envs))
        self._length, self._h = np.zeros((layout.pairs, num_envs)), np.zeros((1, num_envs))
        self._all = 0, num_envs

    def rates(self, p: FloatArray, t: FloatArray) -> None:
        """Evaluate the drifts at the predictions `p` (P, B) and times `t` (B,), for the next `advance`."""
        self._drift(p, t[:, None])

    def advance(self, p: FloatArray, r: FloatArray, h: float, part: Range | None = None) -> None:
        """Move predictions `p` (P, B) and errors `r` (P, B) by `h` seconds, in place, at the rates of `rates`.

        Args:
            p: changed.
            r: changed.
            h: in s.
            part: environments in which to do so; all by default.
        """
        first, end = part or self._all
        self._h[:, first:end] = h
        move(self._arrays, self._h, self._rate, p, r, first, end)

    def catch_up(self, p: FloatArray, r: FloatArray, t: FloatArray, lag: FloatArray, h: float) -> None:
        """Move what is `lag` (pairs, B) seconds old to the times `t` (B,), in intervals of about `h`, as `advance`."""
        intervals = np.where(lag > 1e-9 * h, np.maximum(1.0, np.rint(lag / h)), 0.0)
        for number in range(int(intervals.max(initial=0.0))):
            with np.errstate(invalid="ignore", divide="ignore"):
                self._length[...] = np.where(intervals > number, lag / intervals, 0.0)
            self._drift(p, (t - lag + number * self._length).T)
            move(self._arrays, self._length, self._rate, p, r, *self._all)

    def radii(self, steps: IntArray, start: FloatArray, h: float) -> FloatArray:
        """(P, B) certified errors `steps` (pairs, B) intervals of `h` seconds after errors `start` (P,)."""
        steps = steps[self._layout.column_pair]
        r = start[:, None].copy()
        out = np.broadcast_to(r, steps.shape).copy()
        zero, length = np.zeros_like(r), np.full((self._layout.pairs, 1), h)
        for number in range(int(steps.max(initial=0))):
            move(self._arrays, length, zero, zero, r, 0, 1)
            np.copyto(out, r, where=steps == number + 1)
        return out

    def _drift(self, p: FloatArray, t: FloatArray) -> None:
        """Evaluate the drifts at the times `t`, (B, 1) or (B, pairs)."""
        for run in self._runs:
            count = run.pairs.stop - run.pairs.start
            states = read_only(p[run.columns].T.reshape(self._num_envs, count, run.components))
            times = read_only(t[:] if t.shape[1] == 1 else t[:, run.pairs])
            self._rate[run.columns] = run.drift(times, states).reshape(self._num_envs, -1).T


@compiled
def move(arrays: Any, length: FloatArray, rate: FloatArray, p: FloatArray, r: FloatArray, first: int, end: int) -> None:
    """Move predictions, p += h rate, and certified errors r, in the environments from `first` to `end` - 1.

    `length` is h, 0 where nothing moves: (pairs, B), or (1, B) for all pairs alike.
    """
    observers, components, columns, pairs, rows, starts, matrix, spread, pushed = arrays
    width, alike = end - first, length.shape[0] == 1
    most = 1
    for i in range(components.size):
        most = max(most, components[i])
    before, growing = np.empty((most, width)), np.empty(width)
    for i in range(observers.size):
        n = components[i]
        for a in range(observers[i]):
            column, of_length = columns[i] + a * n, 0 if alike else pairs[i] + a
            for c in range(n):
                for e in range(width):
                    before[c, e] = r[column + c, place(first + e)]
            for c in range(n):
                q, row = column + c, rows[i] + c
                most_apart, c_bar = spread[row], pushed[row]
                for e in range(width):
                    growing[e] = 0.0
                for k in range(n):
                    slope = matrix[starts[i] + c * n + k]
                    if slope != 0.0:
                        for e in range(width):
                            growing[e] += slope * before[k, e]
                for e in range(width):
                    b = place(first + e)
                    h = length[of_length, b]
                    wider = h * (min(growing[e], most_apart) + c_bar) + _ROUNDING * abs(p[q, b])
                    r[q, b] = before[c, e] + (wider if h > 0.0 and before[c, e] < math.inf else 0.0)
                    p[q, b] += h * rate[q, b]
