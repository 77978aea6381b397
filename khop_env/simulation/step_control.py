"""Steps of controlled size: the proximal step's error is estimated, and the next step's size follows from it.

docs/theory/step.md, "Steps of controlled size", derives the estimate.
"""

from __future__ import annotations

import math
from dataclasses import replace
from typing import TYPE_CHECKING, NamedTuple

import numpy as np

from khop_env.network.activity import SLACK, BoolArray
from khop_env.observers import FloatArray, Proximal, SolveError
from khop_env.observers.proximal import TABLEAUS
from khop_env.simulation.embedded import EMBEDDED, along, by_target, largest_error

if TYPE_CHECKING:
    from khop_env.simulation.simulator import Simulator

TOLERANCES = (1e-9, 1.0)
"""Smallest and largest tolerance."""

_SHORTEST = 1e-7  # s: what changes by more than the tolerance in a step of this length has jumped; it is taken as it is
_MOST_STEPS = 1e8  # between the present and a time to reach
_MOVED = 0.01  # of 1 + |x|, by which states move in the first step that is tried
# The PI controller of E. Hairer and G. Wanner, Solving Ordinary Differential Equations II (1996), IV.2, after
# K. Gustafsson (1991): exponents 0.7 / k and 0.4 / k for an estimate that is of order k in the step.
_EXPONENT, _LAST_EXPONENT = 0.7, 0.4
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
        simulator: with the proximal step of order 2 or 3; all environments at the same time.
        tolerance: largest estimated error of a step, in every state and estimate: `tolerance` (1 + |value|). From 1e-9
            to 1.

    Attributes:
        simulator: as given.
        tolerance: as given.
        embedded: of the step's order.
        last: length of the last accepted step in s.
        accepted: number of steps taken.
        rejected: number of steps taken back.

    Raises:
        ValueError: for other observers, a tolerance out of range, or environments at different times.
    """

    def __init__(self, simulator: Simulator, tolerance: float) -> None:
        require_tolerance(tolerance)
        observers = simulator.observers
        if not isinstance(observers, Proximal) or observers.order not in EMBEDDED:
            raise ValueError(
                f"tolerance: the error is estimated for the proximal step of order 2 or 3, not for {observers!r}; "
                "build the simulator with observers=Proximal(3), or give a step"
            )
        times = simulator.state.t
        if times.min() != times.max():
            raise ValueError(
                f"all environments take the same steps of controlled size, and they are at different times, "
                f"{times.min():g} to {times.max():g} s: reset them together, or use `step`"
            )
        self.tolerance, self.last, self.accepted, self.rejected = float(tolerance), 0.0, 0, 0
        self.simulator, self._observers, self.embedded = simulator, observers, EMBEDDED[observers.order]
        self._before = simulator.before
        diagonal = TABLEAUS[observers.order].implicit[-1][-1]
        self._weights = np.array(self.embedded.explicit), np.array(self.embedded.implicit), diagonal
        design = simulator.design
        self._activity = None if observers.links is None else design.activity()
        self._layouts = design.states.layout, design.inputs.layout
        self._columns = [(each.column_row, each.row_target[each.column_row]) for each in self._layouts]
        ones = np.ones((1, simulator.num_envs))
        self._fixed_sums = [by_target(each, each.inverse_row_sums[:, None] * ones) for each in self._layouts]
        self._planned = 0.0  # the next size; 0 for the shortest, at the start and after a jump
        self._last_error = 1.0

    def warm_up(self) -> None:
        """Compile what a step needs beside `Simulator.warm_up`."""
        self._error(_SHORTEST)
        self.states_at(np.zeros(0), _SHORTEST, 0, self._before.x)

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
                f"until = {until:g} s is too far away: a drift takes steps of {longest:.3g} s at most, and "
                f"{until - now:g} s are more than {_MOST_STEPS:g} of them"
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
        links = None if self._activity is None else self._links().copy()
        size, most = self._limited(until), _MOST
        while (smaller := self._tried(size, links, most)) is not None:
            size, most = max(smaller, _SHORTEST), 1.0
            self.rejected += 1
        self.last, self.accepted = size, self.accepted + 1

    def _tried(self, size: float, links: BoolArray | None, most: float) -> float | None:
        """Try a step; the size of a shorter one where it was taken back, None where it is accepted."""
        try:
            self.simulator.try_step(size)
        except BaseException as failed:
            self.simulator.take_back()
            if isinstance(failed, SolveError) and size > _SHORTEST:
                return 0.1 * size
            raise
        order = self._observers.order
        error, changed = self._error(size), links is not None and not np.array_equal(self._links(), links)
        if size > _SHORTEST and (changed or error > 1.0):
            shorter = size if error <= 1.0 else size * max(_LEAST, _SAFETY * error ** (-1.0 / order))
            if changed:
                assert links is not None
                shorter = min(shorter, size * self._unchanged(size, links))
            self.simulator.take_back()
            return shorter
        if changed:
            self._planned, self._last_error = 0.0, 1.0
        elif not self._planned:
            self._planned = self._first_size()
        elif error > 1.0:
            self._planned, self._last_error = size, 1.0
        else:
            error = max(error, _SMALLEST_ERROR)
            factor = _SAFETY * error ** (-_EXPONENT / order) * self._last_error ** (_LAST_EXPONENT / order)
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
        size = min(self._planned or _SHORTEST, self.simulator.longest_step)
        return left if size >= left else min(size, 0.5 * left)

    def _first_size(self) -> float:
        """After the shortest step: the step in which no state moves by more than a hundredth of 1 + |x|."""
        rate = self.simulator.plant.rates_of(1)[0]
        speed = float((np.abs(rate) / (1.0 + np.abs(self.simulator.state.x))).max())
        return min(max(_MOVED / max(speed, _MOVED), _SHORTEST), 1.0)

    def _error(self, size: float) -> float:
        """The largest estimated error of the step over what is admissible."""
        state, observers, memory = self.simulator.state, self._observers, self.simulator.state.memory
        return largest_error(
            size,
            self.tolerance,
            *self._weights,
            state.x,
            self.simulator.plant.rates_of(len(self._weights[0])),
            *self._columns[0],
            observers.rho.at(state.t),
            self._sums(0),
            memory["estimate"],
            observers.stages.predicted,
            observers.stages.slopes,
            *self._columns[1],
            observers.omega.at(state.t),
            self._sums(1),
            memory["input_estimate"],
            observers.stages.input_slopes,
        )

    def _sums(self, kind: int) -> FloatArray:
        """(targets, B) largest [M_i^-1 1]_a of a target's observers."""
        if self._activity is None:
            return self._fixed_sums[kind]
        links = self._observers.links
        assert links is not None
        sums = (links.states, links.inputs)[kind].inverse_row_sums(self._links())
        return by_target(self._layouts[kind], sums)

    def _links(self) -> BoolArray:
        up = self._observers.links_up(self.simulator.state)
        assert up is not None
        return up

    def _unchanged(self, size: float, links: BoolArray) -> float:
        """The part of a step of which links didn't change, by bisection along its states."""
        low, high, before = 0.0, 1.0, self._before
        x = np.empty_like(before.x)
        while (high - low) * size > _SHORTEST:
            middle = 0.5 * (low + high)
            self.states_at(np.full(len(before.t), middle), size, 0, x)
            up = self._observers.links_up(replace(before, t=before.t + middle * size, x=x))
            low, high = (middle, high) if up is not None and np.array_equal(up, links) else (low, middle)
        return low

    def states_at(self, share: FloatArray, size: float, start: int, out: FloatArray) -> None:
        """Write states inside the step that was tried last, by a polynomial of degree 3.

        Args:
            share: (count,) of the step, from 0 to 1: one per environment, or any number if there is one environment.
            size: of the step in s.
            start: first column to write.
            out: (n, start + count or more) columns of states.
        """
        rates = self.simulator.plant.rates_of(len(self._weights[0]))
        inner = rates[self.embedded.inner]
        along(share, start, size, self.embedded.node, self._before.x, rates[0], inner, self.simulator.state.x, out)
