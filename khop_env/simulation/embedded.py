"""The error of a step, estimated from its stages, and states inside it.

docs/theory/step.md, "Steps of controlled size", derives both.
"""

from __future__ import annotations

from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from khop_env.compiled import compiled
from khop_env.observers import FloatArray, IntArray
from khop_env.observers.proximal import TABLEAUS

if TYPE_CHECKING:
    from khop_env.observers import PairLayout


class Embedded(NamedTuple):
    """A result of an order less inside a step, whose difference from the step's own estimates the error.

    Attributes:
        explicit: (stages,) weight of each stage's rate in the difference.
        implicit: (stages,) weight of each stage's correction.
        inner: number of the rate in the middle of the step that dense output uses.
        node: its time over the step's.
    """

    explicit: tuple[float, ...]
    implicit: tuple[float, ...]
    inner: int
    node: float


_GAMMA = TABLEAUS[2].nodes[0]
EMBEDDED = {
    2: Embedded((-0.5 / _GAMMA, 0.5 / _GAMMA), (-0.5 / (1 - _GAMMA), 0.5 / (1 - _GAMMA)), inner=1, node=_GAMMA),
    3: Embedded((1.0, 0.0, 3.0, -4.0), (0.0, -6.0, 4.0, 2.0), inner=3, node=0.5),
}
"""By order of the step; docs/theory/step.md derives the weights."""


def by_target(layout: PairLayout, sums: FloatArray) -> FloatArray:
    """(targets, B) maxima of (pairs, B)."""
    return np.maximum.reduceat(sums, layout.arrays.pair, axis=0) if layout.size else np.zeros((0, sums.shape[1]))


@compiled
def along(
    share: FloatArray,
    start: int,
    size: float,
    node: float,
    x: FloatArray,
    rate: FloatArray,
    inner: FloatArray,
    end: FloatArray,
    out: FloatArray,
) -> None:
    """The polynomial through both ends with the rates at the beginning and at the inner node."""
    for c in range(x.shape[0]):
        for k in range(share.size):
            env, s = min(k, x.shape[1] - 1), share[k]
            risen, turned = (end[c, env] - x[c, env]) / size - rate[c, env], inner[c, env] - rate[c, env]
            cubic = (turned - 2.0 * node * risen) / (node * (3.0 * node - 2.0))
            inside = x[c, env] + s * size * (rate[c, env] + s * (risen - cubic + s * cubic))
            out[c, start + k] = end[c, env] if s == 1.0 else inside


@compiled
def largest_error(
    size: float,
    tolerance: float,
    explicit: FloatArray,
    implicit: FloatArray,
    diagonal: float,
    x: FloatArray,
    rates: FloatArray,
    row: IntArray,
    target: IntArray,
    rho: FloatArray,
    sums: FloatArray,
    y: FloatArray,
    predicted: FloatArray,
    slopes: FloatArray,
    input_row: IntArray,
    input_target: IntArray,
    omega: FloatArray,
    input_sums: FloatArray,
    input_y: FloatArray,
    input_slopes: FloatArray,
) -> float:
    """The largest estimated error of a step, of all states and estimates in all environments.

    Args:
        size: of the step in s.
        tolerance: as in `StepControl`.
        explicit: (stages,) of `Embedded`.
        implicit: (stages,) likewise.
        diagonal: the last implicit weight of the step's tableau.
        x: (n, B) states at the end.
        rates: (stages, n, B) x'.
        row: (P,) the funnel of each estimate.
        target: (P,) its target.
        rho: (rows, B) funnels at the end.
        sums: (targets, B) as `by_target` returns them.
        y: (P, B) estimates at the end.
        predicted: (stages, P, B) as in `observers.proximal.Stages`.
        slopes: (stages, P, B) likewise.
        input_row: (Q,) as `row`, of the input estimates; likewise all that follow.
        input_target: (Q,).
        omega: (rows, B).
        input_sums: (targets, B).
        input_y: (Q, B).
        input_slopes: (stages, Q, B).

    Returns:
        Over what is admissible: 1 at most if the step is accepted.
    """
    stages, stiff = explicit.size, 4.0 * diagonal * size
    largest = 0.0
    for env in range(x.shape[1]):
        for c in range(x.shape[0]):
            change = 0.0
            for s in range(stages):
                change += explicit[s] * rates[s, c, env]
            largest = max(largest, abs(change) / (1.0 + abs(x[c, env])))
        for c in range(y.shape[0]):
            change = 0.0
            for s in range(stages):
                change += explicit[s] * predicted[s, c, env] + implicit[s] * slopes[s, c, env]
            width = rho[row[c], env]
            damping = 1.0 + stiff / (width * width * sums[target[c], env])
            largest = max(largest, abs(change) / (damping * (1.0 + abs(y[c, env]))))
        for c in range(input_y.shape[0]):
            change = 0.0
            for s in range(stages):
                change += implicit[s] * input_slopes[s, c, env]
            width = omega[input_row[c], env]
            damping = 1.0 + stiff / (width * width * input_sums[input_target[c], env])
            largest = max(largest, size * abs(change) / (damping * (1.0 + abs(input_y[c, env]))))
    return size * largest / tolerance
