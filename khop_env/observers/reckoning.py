"""Dead reckoning of many states at once, with its certified error, in the steps of the simulated plant.

A simulated plant is the difference equation x+ = x + h (f(x) + g + w), so what is certain of it is certain of that. A
prediction p+ = p + h f(p) parts from it by at most r, component by component:

    r+ = min((I + h Lambda) r, r + h spread) + h (g_bar + w_bar)

wherever -h df_j/dx_j <= 1, which `longest_step` keeps (docs/theory/certificates.md, "Sampled systems").
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np

from khop_env.compiled import compiled, place
from khop_env.observers.base import Assumptions
from khop_env.observers.certificate import Certificate
from khop_env.observers.dead_reckoning import extended_drift
from khop_env.observers.design import ObserverDesign
from khop_env.observers.drifts import Drift, Drifts
from khop_env.observers.layout import FloatArray, IntArray, PairLayout
from khop_env.physics import AgentModel
from khop_env.threads import Range

_ROUNDING = 1e-15  # of a state, per step


class Reckoning:
    """Moves predictions and their certified errors by one interval of the simulator's grid.

    Args:
        layout: of the predictions.
        certificates: per agent of the fleet, with its growth, disturbance and region.
        num_envs: number of environments B.

    Attributes:
        longest_step: longest interval, in s.
        divisible: as that of `Drifts`: whether ranges of environments may be moved one by one, in several threads.
    """

    def __init__(self, layout: PairLayout, certificates: Sequence[Certificate], num_envs: int) -> None:
        self._layout = layout
        of_targets = [certificates[i] for i in layout.target.tolist()]
        self.longest_step = min((each.longest_step for each in of_targets), default=math.inf)
        matrices: list[FloatArray] = []
        drifts: list[Drift | None] = []
        for block, certificate in zip(layout.blocks, of_targets, strict=True):
            model, growth, n = certificate.model, certificate.growth, block.components
            matrices.append(np.zeros((n, n)) if growth is None else growth.matrix)
            still = growth is not None and not growth.matrix.any() and not growth.spread.any()
            extended = extended_drift(model, growth)
            function = None if extended == model.drift else extended
            drifts.append(None if still else Drift(model, function, certificate.region.tobytes()))
        self._drifts = Drifts(layout, drifts, num_envs)
        self.divisible = self._drifts.divisible
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

    def advance(self, p: FloatArray, r: FloatArray, t: FloatArray, h: float, part: Range) -> None:
        """Move predictions and errors by one interval, in place.

        Args:
            p: (P, B) predictions; changed.
            r: (P, B) their errors; changed.
            t: (B,) times before, in s.
            h: length of the interval in s.
            part: environments in which to do so.
        """
        low, high = part
        self._h[:, low:high] = h
        self._drifts.evaluate(p, t[low:high, None], self._rate, part)
        move(self._arrays, self._h, self._rate, p, r, low, high)

    def catch_up(self, p: FloatArray, r: FloatArray, t: FloatArray, lag: FloatArray, h: float, part: Range) -> None:
        """Move what is `lag` (pairs, B) seconds old to the times `t` (B,), in intervals of about `h`, as `advance`."""
        low, high = part
        t, lag, length = t[low:high], lag[:, low:high], self._length[:, low:high]
        intervals = np.where(lag > 1e-9 * h, np.maximum(1.0, np.rint(lag / h)), 0.0)
        for number in range(int(intervals.max(initial=0.0))):
            with np.errstate(invalid="ignore", divide="ignore"):
                length[...] = np.where(intervals > number, lag / intervals, 0.0)
            self._drifts.evaluate(p, (t - lag + number * length).T, self._rate, part)
            move(self._arrays, self._length, self._rate, p, r, low, high)

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


def certificates_of(design: ObserverDesign, assumed: Assumptions, noise: float) -> list[Certificate]:
    """Per agent the certificate of a state that it sent; equal ones are one object."""
    made: dict[tuple[AgentModel, bytes, bytes], Certificate] = {}
    found = []
    reach = np.abs(assumed.center) + assumed.radius
    for i, model in enumerate(design.fleet.models):
        part = design.fleet.state_slice(i)
        disturbance = assumed.disturbance[part]
        region = model.operating_region(reach[part], disturbance)
        key = model, disturbance.tobytes(), region.tobytes()
        if key not in made:
            made[key] = Certificate(model, disturbance=disturbance, start=noise, region=region)
        found.append(made[key])
    return found
