"""Nodes of a whole fleet in step, over simulated links, for tests and nothing else."""

from __future__ import annotations

from collections import deque
from collections.abc import Sequence

import networkx as nx

from khop_env.network import Network, PlainLink, plain_noise
from khop_env.observers import Estimate, Exponential, Message, ObserverDesign, ObserverNode
from khop_env.physics import AgentModel, Fleet, FloatArray

T = 0.05  # s


def design_of(
    models: Sequence[AgentModel], k: int = 2, graph: nx.Graph | None = None, relay: bool = True, **options: object
) -> ObserverDesign:
    """Agents in a row, or on another graph."""
    return ObserverDesign(
        Fleet(models),
        nx.path_graph(len(models)) if graph is None else graph,
        k,
        Exponential(50.0, 0.5, 2.0),
        Exponential(100.0, 2.0, 2.0),
        relay,
        **options,
    )


class Rounds:
    """Every agent's node, and a link for each of the design's.

    Args:
        design: the observers.
        network: what happens to messages.
        key: of the links' randomness.
        pack: whether messages cross the links as bytes.
        options: of the nodes.
    """

    def __init__(
        self, design: ObserverDesign, network: Network, key: int = 0, pack: bool = False, **options: object
    ) -> None:
        self.design, self.network, self.key, self.pack = design, network, key, pack
        agents = range(len(design.fleet))
        options = {"period": network.period, "noise": network.noise, **options}
        self.nodes = [ObserverNode(design, a, **options) for a in agents]
        self.links = [PlainLink(network, key, number) for number in range(len(design.links))]
        self.sent: list[deque[Message]] = [deque(maxlen=network.most_rounds_late + 1) for _ in agents]
        self.round = -1

    def update(self, t: float, x: FloatArray, u: FloatArray) -> None:
        """Predict; and run a round where one is due: late messages, sending, messages that aren't late."""
        fleet = self.design.fleet
        noise = [plain_noise(self.network, self.key, self.round + 1, row) for row in range(fleet.n)]
        for a, node in enumerate(self.nodes):
            node.update(t, (x + noise)[fleet.state_slice(a)], u[fleet.input_slice(a)])
        if not self.nodes[0].due:
            return
        self.round += 1
        before = [link.newest for link in self.links]
        newest = [link.advance() for link in self.links]
        arriving = [
            (newest[number], *ends)
            for ends, number in self.design.links.index.items()
            if newest[number] > before[number]
        ]
        for sent, p, a in arriving:
            if sent < self.round:
                self.nodes[a].receive(self.sent[p][sent - self.round])
        for a, node in enumerate(self.nodes):
            message = node.message()
            self.sent[a].append(Message.unpack(message.pack(), self.design) if self.pack else message)
        for sent, p, a in arriving:
            if sent == self.round:
                self.nodes[a].receive(self.sent[p][-1])

    def estimates(self, t: float) -> list[dict[str, Estimate]]:
        """Of every node."""
        return [node.estimates(t) for node in self.nodes]
