"""Drifts of many models at once, at estimates in one flat vector, for ranges of environments."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from typing import Any, NamedTuple

import numpy as np

from khop_env.observers.design import ObserverDesign
from khop_env.observers.layout import FloatArray, PairLayout
from khop_env.physics import AgentModel, read_only
from khop_env.physics.right_hand_sides import Runs, drifts
from khop_env.threads import Range


class Drift(NamedTuple):
    """The drift that is assumed of a target.

    Attributes:
        model: of the target.
        function: of times and states, as `AgentModel.drift`; None for the model's own.
        region: the operating region outside which it isn't the model's, as bytes.
    """

    model: AgentModel
    function: Callable[[FloatArray, FloatArray], FloatArray] | None = None
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
            models work element by element; others may have been written for one caller and a whole batch.
        runs: the compiled ones, the fields of `physics.right_hand_sides.Runs`.
        in_python: the others.
    """

    def __init__(self, layout: PairLayout, drifts: Sequence[Drift | None], num_envs: int) -> None:
        self._all = 0, num_envs
        runs: list[_Run] = []
        for block, drift in zip(layout.blocks, drifts, strict=True):
            if drift is None:
                continue
            columns, pairs, last = block.columns, block.pairs, runs[-1] if runs else None
            if last is not None and last.columns.stop == columns.start and _equal(last.drift, drift):
                runs.pop()
                columns, pairs = slice(last.columns.start, columns.stop), slice(last.pairs.start, pairs.stop)
            runs.append(_Run(drift, columns, pairs, block.components))
        self.divisible = all(run.drift.model.form is not None for run in runs)
        parts, self.in_python = list[tuple[AgentModel, int, int, int]](), list[_Run]()
        for run in runs:
            if run.drift.function is None and run.drift.model.form is not None:
                parts.append((run.drift.model, run.pairs.stop - run.pairs.start, run.columns.start, 0))
            else:
                self.in_python.append(run)
        self.runs: tuple[Any, ...] = tuple(Runs.of(parts))

    @classmethod
    def known_in(cls, design: ObserverDesign, num_envs: int) -> Drifts:
        """The models' drifts at the estimates of state observers that know them."""
        layout, models = design.states.layout, design.fleet.models
        known = [Drift(models[i]) if design.options[i].drift else None for i in layout.target.tolist()]
        return cls(layout, known, num_envs)

    def evaluate(self, p: FloatArray, t: FloatArray, out: FloatArray, part: Range) -> None:
        """Write the drifts at estimates `p` (P, B) into `out` (P, B), in a range of environments.

        Args:
            p: only read.
            t: (width, 1) or (width, pairs) times of the environments in the range.
            out: unchanged where there is no drift.
            part: the range.
        """
        low, high = part
        drifts(self.runs, p, out, low, high)
        for (model, function, _), columns, pairs, components in self.in_python:
            values = p[columns] if part == self._all else np.ascontiguousarray(p[columns, low:high])
            states = read_only(values.T.reshape(high - low, pairs.stop - pairs.start, components))
            times = read_only(t[:] if t.shape[1] == 1 else t[:, pairs])
            out[columns, low:high] = (function or model.drift)(times, states).reshape(high - low, -1).T


def _equal(first: Drift, second: Drift) -> bool:
    same = first.model is second.model or first.model == second.model
    return same and first.region == second.region
