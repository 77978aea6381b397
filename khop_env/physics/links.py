"""Directed communication links: which agent receives messages from which."""

from __future__ import annotations

from dataclasses import dataclass
from functools import cached_property

import networkx as nx
import numpy as np
from numpy.typing import NDArray

from khop_env.brief import brief


@dataclass(frozen=True, eq=False)
class Links:
    """The directed links of a communication graph, numbered: sender -> receiver.

    An undirected edge is two links. Layouts are built once over all links that may ever be up; which of them are up,
    and the age of the newest message over each, are data of an episode.

    Attributes:
        agents: number of agents N.
        sender: (L,) sending agents.
        receiver: (L,) receiving agents; links are ordered by receiver, then by sender.
    """

    agents: int
    sender: NDArray[np.int64]
    receiver: NDArray[np.int64]

    __repr__ = brief

    @staticmethod
    def of(graph: nx.Graph) -> Links:
        """The links of a graph on the nodes 0..N-1; both directions of each edge if it is undirected."""
        edges = set(graph.edges)
        if not graph.is_directed():
            edges |= {(j, i) for i, j in edges}
        ordered = np.array(sorted((receiver, sender) for sender, receiver in edges), np.int64).reshape(-1, 2)
        return Links(graph.number_of_nodes(), np.ascontiguousarray(ordered[:, 1]), np.ascontiguousarray(ordered[:, 0]))

    def __len__(self) -> int:
        """Number of links L."""
        return len(self.sender)

    @cached_property
    def index(self) -> dict[tuple[int, int], int]:
        """(sender, receiver) -> number of the link."""
        pairs = zip(self.sender.tolist(), self.receiver.tolist(), strict=True)
        return {pair: number for number, pair in enumerate(pairs)}

    @cached_property
    def symmetric(self) -> bool:
        """True if every link has a link back, as in an undirected graph."""
        return all((receiver, sender) in self.index for sender, receiver in self.index)

    @cached_property
    def senders(self) -> tuple[frozenset[int], ...]:
        """Per agent its in-neighbours: the agents that it receives from."""
        found: list[set[int]] = [set() for _ in range(self.agents)]
        for sender, receiver in self.index:
            found[receiver].add(sender)
        return tuple(frozenset(senders) for senders in found)
