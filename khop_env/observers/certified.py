"""Estimates clipped into their certified boxes, and the bounds that the boxes give."""

from __future__ import annotations

import math

from khop_env.compiled import compiled, place
from khop_env.observers.layout import FloatArray, IntArray

_UP = 1.0 + 1e-9  # rounding


@compiled
def report(
    column: IntArray,
    components: IntArray,
    proposal: IntArray,
    region: FloatArray,
    p: FloatArray,
    r: FloatArray,
    proposed: FloatArray,
    estimate: FloatArray,
    bound: FloatArray,
    first: int,
    end: int,
) -> None:
    """Estimates inside the boxes p +- r, cut to the operating region, and their certified bounds.

    Args:
        column: (pairs,) first column of each pair.
        components: (pairs,) of its target's state.
        proposal: (pairs,) first row of the pair's own estimate in `proposed`; -1 for the box's centre.
        region: (P,) largest |x|, inf where unknown.
        p: (P, B) predictions.
        r: (P, B) their certified errors.
        proposed: (rows, B).
        estimate: (P, B) written.
        bound: (P, B) written: distance to the box's farther face.
        first: first environment.
        end: one past the last.
    """
    for pair in range(column.size):
        own = proposal[pair]
        for c in range(components[pair]):
            q = column[pair] + c
            limit = region[q]
            if own < 0 and limit == math.inf:
                for e in range(end - first):
                    b = place(first + e)
                    estimate[q, b] = p[q, b]
                    bound[q, b] = _UP * r[q, b]
                continue
            for e in range(end - first):
                b = place(first + e)
                radius = _UP * r[q, b]
                low, high = max(p[q, b] - radius, -limit), min(p[q, b] + radius, limit)
                value = proposed[own + c, b] if own >= 0 else 0.5 * (low + high)
                value = min(max(value, low), high) if value == value else min(max(p[q, b], low), high)
                estimate[q, b] = value
                bound[q, b] = max(value - low, high - value)


@compiled
def ages(
    t: FloatArray, stamp: FloatArray, arrived: FloatArray, age: FloatArray, since: FloatArray, first: int, end: int
) -> None:
    """Write the times since what is known was measured and since it arrived, (pairs, B); inf where nothing has.

    In the environments from `first` to `end` - 1; `stamp` is below 0 where nothing has arrived.
    """
    for pair in range(stamp.shape[0]):
        for e in range(end - first):
            b = place(first + e)
            nothing = stamp[pair, b] < 0.0
            age[pair, b] = math.inf if nothing else t[b] - stamp[pair, b]
            since[pair, b] = math.inf if nothing else t[b] - arrived[pair, b]
