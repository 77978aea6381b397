"""Steps of controlled size: the proximal step's error is estimated, and the next step's size follows from it.

docs/theory/step.md, "Steps of controlled size", derives the estimate.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np

from khop_env.compiled import compiled
from khop_env.network.activity import SLACK, BoolArray
from khop_env.observers import FloatArray, IntArray, Proximal, SolveError
from khop_env.observers.proximal import TABLEAUS

if TYPE_CHECKING:
    from khop_env.observers import PairLayout
    from khop_env.simulation.simulator import Simulator

TOLERANCES = (1e-9, 1.0)
"""Smallest and largest tolerance."""

GAMMA = TABLEAUS[2].nodes[0]
_SHORTEST = 1e-7  # s: what changes by more than the tolerance in a step of this length has jumped; it is taken as it is
_MOST_STEPS = 1e8  # between the present and a time to reach
_MOVED = 0.01  # of 1 + |x|, by which states move in the first step that is tried
# The PI controller of E. Hairer and G. Wanner, Solving Ordinary Differential Equations II (1996), IV.2, after
# K. Gustafsson (1991): exponents 0.7 / k and 0.4 / k for an estimate of order k = 2 in the step.
_EXPONENT, _LAST_EXPONENT = 0.35, 0.2
_SAFETY, _LEAST, _MOST = 0.9, 0.2, 5.0  # of the next step's size over this one's: least and most
_SMALLEST_ERROR = 1e-4  # of the tolerance: an error of 0 isn't divided by


class StepCount(NamedTuple):
    """Steps of controlled size.

    Attributes:
        accepted: number of steps that were taken.
        rejected: number of steps that were tried and taken back.
    """

    accepted: int
    rejected: int


def require_tolerance(tolerance: float) -> None:
    """Refuse a tolerance that isn't a number from 1e-9 to 1.

    Raises:
        ValueError: if it isn't.
    """
    low, high = TOLERANCES
    if (
        isinstance(tolerance, bool)
        or not isinstance(tolerance, int | float | np.number)
        or not low <= tolerance <= high
    ):
        raise ValueError(f"tolerance must be a number from {low:g} to {high:g}; got {tolerance!r}")


class StepControl:
    """Advances a simulator by steps whose estimated error is at most a tolerance.

    All environments take the same steps, the largest error decides; so an environment's result depends on the others
    within the tolerance.

    Args:
        simulator: with the proximal step of order 2; all environments at the same time.
        tolerance: largest estimated error of a step, in every state and estimate: `tolerance` (1 + |value|). From 1e-9
            to 1.

    Attributes:
        simulator: as given.
        tolerance: as given.
        last: length of the last accepted step in s.
        before: the state at its beginning.
        accepted: number of steps taken.
        rejected: number of steps taken back.

    Raises:
        ValueError: for other observers, a tolerance out of range, or environments at different times.
    """

    def __init__(self, simulator: Simulator, tolerance: float) -> None:
        require_tolerance(tolerance)
        observers = simulator.observers
        if not isinstance(observers, Proximal) or observers.order != 2:
            raise ValueError(
                f"tolerance: the error is estimated for the proximal step of order 2, not for {observers!r}; build the "
                "simulator with observers=Proximal(2), or give a step"
            )
        times = simulator.state.t
        if times.min() != times.max():
            raise ValueError(
                f"all environments take the same steps of controlled size, and they are at different times, "
                f"{times.min():g} to {times.max():g} s: reset them together, or use `step`"
            )
        self.tolerance, self.last, self.accepted, self.rejected = float(tolerance), 0.0, 0, 0
        self.simulator, self._observers, self.before = simulator, observers, simulator.state.copy()
        design = simulator.design
        self._activity = None if observers.links is None else design.activity()
        self._layouts = design.states.layout, design.inputs.layout
        self._columns = [(each.column_row, each.row_target[each.column_row]) for each in self._layouts]
        ones = np.ones((1, simulator.num_envs))
        self._fixed_sums = [_by_target(each, each.inverse_row_sums[:, None] * ones) for each in self._layouts]
        self._planned, self._last_error = 0.0, 1.0  # the next step's size; 0 before the first step and after a jump

    def warm_up(self) -> None:
        """Compile the estimate; after a step, or `Simulator.warm_up`."""
        self._error(_SHORTEST)

    def require(self, until: float) -> None:
        """Refuse a time that can't be reached.

        Raises:
            ValueError: if it isn't finite, is past, or is too far away for a drift that takes short steps only.
        """
        now, longest = float(self.simulator.state.t[0]), self.simulator.longest_step
        if not now - SLACK <= until < math.inf:
            raise ValueError(f"until must be a finite time since reset, not before now, t = {now:g} s; got {until!r}")
        if until - now > _MOST_STEPS * longest:
            raise ValueError(
                f"until = {until:g} s is too far away: a drift takes steps of {longest:.3g} s at most, and {until - now:g} "
                f"s are more than {_MOST_STEPS:g} of them"
            )

    def run(self, until: float) -> None:
        """Take steps up to `until`; errors as in `step`."""
        t = self.simulator.state.t
        while until - t[0] > 1e-12 * max(1.0, until):
            self.step(until)

    def step(self, until: float) -> None:
        """Take one step, which ends at `until` at the latest.

        Args:
            until: time since reset in s, later than now.

        Raises:
            SolveError: if a number isn't finite, however short the step; the state is that before it.
        """
        state = self.simulator.state
        state.copy_step(self.before)
        links = None if self._activity is None else self._links().copy()
        self._planned = self._planned or self._first_size()
        size, most = self._limited(until), _MOST
        while (smaller := self._tried(size, links, most)) is not None:
            size, most = max(smaller, _SHORTEST), 1.0
            self.rejected += 1
        self.last, self.accepted = size, self.accepted + 1
        self._observers.raise_extremes(state, self.simulator.running_extremes)

    def _tried(self, size: float, links: BoolArray | None, most: float) -> float | None:
        """Try a step; the size of a shorter one where it was taken back, None where it is accepted."""
        state, observers = self.simulator.state, self._observers
        try:
            observers.advance(self.simulator.plant, self.before, state, size)
        except BaseException as failed:
            self.before.copy_step(state)
            if isinstance(failed, SolveError) and size > _SHORTEST:
                return 0.1 * size
            raise
        error, changed = self._error(size), links is not None and not np.array_equal(self._links(), links)
        if size > _SHORTEST and (changed or error > 1.0):
            shorter = size if error <= 1.0 else size * max(_LEAST, _SAFETY / math.sqrt(error))
            if changed:
                assert links is not None
                shorter = min(shorter, size * self._unchanged(size, links))
            self.before.copy_step(state)
            return shorter
        if changed:
            self._planned, self._last_error = 0.0, 1.0
        elif error > 1.0:
            self._planned, self._last_error = size, 1.0
        else:
            error = max(error, _SMALLEST_ERROR)
            factor = _SAFETY * error**-_EXPONENT * self._last_error**_LAST_EXPONENT
            grown = size * min(max(_LEAST, factor), most)
            if size < 0.999 * self._planned and most > 1.0:  # shortened by something else than its error
                self._planned = max(grown, self._planned)
            else:
                self._planned, self._last_error = grown, error
        return None

    def _limited(self, until: float) -> float:
        """The planned size, but no further than `until`, what the drift takes, and the next change of a link."""
        state = self.simulator.state
        now = float(state.t[0])
        left = until - now
        if self._activity is not None:
            ahead = float(self._activity.next_change(state.memory["key"], state.t).min()) - now
            # a step ends just before the change and the next just after it, so that no step has stages on both sides
            left = min(left, ahead - 2.0 * SLACK if ahead > 3.0 * SLACK else ahead)
        size = min(self._planned, self.simulator.longest_step)
        return left if size >= left else min(size, 0.5 * left)

    def _first_size(self) -> float:
        """The step in which no state moves by more than a hundredth of 1 + |x|."""
        state, rates = self.simulator.state, np.empty_like(self.simulator.state.x)
        self.simulator.plant.rate(state, rates)
        speed = float((np.abs(rates) / (1.0 + np.abs(state.x))).max())
        return min(max(_MOVED / max(speed, _MOVED), _SHORTEST), 1.0)

    def _error(self, size: float) -> float:
        """The largest estimated error of the step over what is admissible."""
        state, observers = self.simulator.state, self._observers
        rates, slopes, input_slopes = observers.stages
        arrays: tuple[Any, ...] = (
            state.x,
            *self.simulator.plant.rates,
            *self._columns[0],
            observers.rho.at(state.t),
            self._sums(0),
            state.memory["estimate"],
            *rates,
            *slopes,
            *self._columns[1],
            observers.omega.at(state.t),
            self._sums(1),
            state.memory["input_estimate"],
            *input_slopes,
        )
        return _largest_error(size, self.tolerance, *arrays)

    def _sums(self, kind: int) -> FloatArray:
        """(targets, B) largest [M_i^-1 1]_a of a target's observers."""
        if self._activity is None:
            return self._fixed_sums[kind]
        links = self._observers.links
        assert links is not None
        sums = (links.states, links.inputs)[kind].inverse_row_sums(self._links())
        return _by_target(self._layouts[kind], sums)

    def _links(self) -> BoolArray:
        up = self._observers.links_up(self.simulator.state)
        assert up is not None
        return up

    def _unchanged(self, size: float, links: BoolArray) -> float:
        """The part of a step of which links didn't change, by bisection along its states."""
        before, rates = self.before, self.simulator.plant.rates
        low, high = 0.0, 1.0
        while (high - low) * size > _SHORTEST:
            middle = 0.5 * (low + high)
            x = before.x + middle * size * (rates[0] + (0.5 * middle / GAMMA) * (rates[1] - rates[0]))
            up = self._observers.links_up(replace(before, t=before.t + middle * size, x=x))
            low, high = (middle, high) if up is not None and np.array_equal(up, links) else (low, middle)
        return low


def _by_target(layout: PairLayout, sums: FloatArray) -> FloatArray:
    """(targets, B) maxima of (pairs, B)."""
    return np.maximum.reduceat(sums, layout.arrays.pair, axis=0) if layout.size else np.zeros((0, sums.shape[1]))


@compiled
def _largest_error(
    size: float,
    tolerance: float,
    x: FloatArray,
    rate: FloatArray,
    next_rate: FloatArray,
    row: IntArray,
    target: IntArray,
    rho: FloatArray,
    sums: FloatArray,
    y: FloatArray,
    prediction: FloatArray,
    next_prediction: FloatArray,
    slope: FloatArray,
    next_slope: FloatArray,
    input_row: IntArray,
    input_target: IntArray,
    omega: FloatArray,
    input_sums: FloatArray,
    input_y: FloatArray,
    input_slope: FloatArray,
    next_input_slope: FloatArray,
) -> float:
    explicit, implicit, stiff = 0.5 * size / GAMMA, 0.5 * size / (1.0 - GAMMA), 4.0 * GAMMA * size
    largest = 0.0
    for env in range(x.shape[1]):
        for c in range(x.shape[0]):
            change = explicit * (next_rate[c, env] - rate[c, env])
            largest = max(largest, abs(change) / (1.0 + abs(x[c, env])))
        for c in range(y.shape[0]):
            change = explicit * (next_prediction[c, env] - prediction[c, env])
            change += implicit * (next_slope[c, env] - slope[c, env])
            width, reach = rho[row[c], env], sums[target[c], env]
            damping = 1.0 + stiff / (width * width * reach)
            largest = max(largest, abs(change) / (damping * (1.0 + abs(y[c, env]))))
        for c in range(input_y.shape[0]):
            change = size * implicit * (next_input_slope[c, env] - input_slope[c, env])
            width, reach = omega[input_row[c], env], input_sums[input_target[c], env]
            damping = 1.0 + stiff / (width * width * reach)
            largest = max(largest, abs(change) / (damping * (1.0 + abs(input_y[c, env]))))
    return largest / tolerance
