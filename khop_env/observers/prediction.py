"""The non-stiff part of the state observers: their prediction from the models, f_i(x_hat) + g_hat."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from khop_env.compiled import inlined, place
from khop_env.observers.design import ObserverDesign
from khop_env.observers.layout import FloatArray, IntArray
from khop_env.physics import AgentModel, read_only
from khop_env.physics.right_hand_sides import Runs, drifts


class _DriftRun(NamedTuple):
    """Consecutive targets with equal models whose observers know f_i."""

    model: AgentModel
    columns: slice
    pairs: int


class Prediction:
    """f_i(x_hat) + g_hat of all state observers.

    Args:
        design: the observers, with the options `drift` and `input_observer` of each target.
        num_envs: number of environments B.
    """

    def __init__(self, design: ObserverDesign, num_envs: int) -> None:
        self._num_envs = num_envs
        self._drifts = _drift_runs(design)
        self._inputs = _shared_columns(design)
        predicted = sum(run.columns.stop - run.columns.start for run in self._drifts)
        self._all_drifts_known = predicted == design.states.layout.size
        known = all(run.model.form is not None for run in self._drifts)
        parts = [(run.model, run.pairs, run.columns.start, 0) for run in self._drifts]
        self._runs: tuple[Any, ...] | None = tuple(Runs.of(parts)) if known else None
        inputs = [(states.start, ours.start, states.stop - states.start) for states, ours in self._inputs]
        self._input_runs: IntArray = np.array(inputs, np.int64).reshape(-1, 3).T.ravel()

    def compiled_runs(self) -> tuple[Any, IntArray, bool]:
        """What `rate` adds up, for a compiled loop.

        Returns:
            The fields of `physics.right_hand_sides.Runs` of the estimates with a drift, None where a drift is Python;
            (3 K,) K runs of estimates with an input observer: first rows, the same among the input estimates,
            numbers of rows; and
            whether all estimates have a drift.
        """
        return self._runs, self._input_runs, self._all_drifts_known

    def rate(self, t: FloatArray, estimate: FloatArray, input_estimate: FloatArray, out: FloatArray) -> None:
        """Write f_i(x_hat) + g_hat into `out` (P, B), at times (B,), estimates (P, B) and input estimates (Q, B)."""
        if self._runs is not None:
            known, inputs = self._all_drifts_known, self._input_runs
            predict(self._runs, known, inputs, estimate, input_estimate, out, 0, self._num_envs)
            return
        if not self._all_drifts_known:
            out.fill(0.0)
        times = read_only(t[:, None])
        for model, columns, pairs in self._drifts:
            rates = model.drift(times, read_only(estimate[columns].T.reshape(self._num_envs, pairs, model.n)))
            out[columns] = rates.reshape(self._num_envs, -1).T
        for state_columns, input_columns in self._inputs:
            out[state_columns] += input_estimate[input_columns]


@inlined
def predict(
    runs: Any,
    all_drifts: bool,
    input_runs: IntArray,
    estimate: FloatArray,
    input_estimate: FloatArray,
    out: FloatArray,
    low: int,
    high: int,
) -> None:
    """`Prediction.rate` in the environments low to high - 1, of what `Prediction.compiled_runs` returns."""
    if not all_drifts:
        for row in range(out.shape[0]):
            for e in range(high - low):
                out[row, place(low + e)] = 0.0
    drifts(runs, estimate, out, low, high)
    count = input_runs.size // 3
    for run in range(count):
        to, source = input_runs[run], input_runs[count + run]
        for q in range(input_runs[2 * count + run]):
            for e in range(high - low):
                out[to + q, place(low + e)] += input_estimate[source + q, place(low + e)]


def _drift_runs(design: ObserverDesign) -> list[_DriftRun]:
    """The targets whose observers know f_i, in as few runs as possible."""
    models = design.fleet.models
    runs: list[_DriftRun] = []
    for block in design.states.layout.blocks:
        if not design.options[block.agent].drift:
            continue
        model, columns, pairs = models[block.agent], block.columns, block.observers
        if runs and runs[-1].columns.stop == columns.start and (runs[-1].model is model or runs[-1].model == model):
            last = runs.pop()
            model, columns, pairs = last.model, slice(last.columns.start, columns.stop), last.pairs + pairs
        runs.append(_DriftRun(model, columns, pairs))
    return runs


def _shared_columns(design: ObserverDesign) -> list[tuple[slice, slice]]:
    """Columns of the state estimates and of the input estimates of the same pairs, in as few runs as possible.

    Both layouts list targets ascending and a target's observers in the same order.
    """
    of_states = {block.agent: block.columns for block in design.states.layout.blocks}
    runs: list[tuple[slice, slice]] = []
    for block in design.inputs.layout.blocks:
        states, inputs = of_states[block.agent], block.columns
        if runs and runs[-1][0].stop == states.start and runs[-1][1].stop == inputs.start:
            last_states, last_inputs = runs.pop()
            states, inputs = slice(last_states.start, states.stop), slice(last_inputs.start, inputs.stop)
        runs.append((states, inputs))
    return runs
