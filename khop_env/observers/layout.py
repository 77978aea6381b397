"""Pairs (observer, target) and the matrices M_i, as flat arrays for compiled loops.

Agents differ in n_i and eta_i, so nothing is padded. The estimates of all targets stand in one vector of length P:
target by target, within a target observer by observer, within an observer component by component.
"""

from __future__ import annotations

from collections.abc import Iterable, Iterator, Sequence
from dataclasses import dataclass
from functools import cached_property
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from khop_env.brief import brief
from khop_env.observers.indexing import find, ranges
from khop_env.observers.ordering import profile_order
from khop_env.physics import Links

IntArray = NDArray[np.int64]
"""An array of int64."""
FloatArray = NDArray[np.float64]


class PairArrays(NamedTuple):
    """Arrays of a `PairLayout` for compiled loops, one per quantity.

    The first six have an entry per target: its number of observers (eta_i) and of components (n_i), and where its part
    begins in the estimates (P,), in the fleet's vector, in the rows, and in the pairs.

    Attributes:
        observers: (targets,) eta_i.
        components: (targets,) n_i.
        column: (targets,) offset of its estimates in the flat (P,) vector.
        source: (targets,) offset of its state in the fleet's vector.
        row: (targets,) its first row.
        pair: (targets,) its first pair.
        relay: (pairs,) h_a, the diagonal of H_i: number of neighbours that relay the target's true state to the
            observer; without the relay assumption 1 for a neighbour of the target and 0 otherwise.
        diagonal: (pairs,) d_a, the diagonal of M_i.
        entry_start: (pairs + 1,) where each pair's part of `entry` begins.
        entry: (entries,) places within the target of the observers whose estimates the observer receives: the
            off-diagonal -1 entries of M_i.
        first: (pairs,) place of the first non-zero of each row of M_i (its lower profile).
        last: (pairs,) place of the last non-zero of each row of M_i's factor U; empty if all links go both ways and
            never change, so that M_i is symmetric.
    """

    observers: IntArray
    components: IntArray
    column: IntArray
    source: IntArray
    row: IntArray
    pair: IntArray
    relay: FloatArray
    diagonal: FloatArray
    entry_start: IntArray
    entry: IntArray
    first: IntArray
    last: IntArray


class TargetBlock(NamedTuple):
    """The observers of one target within a `PairLayout`.

    Attributes:
        agent: the target.
        observers: number of its observers, eta_i.
        components: number of its components, n_i.
        columns: its part of the flat vector of estimates.
        sources: its part of the fleet's vector.
        rows: its rows.
        pairs: its pairs.
    """

    agent: int
    observers: int
    components: int
    columns: slice
    sources: slice
    rows: slice
    pairs: slice


@dataclass(frozen=True, eq=False)
class PairLayout:
    """The pairs (observer, target) of one kind of observer over one superset of directed links.

    A *target* is an agent that is estimated, an *observer* an agent that estimates it, a *row* one component of one
    target (all observers of a row share its funnel), a *pair* one (observer, target).

    Attributes:
        arrays: the arrays that compiled loops read.
        target: (targets,) the estimated agents, ascending; agents without observers are absent.
        observer: (pairs,) the estimating agents, target by target, in an order that keeps M_i's profile small.
        entry_link: (entries,) for each off-diagonal entry of the matrices the link in `links` that carries it.
        relay_start: (pairs + 1,) where each pair's part of `relay_link` begins.
        relay_link: (relays,) the links over which the target's true state reaches each pair's observer.
        links: the directed links of the communication graph.
        size: P, the length of the flat vector of estimates.
        rows: number of (target, component) rows.
    """

    arrays: PairArrays
    target: IntArray
    observer: IntArray
    entry_link: IntArray
    relay_start: IntArray
    relay_link: IntArray
    links: Links
    size: int
    rows: int

    __repr__ = brief

    @staticmethod
    def build(
        links: Links,
        neighborhoods: Sequence[Sequence[int]],
        dimensions: Sequence[int],
        offsets: Sequence[int] | IntArray,
        *,
        relay: bool,
        targets: Iterable[int] | None = None,
        changing: bool = False,
    ) -> PairLayout:
        """Lay out the observers of `targets`.

        Args:
            links: of the communication graph.
            neighborhoods: per agent the agents that estimate it (`physics.k_hop_neighbors`).
            dimensions: per agent the number of components estimated, n_i.
            offsets: per agent where its components start in the fleet's flat vector.
            relay: whether neighbours relay the target's state (the paper's Assumption 4).
            targets: agents to observe; all by default.
            changing: whether links come and go.
        """
        n = links.agents
        ordered = [
            (i, members)
            for i in (range(n) if targets is None else sorted(targets))
            if (members := profile_order(links.senders, neighborhoods[i]))
        ]
        target = np.array([i for i, _ in ordered], np.int64)
        eta = np.array([len(members) for _, members in ordered], np.int64)
        observer = np.array([agent for _, members in ordered for agent in members], np.int64)
        dimension = np.array(dimensions, np.int64)[target]
        first_pair = np.cumsum(eta) - eta
        whose = np.repeat(np.arange(len(target)), eta)  # place in `target`, of each pair
        place = np.arange(len(observer)) - first_pair[whose]
        # every way on which something may come: the links to each pair's observer, by sender
        fewest = np.searchsorted(links.receiver, np.arange(n + 1))
        pair, link = ranges(fewest[observer], np.diff(fewest)[observer])
        sender = links.sender[link]
        found, other = find(whose[pair] * n + sender, whose * n + observer)
        pair_of_entry, entry, entry_link = pair[found], place[other[found]], link[found]
        order = np.lexsort((entry, pair_of_entry))
        pair_of_entry, entry, entry_link = pair_of_entry[order], entry[order], entry_link[order]
        # under Assumption 4 all neighbours of the target relay its state; otherwise only the target sends it
        of_target = target[whose[pair]]
        relays = sender == of_target
        if relay:
            relays, _ = find(sender * n + of_target, links.receiver * n + links.sender)
        entries, relay_count = (np.bincount(which, minlength=len(observer)) for which in (pair_of_entry, pair[relays]))
        entry_start = np.concatenate([[0], np.cumsum(entries)])
        first = place.copy()
        np.minimum.at(first, pair_of_entry, entry)
        return PairLayout(
            PairArrays(
                observers=eta,
                components=dimension,
                column=np.cumsum(eta * dimension) - eta * dimension,
                source=np.array(offsets, np.int64)[target],
                row=np.cumsum(dimension) - dimension,
                pair=first_pair,
                relay=relay_count.astype(np.float64),
                diagonal=(entries + relay_count).astype(np.float64),
                entry_start=entry_start,
                entry=entry,
                first=first,
                last=_last(first, entry_start, entry, first_pair, eta)
                if changing or not links.symmetric
                else np.zeros(0, np.int64),
            ),
            target=target,
            observer=observer,
            entry_link=entry_link,
            relay_start=np.concatenate([[0], np.cumsum(relay_count)]),
            relay_link=link[relays],
            links=links,
            size=int((eta * dimension).sum()),
            rows=int(dimension.sum()),
        )

    @cached_property
    def packed(self) -> PairArrays:
        """`arrays` as a plain tuple, whose type Numba recognises more quickly: for kernels that are called often."""
        return tuple(self.arrays)  # type: ignore[return-value]

    @cached_property
    def blocks(self) -> tuple[TargetBlock, ...]:
        """The targets one after the other, for loops in Python."""
        first_six = zip(*(values.tolist() for values in self.arrays[:6]), strict=True)
        return tuple(
            TargetBlock(
                agent,
                eta,
                n,
                slice(column, column + eta * n),
                slice(source, source + n),
                slice(row, row + n),
                slice(pair, pair + eta),
            )
            for agent, (eta, n, column, source, row, pair) in zip(self.target.tolist(), first_six, strict=True)
        )

    @property
    def pairs(self) -> int:
        """Number of (observer, target) pairs."""
        return len(self.observer)

    @cached_property
    def slot(self) -> dict[tuple[int, int], int]:
        """(observer, target) -> offset of that pair's estimate in the flat vector."""
        return {
            (observer, block.agent): block.columns.start + a * block.components
            for block in self.blocks
            for a, observer in enumerate(self.observer[block.pairs].tolist())
        }

    @cached_property
    def column_source(self) -> IntArray:
        """(P,) index into the fleet's flat vector of the true component that each estimate is of."""
        return _joined(np.tile(np.arange(b.sources.start, b.sources.stop), b.observers) for b in self.blocks)

    @cached_property
    def column_row(self) -> IntArray:
        """(P,) the row, and so the funnel, of each estimate."""
        return _joined(np.tile(np.arange(b.rows.start, b.rows.stop), b.observers) for b in self.blocks)

    @cached_property
    def column_pair(self) -> IntArray:
        """(P,) the pair of each estimate."""
        return _joined(np.repeat(np.arange(b.pairs.start, b.pairs.stop), b.components) for b in self.blocks)

    @cached_property
    def pair_target(self) -> IntArray:
        """(pairs,) the agent that each pair's observer estimates."""
        return np.repeat(self.target, self.arrays.observers)

    @cached_property
    def row_source(self) -> IntArray:
        """(rows,) index into the fleet's flat vector of each row's true component."""
        return _joined(np.arange(b.sources.start, b.sources.stop) for b in self.blocks)

    @cached_property
    def row_target(self) -> IntArray:
        """(rows,) place in `target` of each row's agent."""
        return np.repeat(np.arange(len(self.target)), self.arrays.components)

    def matrix(self, index: int) -> FloatArray:
        """M_i = L_i + H_i of `target[index]`, dense (eta_i, eta_i), ordered as `observer`: nonsingular (Lemma 1)."""
        block, arrays = self.blocks[index], self.arrays
        matrix = np.diag(arrays.diagonal[block.pairs])
        for a, pair in enumerate(range(block.pairs.start, block.pairs.stop)):
            matrix[a, arrays.entry[arrays.entry_start[pair] : arrays.entry_start[pair + 1]]] = -1.0
        return matrix

    @cached_property
    def eigenvalues(self) -> FloatArray:
        """(targets, 2): smallest and largest eigenvalue of each M_i; their moduli where links go one way."""
        extremes = np.zeros((len(self.target), 2))
        for groups, spectra in self._spectra():
            for members, values in zip(groups, np.sort(np.abs(spectra)), strict=True):
                extremes[members] = values[[0, -1]]
        return extremes

    @cached_property
    def euler_rate(self) -> FloatArray:
        """(targets,) r of each M_i: explicit Euler damps y' = -c M_i y, c > 0, if its step is below 2 / (c r).

        The largest |l|^2 / Re l of its eigenvalues l, whose real parts are positive: lambda_max if M_i is symmetric.
        """
        if self.links.symmetric:
            return self.eigenvalues[:, 1]
        rates = np.zeros(len(self.target))
        for groups, spectra in self._spectra():
            for members, rate in zip(groups, (np.abs(spectra) ** 2 / spectra.real).max(axis=1), strict=True):
                rates[members] = rate
        return rates

    def _spectra(self) -> Iterator[tuple[list[list[int]], NDArray[Any]]]:
        """Eigenvalues of the matrices M_i, each with the targets that share it."""
        of = np.linalg.eigvalsh if self.links.symmetric else np.linalg.eigvals
        return ((groups, of(matrices)) for groups, matrices in self._distinct_matrices())

    @cached_property
    def inverse_row_sums(self) -> FloatArray:
        """(pairs,) [M_i^-1 1]_a: |x_tilde_a| is below this many times rho where all disagreements are within rho."""
        sums = np.zeros(self.pairs)
        for groups, matrices in self._distinct_matrices():
            found = np.linalg.solve(matrices, np.ones((*matrices.shape[:2], 1)))[..., 0]
            for index, values in ((i, row) for some, row in zip(groups, found, strict=True) for i in some):
                sums[self.blocks[index].pairs] = values
        return sums

    def _distinct_matrices(self) -> Iterator[tuple[list[list[int]], FloatArray]]:
        """Stacks of the matrices M_i, each with the targets that share it: those of a star, say, are all equal."""
        alike, arrays = dict[tuple[bytes, ...], list[int]](), self.arrays
        for index, block in enumerate(self.blocks):
            start = arrays.entry_start[block.pairs.start : block.pairs.stop + 1]
            content = arrays.diagonal[block.pairs], start - start[0], arrays.entry[start[0] : start[-1]]
            alike.setdefault(tuple(part.tobytes() for part in content), []).append(index)
        groups = list(alike.values())
        sizes = arrays.observers[[members[0] for members in groups]]
        for eta in np.unique(sizes):
            same = [groups[number] for number in np.flatnonzero(sizes == eta)]
            step = max(1, 1_000_000 // int(eta) ** 2)  # slices bound the memory with ten thousand targets
            for first in range(0, len(same), step):
                some = same[first : first + step]
                yield some, np.stack([self.matrix(members[0]) for members in some])


def _joined(parts: Iterable[IntArray]) -> IntArray:
    """The parts after each other; an empty array of none."""
    return np.concatenate([np.zeros(0, np.int64), *parts])


def _last(first: IntArray, entry_start: IntArray, entry: IntArray, first_pair: IntArray, eta: IntArray) -> IntArray:
    """(pairs,) place of the last non-zero of each row of the factors U: fill-in reaches as far as the rows above."""
    first_, start, entries = first.tolist(), entry_start.tolist(), entry.tolist()
    last: list[int] = []
    for begin, count in zip(first_pair.tolist(), eta.tolist(), strict=True):
        for a in range(count):
            pair = begin + a
            linked = entries[start[pair] : start[pair + 1]]
            last.append(max([a, *linked, *last[begin + first_[pair] : pair]]))
    return np.array(last, np.int64)
