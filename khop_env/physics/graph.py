"""Communication and task graphs, hop distances and k-hop neighbours.

The paper's graph G = (V, E): agents are the nodes 0..N-1, an edge joins two neighbours, which exchange messages. In a
directed graph an edge b -> a is a link: agent a hears agent b.
"""

from __future__ import annotations

import heapq
from collections.abc import Iterable

import networkx as nx
import numpy as np
from numpy.typing import NDArray

from khop_env.physics.agent_model import FloatArray

_LISTED = 8  # entries of a long list that an error message lists


def validate_graph(
    graph: nx.Graph,
    agents: int,
    name: str = "communication graph",
    connected: bool = True,
    directed: bool = False,
) -> nx.Graph:
    """Check that a graph satisfies the paper's Assumption 3, or our extension of it, with the agents as nodes.

    Args:
        graph: A simple graph with the nodes 0..agents-1.
        agents: Number of agents N.
        name: Name of the graph in error messages.
        connected: Whether the graph must be connected, a directed one weakly; the theorems require it of the
            communication graph.
        directed: Whether it may be a networkx.DiGraph.

    Returns:
        A frozen copy with its nodes in increasing order, so that matrices made from it are in the agents' order.

    Raises:
        ValueError: The graph is directed where it may not be, or a multigraph, has other nodes, has a self-loop or
            isn't connected.
    """
    if not isinstance(graph, nx.Graph):
        raise ValueError(f"{name}: expected a networkx.Graph, got {graph!r}")
    if graph.is_multigraph() or (graph.is_directed() and not directed):
        expected = "a simple networkx.Graph or DiGraph" if directed else "an undirected simple networkx.Graph"
        raise ValueError(f"{name}: expected {expected}, got a {type(graph).__name__}")
    missing = [node for node in range(agents) if node not in graph]
    unexpected = [node for node in graph if not (isinstance(node, int | np.integer) and 0 <= node < agents)]
    if missing or unexpected:
        wrong = [f"missing {_listed(missing)}"] * bool(missing) + [f"unexpected {_listed(unexpected)}"] * bool(
            unexpected
        )
        hint = "" if unexpected else f"; graph.add_nodes_from(range({agents})) adds agents without edges"
        raise ValueError(f"{name}: the nodes must be exactly the integers 0 to {agents - 1}; {', '.join(wrong)}{hint}")
    loops = list(nx.selfloop_edges(graph))
    if loops:
        raise ValueError(f"{name}: an agent can't be its own neighbour; remove the self-loops {_listed(loops)}")
    both_ways = graph.to_undirected(as_view=True) if graph.is_directed() else graph
    if connected and not nx.is_connected(both_ways):
        parts = [f"{{{_listed(sorted(part))}}}" for part in sorted(nx.connected_components(both_ways), key=min)]
        raise ValueError(f"{name}: must be connected, but falls into {len(parts)} components: {_listed(parts)}")
    tidy = nx.DiGraph() if graph.is_directed() else nx.Graph()
    tidy.add_nodes_from(range(agents))
    edges = [(int(i), int(j)) for i, j in graph.edges]
    tidy.add_edges_from(sorted(edges if graph.is_directed() else ((min(edge), max(edge)) for edge in edges)))
    return nx.freeze(tidy)


def one_way_links(graph: nx.Graph) -> list[tuple[int, int]]:
    """The links (sender, receiver) of a graph without a link back, sorted; none if it is undirected."""
    return sorted((b, a) for b, a in graph.edges if not graph.has_edge(a, b))


def hop_distances(graph: nx.Graph, cutoff: int) -> list[dict[int, int]]:
    """Graph distances up to `cutoff`, by breadth-first search, along the links of a directed graph.

    Args:
        graph: A validated graph on 0..N-1.
        cutoff: Largest distance of interest, in hops.

    Returns:
        For each agent, {agent: distance} of the agents that it reaches within `cutoff` hops, itself included at 0,
        nearest first.

    Raises:
        ValueError: The cutoff isn't an integer.
    """
    _require_hops(cutoff)
    neighbors = [list(graph.adj[node]) for node in range(len(graph))]
    sets = [frozenset(adjacent) for adjacent in neighbors]
    return [_reached_from(source, cutoff, neighbors, sets) for source in range(len(neighbors))]


def hops_from_targets(graph: nx.Graph, cutoff: int) -> list[dict[int, int]]:
    """For each agent, {target: distance} of the agents that reach it within `cutoff` hops, itself included at 0.

    In an undirected graph these are `hop_distances`; in a directed one an agent may be known to others that it doesn't
    know.

    Raises:
        ValueError: The cutoff isn't an integer.
    """
    return hop_distances(graph.reverse() if graph.is_directed() else graph, cutoff)


def _reached_from(source: int, cutoff: int, neighbors: list[list[int]], sets: list[frozenset[int]]) -> dict[int, int]:
    """{agent: distance} from one source. Few edges of a dense graph lead to new agents; sets find them quickly."""
    found = {source: 0}
    frontier = [source]
    for hops in range(1, cutoff + 1):
        reached: list[int] = []
        for node in frontier:
            if len(found) == len(neighbors):
                return found
            fresh = sets[node].difference(found)
            if fresh:
                reached += [neighbor for neighbor in neighbors[node] if neighbor in fresh]  # the order of the edges
                found.update(dict.fromkeys(reached[-len(fresh) :], hops))
        if not reached:
            break
        frontier = reached
    return found


def k_hop_neighbors(graph: nx.Graph, k: int, relay: bool = True) -> tuple[tuple[int, ...], ...]:
    """The paper's k-hop neighbours of each agent: the agents that estimate it.

    In an undirected graph these are also the agents that it estimates.

    Args:
        graph: A validated graph on 0..N-1.
        k: Largest distance in hops.
        relay: Whether agents relay their neighbours' states (Assumption 4). If not, direct neighbours are
            estimated too (Remark 2).

    Returns:
        For each agent, sorted: the agents that it reaches at distance 2..k, or 1..k without relay.

    Raises:
        ValueError: k isn't an integer, or leaves nothing to estimate: below 2, or below 1 without relay.
    """
    _require_hops(k)
    nearest = 2 if relay else 1
    if k < nearest:
        raise ValueError(f"k must be at least {nearest} {'with' if relay else 'without'} relay; got {k!r}")
    return tuple(
        tuple(sorted(agent for agent, hops in found.items() if hops >= nearest)) for found in hop_distances(graph, k)
    )


def check_task_graph(task: nx.Graph, communication: nx.Graph, k: int) -> nx.Graph:
    """Check that the two agents of each task edge know each other: each is at most k hops from the other.

    Args:
        task: Pairs of agents that a task relates; needn't be connected.
        communication: A validated communication graph.
        k: Number of hops up to which agents receive or estimate each other's states.

    Returns:
        The task graph, validated.

    Raises:
        ValueError: The task graph is malformed, or has edges between agents more than k hops apart.
    """
    task = validate_graph(task, len(communication), name="task graph", connected=False)
    within = hop_distances(communication, k)
    far = [edge for edge in task.edges if edge[1] not in within[edge[0]]]
    if communication.is_directed():
        far = [(i, j) for edge in task.edges for i, j in (edge, edge[::-1]) if i not in within[j]]
        listed = [f"{i} from {j}, at distance {_distance(communication, j, i)}" for i, j in far[:_LISTED]]
        if far:
            rest = f" and {len(far) - _LISTED} more" if len(far) > _LISTED else ""
            raise ValueError(
                f"task graph: both agents of an edge act on it, so that each has to be reached from the other within "
                f"k = {k} hops along the links; these aren't: {', '.join(listed)}{rest}; remove the edges, add links "
                "or take a larger k"
            )
    if far:
        listed = [f"{edge} at distance {_distance(communication, *edge)}" for edge in far[:_LISTED]]
        rest = f" and {len(far) - _LISTED} more" if len(far) > _LISTED else ""
        raise ValueError(
            f"task graph: edges join agents that know nothing of each other, more than k = {k} hops apart: "
            f"{', '.join(listed)}{rest}"
        )
    return task


def paper_tree() -> nx.Graph:
    """A communication graph for the paper's 8-agent simulation, numbered from 0.

    The figure isn't in the paper's text. Its published constants fix agent 4 (here 3): rho(inf) / delta(inf) =
    0.02 / 0.117 = lambda_min(M_4) / sqrt(eta_4) with eta_4 = 5 and lambda_min(M_4) = (3 - sqrt(5)) / 2. The path
    1-2-...-7 with agent 8 attached to 5 has exactly this for k = 3; other graphs have it too, so this is our choice.
    """
    return nx.Graph([*((i, i + 1) for i in range(6)), (4, 7)])


def random_geometric_graph(agents: int, mean_degree: float, rng: np.random.Generator) -> tuple[nx.Graph, FloatArray]:
    """Agents scattered over a square, joined to those in range and, so that all are connected, along a shortest tree.

    Points are uniform on a square of side sqrt(N), one agent per unit area. Two are joined if they are closer
    than sqrt(mean_degree / pi), or neighbours in the Euclidean minimum spanning tree.

    Args:
        agents: Number of agents N.
        mean_degree: Expected number of agents in range of an agent far from the border; the border lowers the mean,
            the tree raises it.
        rng: Source of the positions.

    Returns:
        The graph, and the positions, shape (N, 2), in units in which the density is 1.

    Raises:
        ValueError: There are no agents, or the mean degree isn't positive.

    Source: M. Penrose, Random Geometric Graphs, 2003.
    """
    if agents < 1 or not mean_degree > 0:
        raise ValueError(f"expected at least one agent and a positive mean degree; got {agents} and {mean_degree}")
    points = rng.uniform(0.0, np.sqrt(agents), (agents, 2))
    graph = nx.Graph()
    graph.add_nodes_from(range(agents))
    row, column, _ = _pairs_within(points, mean_degree / np.pi)
    graph.add_edges_from(zip(row.tolist(), column.tolist(), strict=True))
    graph.add_edges_from(_minimum_spanning_tree(points))
    return graph, points


def _pairs_within(points: FloatArray, radius2: float) -> tuple[NDArray[np.int64], NDArray[np.int64], FloatArray]:
    """Pairs i < j of points less than a radius apart, sorted, and their squared distances.

    Squares of a grid are no narrower than the radius, so that a point's partners are in its own square and the eight
    around it: time and memory grow with the number of points, not with its square, while the radius stays the same.
    """
    width = max(np.sqrt(radius2) * (1.0 + 1e-9), 1.0)  # more than the radius, however it is rounded; few empty squares
    square = np.floor(points / width).astype(np.int64)
    stride = int(square[:, 1].max()) + 3  # a margin: squares outside the others are empty
    key = (square[:, 0] + 1) * stride + square[:, 1] + 1
    order = np.argsort(key, kind="stable")
    ordered = key[order]
    found = []
    for step in (-stride, 0, stride):  # three squares above each other are next to each other in `ordered`
        first = np.searchsorted(ordered, key + step - 1, "left")
        count = np.searchsorted(ordered, key + step + 1, "right") - first
        row = np.repeat(np.arange(len(points)), count)
        column = order[np.arange(len(row)) + np.repeat(first - np.cumsum(count) + count, count)]
        row, column = row[column > row], column[column > row]
        away = points[row] - points[column]
        distance2 = away[:, 0] * away[:, 0] + away[:, 1] * away[:, 1]
        near = distance2 < radius2
        found.append((row[near], column[near], distance2[near]))
    row, column, distance2 = (np.concatenate(parts) for parts in zip(*found, strict=True))
    order = np.lexsort((column, row))
    return row[order], column[order], distance2[order]


def _minimum_spanning_tree(points: FloatArray) -> list[tuple[int, int]]:
    """Edges of the Euclidean minimum spanning tree, from the tree's agent to the new one, by Prim's algorithm.

    It needs short edges only: those within the smallest of a sequence of radii at which all agents are connected.
    """
    radius2 = 2.0  # where agents have unit density, six are within
    while True:
        edges = _tree_of(len(points), *_pairs_within(points, radius2))
        if len(edges) == len(points) - 1:
            return edges
        radius2 *= 2.0


def _tree_of(
    agents: int, row: NDArray[np.int64], column: NDArray[np.int64], distance2: FloatArray
) -> list[tuple[int, int]]:
    """The minimum spanning tree of what agent 0 reaches along these edges; of agents as close the lower ones first."""
    near: list[list[tuple[int, float]]] = [[] for _ in range(agents)]
    for a, b, away2 in zip(row.tolist(), column.tolist(), distance2.tolist(), strict=True):
        near[a].append((b, away2))
        near[b].append((a, away2))
    closest, parent = [np.inf] * agents, [0] * agents  # squared distance to the tree; -1 inside it
    edges, waiting = list[tuple[int, int]](), [(0.0, 0)]
    while waiting:
        _, newest = heapq.heappop(waiting)
        if closest[newest] < 0.0:
            continue
        closest[newest] = -1.0
        if newest:
            edges.append((parent[newest], newest))
        for agent, away2 in near[newest]:
            if away2 < closest[agent]:
                closest[agent], parent[agent] = away2, newest
                heapq.heappush(waiting, (away2, agent))
    return edges


def _require_hops(k: object) -> None:
    if isinstance(k, bool | np.bool) or not isinstance(k, int | np.integer):
        raise ValueError(f"k must be an integer, a number of hops; got {k!r}")


def _distance(graph: nx.Graph, a: int, b: int) -> str:
    return str(nx.shortest_path_length(graph, a, b)) if nx.has_path(graph, a, b) else "infinity (no path)"


def _listed(items: Iterable[object]) -> str:
    items = list(items)
    text = ", ".join(map(str, items[:_LISTED]))
    return f"{text} and {len(items) - _LISTED} more" if len(items) > _LISTED else text
