"""Samples of the estimates of one kind of observer: under continuous exchange, or over a network of messages."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from khop_env.brief import brief
from khop_env.network import Network
from khop_env.observers import FloatArray, FunnelBank, Funnels, PairLayout
from khop_env.observers.weights import WeightsNow


@dataclass(frozen=True, eq=False)
class ObserverRecord:
    """The samples of one kind of observer: of the states (PPSO), or of the inputs' effects g (PPIO).

    Attributes:
        funnels: observer-target pairs and bounds; the P estimates are in the order of `funnels.layout`.
        time: (T,) in s.
        truth: (T, n) true values: the fleet's x, or its g.
        estimate: (T, P) estimates.
        disagreement: (T, P) xi, or mu.
        up: (T, L) whether each link was up; None where all were, always.
    """

    funnels: Funnels
    time: FloatArray
    truth: FloatArray
    estimate: FloatArray
    disagreement: FloatArray
    up: NDArray[np.bool_] | None = None

    __repr__ = brief

    @property
    def layout(self) -> PairLayout:
        """The observer-target pairs."""
        return self.funnels.layout

    @property
    def truth_per_estimate(self) -> FloatArray:
        """(T, P) the true value of each estimated component."""
        return self.truth[:, self.layout.column_source]

    @property
    def error(self) -> FloatArray:
        """(T, P) estimation errors x_tilde, or g_tilde."""
        with np.errstate(invalid="ignore"):  # inf - inf, of diverged states, is nan
            return self.estimate - self.truth_per_estimate

    @property
    def rho(self) -> FloatArray:
        """(T, P) funnels of the disagreements: rho, or omega."""
        return self._evaluate(self.funnels.rho)

    @property
    def delta(self) -> FloatArray:
        """(T, P) bounds on the estimation errors that the observers were designed for: delta, or theta."""
        return self._evaluate(self.funnels.delta)

    @property
    def bound(self) -> FloatArray:
        """(T, P) each observer's own guaranteed bound on the error; at most delta, or theta, while all links are up.

        It is inf for observers that are cut off from their target.
        """
        if self.up is not None:
            return self.rho * self._row_sums(self.up)[:, self.layout.column_pair]
        out = np.empty((self.layout.size, len(self.time)))
        return self.funnels.error_bounds(self._rows(self.funnels.delta), out).T

    @property
    def cut_off(self) -> NDArray[np.bool_]:
        """(T, pairs) whether the target didn't reach the observer, so that nothing bounds the error."""
        shape = len(self.time), self.layout.pairs
        return np.zeros(shape, np.bool_) if self.up is None else np.isinf(self._row_sums(self.up))

    def _row_sums(self, up: NDArray[np.bool_]) -> FloatArray:
        return WeightsNow(self.layout, len(self.time)).inverse_row_sums(np.ascontiguousarray(up.T)).T

    def _evaluate(self, bank: FunnelBank) -> FloatArray:
        return self._rows(bank).T[:, self.layout.column_row]

    def _rows(self, bank: FunnelBank) -> FloatArray:
        return bank.evaluate(self.time, np.empty((len(bank), len(self.time))))


@dataclass(frozen=True, eq=False)
class MessageRecord:
    """The samples of estimates of states over a network of messages.

    Attributes:
        layout: pairs of an agent and another that it estimates, neighbours included.
        time: (T,) in s.
        truth: (T, n) the fleet's x.
        estimate: (T, P) estimates.
        bound: (T, P) certified bounds on their errors; inf where nothing is certified.
        age: (T, pairs) time since the newest state that has arrived was measured, in s; inf where none has.
        missed: (T, L) rounds by which the newest message over each link is older than one that comes on time.
        network: over which messages are exchanged, without ranges; None for observers of a user's own.
        estimator: its name.
        up: (T, L) whether each link was up; None where all were, always.
    """

    layout: PairLayout
    time: FloatArray
    truth: FloatArray
    estimate: FloatArray
    bound: FloatArray
    age: FloatArray
    missed: FloatArray
    network: Network | None
    estimator: str
    up: NDArray[np.bool_] | None = None

    __repr__ = brief

    @property
    def truth_per_estimate(self) -> FloatArray:
        """(T, P) the true value of each estimated component."""
        return self.truth[:, self.layout.column_source]

    @property
    def error(self) -> FloatArray:
        """(T, P) estimation errors."""
        with np.errstate(invalid="ignore"):  # inf - inf, of diverged states, is nan
            return self.estimate - self.truth_per_estimate
