"""Weights of links that come and go: the entries of every M_i now, and the bounds that follow from them.

A link weighs 1 while it is up, else 0. A neighbour p relays target i's state to observer a while i -> p and p -> a are
both up. Observers use the estimates of those observers only that the target reaches along links that are up: the others
know nothing of it that isn't old. So an observer that is cut off has a row of zeros, and predicts; the matrix of the
others is a nonsingular M-matrix (docs/theory/graphs.md, "Changing graphs").
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from khop_env.compiled import compiled
from khop_env.observers.layout import FloatArray, IntArray, PairArrays, PairLayout


class Weights(NamedTuple):
    """The matrices M_i of a layout in B environments, whose links are up or down.

    Attributes:
        diagonal: (pairs, B) d_a.
        relay: (pairs, B) h_a.
        entry: (entries, B) 1 where an off-diagonal entry is -1, and 0 where its link is down or its sender cut off.
    """

    diagonal: FloatArray
    relay: FloatArray
    entry: FloatArray


class WeightsNow:
    """The weights of a layout and what they guarantee, computed again only where links have changed.

    Args:
        layout: built for changing links.
        num_envs: number of environments B.
    """

    def __init__(self, layout: PairLayout, num_envs: int) -> None:
        self._layout, links = layout, layout.links
        target = np.repeat(layout.target, layout.arrays.observers)  # of each pair
        whose = np.repeat(target, np.diff(layout.relay_start))
        senders = links.sender[layout.relay_link].tolist()
        # the link over which the relaying neighbour itself hears the target; without relays it is the target
        through = zip(whose.tolist(), senders, layout.relay_link.tolist(), strict=True)
        self._first_link = np.array([link if i == p else links.index[i, p] for i, p, link in through], np.int64)
        pairs = layout.pairs, num_envs
        self._weights = Weights(np.zeros(pairs), np.zeros(pairs), np.zeros((len(layout.entry_link), num_envs)))
        self._sums, self._reached = np.zeros(pairs), np.zeros(pairs, np.bool_)
        self._weighed, self._bounded = (np.zeros((0, 0), np.bool_) for _ in range(2))

    def of(self, up: NDArray[np.bool_]) -> Weights:
        """The weights while the links `up` (L, B) are up, as a plain tuple for kernels; overwritten by the next."""
        if not np.array_equal(up, self._weighed):
            layout = self._layout
            structure = layout.packed, up, layout.entry_link, layout.relay_start, layout.relay_link, self._first_link
            _weigh(*structure, self._reached, *self._weights)
            self._weighed = up.copy()
        return tuple(self._weights)  # type: ignore[return-value]

    def inverse_row_sums(self, up: NDArray[np.bool_]) -> FloatArray:
        """(pairs, B) [M_i^-1 1]_a while the links `up` (L, B) are up.

        It is inf for observers that the target doesn't reach: nothing here bounds their errors.
        """
        same_shape = self._bounded.shape == up.shape
        changed = (self._bounded != up).any(axis=0) if same_shape else np.ones(up.shape[1], np.bool_)
        if changed.any():
            diagonal, _, entry = self.of(up)
            _inverse_row_sums(self._layout.packed, diagonal, entry, np.flatnonzero(changed), self._sums)
            self._bounded = up.copy()
        return self._sums


@compiled
def _weigh(
    pairs: PairArrays,
    up: NDArray[np.bool_],
    entry_link: IntArray,
    relay_start: IntArray,
    relay_link: IntArray,
    first_link: IntArray,
    reached: NDArray[np.bool_],
    diagonal: FloatArray,
    relay: FloatArray,
    entry: FloatArray,
) -> None:
    pairs = PairArrays(*pairs)
    batch = up.shape[1]
    for pair in range(len(relay_start) - 1):
        for env in range(batch):
            relay[pair, env] = 0.0
        for k in range(relay_start[pair], relay_start[pair + 1]):
            for env in range(batch):
                relay[pair, env] += up[relay_link[k], env] & up[first_link[k], env]
        for env in range(batch):
            reached[pair, env] = relay[pair, env] > 0.0
            diagonal[pair, env] = relay[pair, env]
    for t in range(pairs.observers.size):
        first, stop = pairs.pair[t], pairs.pair[t] + pairs.observers[t]
        changes = 1
        while changes:  # along the links, one or more in each pass
            changes = 0
            for pair in range(first, stop):
                for k in range(pairs.entry_start[pair], pairs.entry_start[pair + 1]):
                    other = first + pairs.entry[k]
                    for env in range(batch):
                        now = reached[pair, env] | (up[entry_link[k], env] & reached[other, env])
                        changes += now != reached[pair, env]
                        reached[pair, env] = now
        for pair in range(first, stop):
            for k in range(pairs.entry_start[pair], pairs.entry_start[pair + 1]):
                other = first + pairs.entry[k]
                for env in range(batch):
                    entry[k, env] = up[entry_link[k], env] & reached[other, env]
                    diagonal[pair, env] += entry[k, env]


@compiled
def _inverse_row_sums(
    pairs: PairArrays, diagonal: FloatArray, entry: FloatArray, env_ids: IntArray, out: FloatArray
) -> None:
    """Write [M_i^-1 1]_a into `out` (pairs, B) in the environments `env_ids`; inf for observers that are cut off.

    The others' matrix is a nonsingular M-matrix, dominant by rows, which elimination solves without pivoting.
    """
    pairs = PairArrays(*pairs)
    widest = 1
    for t in range(pairs.observers.size):
        widest = max(widest, pairs.observers[t])
    m, solution = np.empty((widest, widest)), np.empty(widest)
    for env in env_ids:
        for t in range(pairs.observers.size):
            eta, pair = pairs.observers[t], pairs.pair[t]
            for a in range(eta):
                m[a, :eta] = 0.0
                for k in range(pairs.entry_start[pair + a], pairs.entry_start[pair + a + 1]):
                    m[a, pairs.entry[k]] = -entry[k, env]
                m[a, a] = max(diagonal[pair + a, env], 1.0)  # 0 for those that are cut off, whom nobody hears
                solution[a] = 1.0
                for j in range(a):
                    factor = m[a, j] / m[j, j]
                    if factor != 0.0:
                        for c in range(j + 1, eta):
                            m[a, c] -= factor * m[j, c]
                        solution[a] -= factor * solution[j]
            for a in range(eta - 1, -1, -1):
                for c in range(a + 1, eta):
                    solution[a] -= m[a, c] * solution[c]
                solution[a] /= m[a, a]
            for a in range(eta):
                out[pair + a, env] = solution[a] if diagonal[pair + a, env] > 0.0 else np.inf
