"""Dead reckoning of many estimates at once, grid interval by grid interval."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from khop_env.observers.dead_reckoning import LONGEST_STEP, extended_drift
from khop_env.observers.layout import FloatArray, PairLayout
from khop_env.physics import AgentModel, Growth, read_only


class _Run(NamedTuple):
    """Consecutive targets with equal models."""

    drift: Callable[[FloatArray, FloatArray], FloatArray]
    longest: float
    columns: slice
    pairs: slice
    components: int


class Reckoning:
    """Moves predicted states p' = f_i(p) by one classical Runge-Kutta step of order 4 per interval.

    Intervals that are longer than a model's `Growth.step` are divided. Models that don't drift aren't moved.

    Args:
        layout: of the predictions.
        models: one per agent of the fleet.
        growths: likewise, None where a model declares none.
        num_envs: number of environments B.
    """

    def __init__(
        self, layout: PairLayout, models: Sequence[AgentModel], growths: Sequence[Growth | None], num_envs: int
    ) -> None:
        self._num_envs, self._pair = num_envs, layout.column_pair
        self._runs: list[_Run] = []
        last: tuple[AgentModel, Growth | None] | None = None
        for block in layout.blocks:
            model, growth = models[block.agent], growths[block.agent]
            if growth is not None and not growth.matrix.any() and not growth.spread.any():
                continue
            columns, pairs = block.columns, block.pairs
            adjacent = bool(self._runs) and self._runs[-1].columns.stop == columns.start
            if adjacent and last is not None and last[0] == model and last[1] is growth:
                first = self._runs.pop()
                columns, pairs = slice(first.columns.start, columns.stop), slice(first.pairs.start, pairs.stop)
            longest = LONGEST_STEP if growth is None else growth.step
            self._runs.append(_Run(extended_drift(model, growth), longest, columns, pairs, block.components))
            last = model, growth

    @property
    def moves(self) -> bool:
        """Whether any prediction moves."""
        return bool(self._runs)

    def advance(self, p: FloatArray, t: FloatArray, h: float) -> None:
        """Move all predictions `p` (P, B) from the times `t` (B,) by `h` seconds, in place."""
        for run in self._runs:
            steps = max(1, math.ceil(h / run.longest - 1e-9))
            for k in range(steps):
                self._step(run, p, t[:, None] + k * (h / steps), np.array(h / steps))

    def catch_up(self, p: FloatArray, t: FloatArray, lag: FloatArray, h: float) -> None:
        """Move predictions that are `lag` (pairs, B) seconds old to the times `t` (B,), in intervals of about `h`.

        Args:
            p: (P, B) changed where `lag` is positive.
            t: (B,) in s.
            lag: (pairs, B) in s, 0 for predictions that are of now.
            h: the interval between grid times in s.
        """
        for run in self._runs:
            behind = lag[run.pairs]
            intervals = np.where(behind > 0.0, np.maximum(1.0, np.rint(behind / h)), 0.0)
            most, steps = int(intervals.max(initial=0.0)), max(1, math.ceil(h / run.longest - 1e-9))
            for number in range(most):
                with np.errstate(invalid="ignore"):
                    length = np.where(intervals > number, behind / intervals, 0.0)
                start = t - behind + number * length
                for k in range(steps):
                    part = length / steps
                    self._step(run, p, (start + k * part).T, np.repeat(part, run.components, axis=0))

    def _step(self, run: _Run, p: FloatArray, t: FloatArray, h: FloatArray) -> None:
        """One step of a run's predictions; `t` (B, 1) or (B, pairs), `h` () or (columns, B)."""
        x = p[run.columns]
        count = run.pairs.stop - run.pairs.start
        middle = t + 0.5 * h.T if h.ndim == 0 else t + 0.5 * h[:: run.components].T
        end = t + h if h.ndim == 0 else t + h[:: run.components].T

        def rate(t: FloatArray, x: FloatArray) -> FloatArray:
            states = read_only(x.T.reshape(self._num_envs, count, run.components))
            return np.asarray(run.drift(read_only(t[:]), states).reshape(self._num_envs, -1).T)

        k1 = rate(t, x)
        half = 0.5 * h
        k2 = rate(middle, x + half * k1)
        k3 = rate(middle, x + half * k2)
        k4 = rate(end, x + h * k3)
        total = k2 + k3
        total *= 2.0
        total += k1
        total += k4
        total *= h / 6.0
        x += total
