"""The non-stiff part of the state observers: their prediction from the models, f_i(x_hat) + g_hat."""

from __future__ import annotations

from typing import Any

import numpy as np

from khop_env.compiled import inlined, place
from khop_env.observers.design import ObserverDesign
from khop_env.observers.drifts import Drifts
from khop_env.observers.layout import FloatArray, IntArray
from khop_env.physics.right_hand_sides import drifts


class Prediction:
    """f_i(x_hat) + g_hat of all state observers.

    Args:
        design: the observers, with the options `drift` and `input_observer` of each target.
        num_envs: number of environments B.
    """

    def __init__(self, design: ObserverDesign, num_envs: int) -> None:
        self._num_envs = num_envs
        self._drifts, self._inputs = Drifts.known_in(design, num_envs), _shared_columns(design)
        self._all_drifts_known = all(design.options[i].drift for i in design.states.layout.target.tolist())
        inputs = [(states.start, ours.start, states.stop - states.start) for states, ours in self._inputs]
        self._input_runs: IntArray = np.array(inputs, np.int64).reshape(-1, 3).T.ravel()

    def compiled_runs(self) -> tuple[Any, IntArray, bool]:
        """What `rate` adds up, for a compiled loop.

        Returns:
            The fields of `physics.right_hand_sides.Runs` of the estimates with a drift, None where a drift is Python;
            (3 K,) K runs of estimates with an input observer: first rows, the same among the input estimates,
            numbers of rows; and whether all estimates have a drift.
        """
        runs = None if self._drifts.in_python else self._drifts.runs
        return runs, self._input_runs, self._all_drifts_known

    def rate(self, t: FloatArray, estimate: FloatArray, input_estimate: FloatArray, out: FloatArray) -> None:
        """Write f_i(x_hat) + g_hat into `out` (P, B), at times (B,), estimates (P, B) and input estimates (Q, B)."""
        runs, inputs, known = self.compiled_runs()
        if runs is not None:
            predict(runs, known, inputs, estimate, input_estimate, out, 0, self._num_envs)
            return
        if not known:
            out.fill(0.0)
        self._drifts.evaluate(estimate, t[:, None], out, (0, self._num_envs))
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
