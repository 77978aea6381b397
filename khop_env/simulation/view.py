"""The view of a feedback law: the states that each agent knows, along the edges of the task graph."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Literal, Protocol

import networkx as nx
import numpy as np

from khop_env.brief import brief
from khop_env.observers import FloatArray, IntArray, ObserverDesign, Observers, PlantState
from khop_env.physics import Fleet, read_only
from khop_env.simulation.edge_law import EdgeArrays, displacements
from khop_env.simulation.received import ReceivedStates, links_up

Observe = Literal["estimate", "oracle", "local"]
"""Source of the states of agents beyond the neighbours: their estimates, the true states, or none."""
OBSERVE: tuple[Observe, ...] = ("estimate", "oracle", "local")
"""All observation modes."""


@dataclass(slots=True)
class View:
    """The knowledge of all agents at one instant, batched for a law.

    Attributes:
        fleet: the agents' models and offsets.
        x: (B, n) states; agent i's law may read its own slice only.
        edges: (E, 2) directed task edges: agent i = edges[:, 0] acts on agent j = edges[:, 1], which is -1 where j
            isn't in the fleet.
        known: (B, E) whether i knows j's state: j is its neighbour, over a link that is up now, or it estimates j.
        displacement: (B, E, d) position of j, received or estimated by i, minus i's own position and minus the
            displacement that the task asks for, in m; 0 where not known.

    The arrays are read-only, and overwritten by the next evaluation; copy those that you keep.
    """

    fleet: Fleet
    x: FloatArray
    edges: IntArray
    known: np.ndarray
    displacement: FloatArray

    __repr__ = brief

    def known_edges(self) -> IntArray:
        """(N, B) number of each agent's task edges whose other agent it knows."""
        counts = np.zeros((len(self.fleet), len(self.known)), np.int64)
        np.add.at(counts, self.edges[:, 0], self.known.T)
        return counts


class Law(Protocol):
    """A feedback law: a pure function of time and of the agents' knowledge."""

    def __call__(self, t: FloatArray, view: View) -> FloatArray:
        """Inputs (B, m) of the whole fleet at the times `t` (B,), within the input limits."""
        ...


class ViewBuilder:
    """Fills a `View` from a simulator's state.

    Where links come and go and no messages are exchanged, a neighbour is known while its link is up; in designs
    without relays, which estimate neighbours, too, it is estimated meanwhile.

    Args:
        design: who sends to whom.
        observers: their layout has a place for every estimate.
        task: the task graph on the same nodes.
        observe: source of the states of k-hop targets: their "estimate", the true states ("oracle"), or none ("local").
        num_envs: number of environments.
    """

    def __init__(
        self, design: ObserverDesign, observers: Observers, task: nx.Graph, observe: Observe, num_envs: int
    ) -> None:
        fleet = design.fleet
        edges = np.array(sorted([*task.edges, *((j, i) for i, j in task.edges)]), np.int64).reshape(-1, 2)
        position, offset = fleet.position_index, fleet.state_offset
        self._own = np.ascontiguousarray(position[edges[:, 0]])
        self._other = np.ascontiguousarray(position[edges[:, 1]])
        self._kind = np.zeros(len(edges), np.int64)
        self._design, self._observers = design, observers
        changing = design.schedule is not None and not observers.by_messages and observe != "oracle"
        self._received = ReceivedStates(design, observers, num_envs) if changing else None
        link = np.full(len(edges), -1)
        for number, (i, j) in enumerate(edges.tolist()):
            neighbor = (j, i) in design.links.index
            if neighbor and changing and (observe == "local" or (i, j) not in observers.layout.slot):
                link[number] = design.links.index[j, i]
                continue
            if observe == "oracle" or (neighbor and not observers.by_messages and not changing):
                continue
            if observe == "estimate" or neighbor:
                self._kind[number] = 1
                self._other[number] += observers.layout.slot[i, j] - offset[j]
            else:
                self._kind[number] = 2
        self._gated = np.flatnonzero(link >= 0)
        self._link = link[self._gated]
        self._known = np.repeat(self._kind[:, None] < 2, num_envs, axis=1)
        self._columns = np.zeros((len(edges), fleet.position_dim, num_envs))
        self.view = View(
            fleet=fleet,
            x=np.zeros((num_envs, fleet.n)),
            edges=read_only(edges[:]),
            known=read_only(self._known.T),
            displacement=read_only(self._columns.transpose(2, 0, 1)),
        )

    def edge_arrays(self) -> EdgeArrays | None:
        """Edges and sources for the compiled loop; None where sources change with links."""
        if self._received is not None:
            return None
        return EdgeArrays.of(self.view.fleet, self.view.edges, self._kind, self._own, self._other)

    def update(self, state: PlantState) -> View:
        """The view at a state."""
        x, estimate = state.x, state.memory["estimate"]
        up = None
        if self._received is not None:
            up = links_up(self._design, self._observers, state)
            estimate = self._received.states(state, up)
        displacements(self._kind, self._own, self._other, x, estimate, self._columns, 0, x.shape[1])
        if up is not None:
            self._known[self._gated] = known = up[self._link]
            self._columns[self._gated] = np.where(known[:, None], self._columns[self._gated], 0.0)
        view = self.view
        # made once, and again in a copy of this object, whose views would be of the original's arrays
        if view.x.base is not x:
            view.x = read_only(x.T)
        if view.displacement.base is not self._columns:
            view.displacement = read_only(self._columns.transpose(2, 0, 1))
        if view.known.base is not self._known:
            view.known = read_only(self._known.T)
        return view
