"""Who estimates whom: the pairs (observer, target) and the matrices M_i, as flat arrays that compiled loops walk.

Agents differ in n_i and eta_i, so nothing is padded. The estimates of all targets stand in one vector of length P:
target by target, within a target observer by observer, within an observer component by component.
"""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from functools import cached_property

import networkx as nx
import numpy as np
from numpy.typing import NDArray

IntArray = NDArray[np.int64]
FloatArray = NDArray[np.float64]


@dataclass(frozen=True, eq=False)
class PairLayout:
    """The pairs (observer, target) of one kind of observer over one communication graph.

    A *target* is an agent that is estimated, an *observer* an agent that estimates it, a *row* one component of one
    target (all observers of a row share its funnel), a *pair* one (observer, target).

    Attributes:
        plan: (targets, 6) one line a target: number of observers eta_i, components n_i, offset of its estimates in
            the flat (P,) vector, of its state in the fleet's, of its first row, and of its first pair.
        target: (targets,) the estimated agents, ascending; agents without observers are absent.
        observer: (pairs,) the estimating agents, target by target, in an order that keeps M_i's profile small.
        relay: (pairs,) h_a, the diagonal of H_i: how many 1-hop neighbours relay the target's true state to the
            observer, or without the relay assumption 1 for a 1-hop neighbour and 0 otherwise.
        diagonal: (pairs,) d_a, the diagonal of M_i.
        link_start: (pairs + 1,) and `link`: for each pair, the places within its target of the observers it exchanges
            estimates with: the off-diagonal -1 entries of M_i.
        first: (pairs,) place of the first non-zero of each row of M_i (its lower profile).
        size: P, the length of the flat vector of estimates.
        rows: number of (target, component) rows.
    """

    plan: IntArray
    target: IntArray
    observer: IntArray
    relay: FloatArray
    diagonal: FloatArray
    link_start: IntArray
    link: IntArray
    first: IntArray
    size: int
    rows: int

    @staticmethod
    def build(
        graph: nx.Graph,
        neighborhoods: Sequence[Sequence[int]],
        dimensions: Sequence[int],
        offsets: Sequence[int] | IntArray,
        *,
        relay: bool,
        targets: Iterable[int] | None = None,
    ) -> PairLayout:
        """Lay out the observers of `targets`.

        Args:
            graph: the communication graph, nodes 0..N-1.
            neighborhoods: per agent its k-hop neighbours (`physics.k_hop_neighbors`).
            dimensions: per agent the number of components estimated, n_i.
            offsets: per agent where its components start in the fleet's flat vector.
            relay: whether 1-hop neighbours relay the target's state (the paper's Assumption 4).
            targets: agents to observe; all by default.
        """
        adjacency = [frozenset(graph[node]) - {node} for node in range(graph.number_of_nodes())]
        plan: list[tuple[int, ...]] = []
        target: list[int] = []
        observer: list[int] = []
        heard: list[int] = []
        diagonal: list[int] = []
        first: list[int] = []
        links: list[int] = []
        link_start = [0]
        size = rows = 0
        for i in range(len(adjacency)) if targets is None else sorted(targets):
            members = _profile_order(adjacency, neighborhoods[i])
            if not members:
                continue
            place = {agent: a for a, agent in enumerate(members)}
            plan.append((len(members), dimensions[i], size, offsets[i], rows, len(observer)))
            target.append(i)
            for a, agent in enumerate(members):
                linked = sorted(place[other] for other in adjacency[agent] if other in place)
                h = len(adjacency[agent] & adjacency[i]) if relay else int(agent in adjacency[i])
                observer.append(agent)
                heard.append(h)
                diagonal.append(len(linked) + h)
                first.append(min(linked[0], a) if linked else a)
                links.extend(linked)
                link_start.append(len(links))
            size += len(members) * dimensions[i]
            rows += dimensions[i]
        return PairLayout(
            plan=np.array(plan, dtype=np.int64).reshape(-1, 6),
            target=np.array(target, dtype=np.int64),
            observer=np.array(observer, dtype=np.int64),
            relay=np.array(heard, dtype=np.float64),
            diagonal=np.array(diagonal, dtype=np.float64),
            link_start=np.array(link_start, dtype=np.int64),
            link=np.array(links, dtype=np.int64),
            first=np.array(first, dtype=np.int64),
            size=size,
            rows=rows,
        )

    @property
    def pairs(self) -> int:
        """Number of (observer, target) pairs."""
        return len(self.observer)

    @cached_property
    def arrays(self) -> tuple[IntArray, FloatArray, FloatArray, IntArray, IntArray]:
        """What the right-hand sides read: plan, diagonal, relay, link_start, link."""
        return self.plan, self.diagonal, self.relay, self.link_start, self.link

    @cached_property
    def slot(self) -> dict[tuple[int, int], int]:
        """(observer, target) -> offset of that pair's estimate in the flat vector."""
        return {
            (int(self.observer[pair + a]), int(agent)): int(offset + a * n)
            for agent, (eta, n, offset, _, _, pair) in zip(self.target, self.plan, strict=True)
            for a in range(eta)
        }

    @cached_property
    def column_source(self) -> IntArray:
        """(P,) index into the fleet's flat vector of the true component that each estimate is an estimate of."""
        columns = [np.tile(source + np.arange(n), eta) for eta, n, _, source, _, _ in self.plan]
        return np.concatenate(columns) if columns else np.zeros(0, np.int64)

    @cached_property
    def column_row(self) -> IntArray:
        """(P,) the row, and so the funnel, of each estimate."""
        columns = [np.tile(row + np.arange(n), eta) for eta, n, _, _, row, _ in self.plan]
        return np.concatenate(columns) if columns else np.zeros(0, np.int64)

    @cached_property
    def column_pair(self) -> IntArray:
        """(P,) the pair of each estimate."""
        columns = [np.repeat(pair + np.arange(eta), n) for eta, n, _, _, _, pair in self.plan]
        return np.concatenate(columns) if columns else np.zeros(0, np.int64)

    @cached_property
    def row_source(self) -> IntArray:
        """(rows,) index into the fleet's flat vector of each row's true component."""
        rows = [source + np.arange(n) for _, n, _, source, _, _ in self.plan]
        return np.concatenate(rows) if rows else np.zeros(0, np.int64)

    @cached_property
    def row_target(self) -> IntArray:
        """(rows,) place in `target` of each row's agent."""
        return np.repeat(np.arange(len(self.target)), self.plan[:, 1])

    def matrix(self, index: int) -> FloatArray:
        """M_i = L_i + H_i of `target[index]` as a dense (eta_i, eta_i) array, ordered as `observer` (Lemma 1: > 0)."""
        eta, _, _, _, _, pair = self.plan[index]
        matrix = np.diag(self.diagonal[pair : pair + eta])
        for a in range(eta):
            matrix[a, self.link[self.link_start[pair + a] : self.link_start[pair + a + 1]]] = -1.0
        return matrix

    @cached_property
    def eigenvalues(self) -> FloatArray:
        """(targets, 2): smallest and largest eigenvalue of each M_i; equal matrices, as those of a star, count once."""
        alike: dict[tuple[bytes, ...], list[int]] = {}
        for index, (eta, _, _, _, _, pair) in enumerate(self.plan.tolist()):
            start = self.link_start[pair : pair + eta + 1]
            content = self.diagonal[pair : pair + eta], start - start[0], self.link[start[0] : start[-1]]
            alike.setdefault(tuple(part.tobytes() for part in content), []).append(index)
        groups = list(alike.values())
        sizes = self.plan[[members[0] for members in groups], 0]
        extremes = np.zeros((len(self.target), 2))
        for eta in np.unique(sizes):
            same = [groups[number] for number in np.flatnonzero(sizes == eta)]
            # eigvalsh takes a stack; a slice at a time keeps ten thousand targets within the memory of a few
            step = max(1, 1_000_000 // int(eta) ** 2)
            for first in range(0, len(same), step):
                some = same[first : first + step]
                spectrum = np.linalg.eigvalsh(np.stack([self.matrix(members[0]) for members in some]))
                for members, values in zip(some, spectrum, strict=True):
                    extremes[members] = values[[0, -1]]
        return extremes


def _profile_order(adjacency: Sequence[frozenset[int]], members: Sequence[int]) -> list[int]:
    """Order observers by reversed breadth-first search within their own graph: few non-zeros to eliminate.

    (E. Cuthill and J. McKee, Reducing the bandwidth of sparse symmetric matrices, 1969.)
    """
    inside = set(members)
    degree = {agent: len(adjacency[agent] & inside) for agent in members}
    order: list[int] = []
    for root in sorted(members, key=lambda agent: (degree[agent], agent)):
        if root not in inside:
            continue
        inside.discard(root)
        queue = [root]
        for agent in queue:
            fresh = sorted(adjacency[agent] & inside, key=lambda other: (degree[other], other))
            inside.difference_update(fresh)
            queue.extend(fresh)
        order.extend(queue)
    return order[::-1]
