"""Certified boxes of many estimates at once: radii by age, estimates clipped into boxes, and their bounds."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from khop_env.compiled import compiled
from khop_env.observers.certificate import Certificate
from khop_env.observers.layout import FloatArray, IntArray, PairLayout
from khop_env.observers.radius import FIRST, KNOTS, OCTAVES, UP

_KNOTS = KNOTS * (OCTAVES + 1)


class CertifiedBoxes:
    """The certificates of all pairs: of what was received, and of the initial set where nothing has been.

    Args:
        layout: the pairs.
        received: per agent of the fleet, the certificate of a state that it sent.
        initial: per agent, that of the centre of its initial set.

    Attributes:
        uncertified: the agents whose state has no bound in some component, by index, and why.
    """

    def __init__(self, layout: PairLayout, received: Sequence[Certificate], initial: Sequence[Certificate]) -> None:
        distinct: dict[int, int] = {}
        kept: list[Certificate] = []
        for certificate in (*received, *initial):
            if id(certificate) not in distinct:
                distinct[id(certificate)] = sum(each.model.n for each in kept)
                kept.append(certificate)
        tables = [each.arrays() for each in kept]
        self._tables: Any = tuple(np.concatenate(parts) for parts in zip(*tables, strict=True)) if tables else ()
        target = layout.pair_target.tolist()
        first = [np.array([distinct[id(each[i])] for i in target], np.int64) for each in (received, initial)]
        arrays = layout.arrays
        per_pair = np.repeat(arrays.column, arrays.observers)
        place = np.arange(layout.pairs) - np.repeat(arrays.pair, arrays.observers)
        components = np.repeat(arrays.components, arrays.observers)
        self._pairs: Any = (per_pair + place * components, components, *first)
        regions = [np.tile(received[block.agent].region, block.observers) for block in layout.blocks]
        self._half_region = np.concatenate([np.zeros(0), *regions])
        self.uncertified = {i: each.reason for i, each in enumerate(received) if each.reason}

    def report(
        self,
        t: FloatArray,
        stamp: FloatArray,
        center: FloatArray,
        proposal: IntArray,
        proposed: FloatArray,
        estimate: FloatArray,
        bound: FloatArray,
    ) -> None:
        """Estimates inside the boxes, and their certified bounds.

        Args:
            t: (B,) now, in s.
            stamp: (pairs, B) when the newest received state was measured, -1 for none.
            center: (P, B) predictions from it.
            proposal: (pairs,) first row of each pair's own estimate in `proposed`; -1 for the box's centre.
            proposed: (rows, B).
            estimate: (P, B) written.
            bound: (P, B) written: distance to the box's farther face.
        """
        if self._tables:
            report(self._tables, self._pairs, t, stamp, center, proposal, proposed, estimate, bound)

    def radii(self, t: FloatArray, stamp: FloatArray, out: FloatArray) -> FloatArray:
        """(P, B) certified radii of states measured at `stamp` (pairs, B), -1 for the initial set."""
        if self._tables:
            radii(self._tables, self._pairs, t, stamp, out)
        return np.minimum(out, self._half_region[:, None], out=out)


@compiled
def _at(tables: Any, row: int, knot: int, s: float, age: float) -> float:
    """`RadiusTable.at`, for one row of the tables."""
    value, bulge, start, slope, lost, _ = tables
    radius = math.inf
    if knot >= 0 and not lost[row]:
        radius = (1.0 - s) * value[row, knot] + s * value[row, knot + 1] + s * (1.0 - s) * bulge[row, knot]
        if radius != radius:
            radius = math.inf
    line = start[row] + (slope[row] * age if age > 0.0 else 0.0)
    return min(radius, line if line == line else math.inf) * UP


@compiled
def _knot(age: float) -> tuple[int, float]:
    """Number of the table's knot before an age, -1 beyond the table, and the share of the way to the next."""
    firsts = age / FIRST
    if firsts < 1.0:
        place, octave = firsts * KNOTS, 0
    elif age < FIRST * 2.0**OCTAVES:
        mantissa, octave = math.frexp(firsts)
        place = (2.0 * mantissa - 1.0) * KNOTS
    else:
        return -1, 0.0
    whole = math.floor(place)
    return int(whole) + KNOTS * octave, place - whole


@compiled
def radii(tables: Any, pairs: Any, t: FloatArray, stamp: FloatArray, out: FloatArray) -> None:
    """Write certified radii (P, B); `tables` and `pairs` as `CertifiedBoxes` keeps them."""
    column, components, received, initial = pairs
    for pair in range(column.size):
        for b in range(t.size):
            heard = stamp[pair, b] >= 0.0
            age = t[b] - stamp[pair, b] if heard else t[b]
            row = received[pair] if heard else initial[pair]
            knot, s = _knot(age)
            for c in range(components[pair]):
                out[column[pair] + c, b] = _at(tables, row + c, knot, s, age)


@compiled
def report(
    tables: Any,
    pairs: Any,
    t: FloatArray,
    stamp: FloatArray,
    center: FloatArray,
    proposal: IntArray,
    proposed: FloatArray,
    estimate: FloatArray,
    bound: FloatArray,
) -> None:
    """See `CertifiedBoxes.report`."""
    column, components, received, _ = pairs
    radii(tables, pairs, t, stamp, bound)
    region = tables[5]
    for pair in range(column.size):
        for c in range(components[pair]):
            q = column[pair] + c
            limit = region[received[pair] + c]
            own = proposal[pair]
            for b in range(t.size):
                p, r = center[q, b], bound[q, b]
                low, high = max(p - r, -limit), min(p + r, limit)
                value = proposed[own + c, b] if own >= 0 else (0.5 * (low + high) if limit < math.inf else p)
                if not abs(value) < math.inf:
                    value = p  # half a box is infinite: the prediction is what is left
                value = min(max(value, low), high)
                estimate[q, b] = value
                bound[q, b] = max(value - low, high - value)
