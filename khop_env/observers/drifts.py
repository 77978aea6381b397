"""Drifts of many models at once, at estimates in one flat vector, for ranges of environments."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import NamedTuple

import numpy as np

from khop_env.observers.layout import FloatArray, PairLayout
from khop_env.physics import AgentModel, read_only
from khop_env.threads import Range


class Drift(NamedTuple):
    """The drift that is assumed of a target.

    Attributes:
        model: of the target.
        function: of times and states, as `AgentModel.drift`.
        region: the operating region outside which it isn't the model's, as bytes.
    """

    model: AgentModel
    function: Callable[[FloatArray, FloatArray], FloatArray]
    region: bytes = b""


class _Run(NamedTuple):
    """Consecutive targets with equal drifts."""

    drift: Drift
    columns: slice
    pairs: slice
    components: int


class Drifts:
    """Evaluates the drifts of the targets of a layout, one call for consecutive ones that are equal.

    Args:
        layout: of the estimates.
        drifts: of each target; None for none.
        num_envs: number of environments B.

    Attributes:
        divisible: whether ranges of environments may be evaluated one by one, in several threads at once: the library's
            models work element by element, and others may have been written for one caller and a whole batch.
    """

    def __init__(self, layout: PairLayout, drifts: Sequence[Drift | None], num_envs: int) -> None:
        self._all = 0, num_envs
        self._runs: list[_Run] = []
        for block, drift in zip(layout.blocks, drifts, strict=True):
            if drift is None:
                continue
            columns, pairs, last = block.columns, block.pairs, self._runs[-1] if self._runs else None
            if last is not None and last.columns.stop == columns.start and _equal(last.drift, drift):
                self._runs.pop()
                columns, pairs = slice(last.columns.start, columns.stop), slice(last.pairs.start, pairs.stop)
            self._runs.append(_Run(drift, columns, pairs, block.components))
        self.divisible = all(type(run.drift.model).__module__.startswith("khop_env.") for run in self._runs)

    def evaluate(self, p: FloatArray, t: FloatArray, out: FloatArray, part: Range) -> None:
        """Write the drifts at estimates `p` (P, B) into `out` (P, B), in a range of environments.

        Args:
            p: only read.
            t: (width, 1) or (width, pairs) times of the environments in the range.
            out: unchanged where there is no drift.
            part: the range.
        """
        low, high = part
        for drift, columns, pairs, components in self._runs:
            # contiguous, as in a whole batch
            values = p[columns] if part == self._all else np.ascontiguousarray(p[columns, low:high])
            states = read_only(values.T.reshape(high - low, pairs.stop - pairs.start, components))
            times = read_only(t[:] if t.shape[1] == 1 else t[:, pairs])
            out[columns, low:high] = drift.function(times, states).reshape(high - low, -1).T


def _equal(first: Drift, second: Drift) -> bool:
    same = first.model is second.model or first.model == second.model
    return same and first.region == second.region
