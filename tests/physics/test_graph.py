"""Graphs and k-hop sets, against networkx and against the paper's constants."""

import math

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from khop_env.physics import (
    check_task_graph,
    hop_distances,
    hops_from_targets,
    k_hop_neighbors,
    one_way_links,
    paper_tree,
    random_geometric_graph,
    validate_graph,
)

GRAPHS = st.builds(
    lambda n, p, seed: nx.gnp_random_graph(n, p, seed=seed),
    st.integers(1, 14),
    st.floats(0, 0.5),
    st.integers(0, 10**6),
)


@given(graph=GRAPHS, cutoff=st.integers(0, 6))
def test_hop_distances_are_shortest_paths(graph: nx.Graph, cutoff: int) -> None:
    assert hop_distances(graph, cutoff) == [found for _, found in nx.all_pairs_shortest_path_length(graph, cutoff)]


@given(graph=GRAPHS)
def test_hop_distances_list_agents_as_a_search_along_the_edges_meets_them(graph: nx.Graph) -> None:
    """Generated scenarios draw from these lists, so that their order decides what a seed gives."""
    for source, found in enumerate(hop_distances(graph, len(graph))):
        assert list(found) == [source, *(agent for _, agent in nx.bfs_edges(graph, source))]


def test_a_dense_graph_is_searched_no_longer_than_somebody_is_left() -> None:
    assert hop_distances(nx.complete_graph(1500), 10**9)[7] == {7: 0, **dict.fromkeys({*range(1500)} - {7}, 1)}


@given(graph=GRAPHS, k=st.integers(2, 6))
def test_k_hop_neighbors_are_those_at_distance_2_to_k(graph: nx.Graph, k: int) -> None:
    distance = dict(nx.all_pairs_shortest_path_length(graph))
    for nearest, relay in ((2, True), (1, False)):
        expected = tuple(tuple(j for j in graph if nearest <= distance[i].get(j, math.inf) <= k) for i in graph)
        assert k_hop_neighbors(graph, k, relay) == expected


DIGRAPHS = st.builds(
    lambda n, p, seed: nx.gnp_random_graph(n, p, seed=seed, directed=True),
    st.integers(1, 14),
    st.floats(0, 0.5),
    st.integers(0, 10**6),
)


@given(graph=DIGRAPHS, k=st.integers(2, 6))
def test_hops_in_a_directed_graph_follow_the_links(graph: nx.DiGraph, k: int) -> None:
    """From a target to those that estimate it, and for an observer from the agents that reach it."""
    distance = dict(nx.all_pairs_shortest_path_length(graph, k))
    assert hop_distances(graph, k) == [distance[i] for i in graph]
    assert hops_from_targets(graph, k) == [{j: distance[j][i] for j in graph if i in distance[j]} for i in graph]
    for nearest, relay in ((2, True), (1, False)):
        expected = tuple(tuple(j for j in graph if distance[i].get(j, 0) >= nearest) for i in graph)
        assert k_hop_neighbors(graph, k, relay) == expected
    assert one_way_links(graph) == sorted((i, j) for i, j in graph.edges if (j, i) not in graph.edges)


def test_a_directed_graph_is_validated_where_it_is_allowed() -> None:
    """Weakly connected, so that a link may lead to agents that lead nowhere; direction and order are kept."""
    tidy = validate_graph(nx.DiGraph([(3, 1), (1, 0), (0, 1), (0, 2)]), 4, directed=True)
    assert list(tidy) == [0, 1, 2, 3]
    assert list(tidy.edges) == [(0, 1), (0, 2), (1, 0), (3, 1)]
    assert one_way_links(tidy) == [(0, 2), (3, 1)]
    with pytest.raises(ValueError, match=r"falls into 2 components: \{0, 1\}, \{2, 3\}"):
        validate_graph(nx.DiGraph([(0, 1), (3, 2)]), 4, directed=True)
    with pytest.raises(ValueError, match=r"expected a simple networkx.Graph or DiGraph, got a MultiDiGraph"):
        validate_graph(nx.MultiDiGraph([(0, 1)]), 2, directed=True)


def test_task_edges_on_a_directed_graph_need_both_directions() -> None:
    ring = validate_graph(nx.cycle_graph(6, create_using=nx.DiGraph), 6, directed=True)
    opposite = nx.empty_graph(6)
    opposite.add_edges_from([(0, 3), (1, 4)])
    assert set(check_task_graph(opposite, ring, 3).edges) == {(0, 3), (1, 4)}
    with pytest.raises(ValueError, match=r"k = 2 hops.*: 0 from 3, at distance 3, 3 from 0, .*add links"):
        check_task_graph(opposite, ring, 2)


def test_direct_neighbors_of_a_triangle_are_not_two_hops_away() -> None:
    assert k_hop_neighbors(nx.complete_graph(3), 2) == ((), (), ())
    assert k_hop_neighbors(nx.complete_graph(3), 1, relay=False) == ((1, 2), (0, 2), (0, 1))


def test_k_that_leaves_nothing_is_refused() -> None:
    with pytest.raises(ValueError, match="k must be at least 2 with relay; got 1"):
        k_hop_neighbors(nx.path_graph(4), 1)
    with pytest.raises(ValueError, match="k must be at least 1 without relay; got 0"):
        k_hop_neighbors(nx.path_graph(4), 0, relay=False)


@pytest.mark.parametrize("k", [2.5, True, "3", None])
def test_k_that_is_no_integer_is_refused(k: object) -> None:
    path = nx.path_graph(4)
    for call in (
        lambda: hop_distances(path, k),
        lambda: k_hop_neighbors(path, k),
        lambda: check_task_graph(path, path, k),
    ):
        with pytest.raises(ValueError, match="k must be an integer, a number of hops; got"):
            call()


def test_a_huge_k_takes_no_longer_than_the_graph_is_wide() -> None:
    assert k_hop_neighbors(nx.path_graph(4), 2 * 10**9) == ((2, 3), (3,), (0,), (0, 1))
    assert k_hop_neighbors(nx.path_graph(4), np.int64(3)) == ((2, 3), (3,), (0,), (0, 1))


def test_validated_graph_has_its_nodes_in_order_and_is_frozen() -> None:
    graph = nx.Graph([(3, 1), (np.int64(1), np.int64(0)), (0, 2)])
    tidy = validate_graph(graph, 4)
    assert list(tidy) == [0, 1, 2, 3]
    assert nx.is_isomorphic(tidy, graph)
    assert set(tidy.edges) == {(0, 1), (0, 2), (1, 3)}
    with pytest.raises(nx.NetworkXError):
        tidy.add_edge(2, 3)
    assert list(validate_graph(nx.empty_graph(1), 1)) == [0]


@pytest.mark.parametrize(
    ("graph", "message"),
    [
        ([(0, 1)], "expected a networkx.Graph, got"),
        (nx.DiGraph([(0, 1), (1, 2), (2, 3)]), "undirected simple networkx.Graph, got a DiGraph"),
        (nx.MultiGraph([(0, 1), (1, 2), (2, 3)]), "undirected simple networkx.Graph, got a MultiGraph"),
        (nx.path_graph([1, 2, 3, 4]), "integers 0 to 3; missing 0, unexpected 4"),
        (nx.path_graph(["0", "1", "2", "3"]), "missing 0, 1, 2, 3, unexpected 0, 1, 2, 3"),
        (nx.path_graph(20), "unexpected 4, 5, 6, 7, 8, 9, 10, 11 and 8 more"),
        (nx.Graph([(0, 1), (1, 2), (2, 3), (2, 2)]), r"remove the self-loops \(2, 2\)"),
        (nx.Graph([(0, 1), (2, 3)]), r"falls into 2 components: \{0, 1\}, \{2, 3\}"),
    ],
)
def test_malformed_graphs_are_refused(graph: nx.Graph, message: str) -> None:
    with pytest.raises(ValueError, match="communication graph: .*" + message):
        validate_graph(graph, 4)


def test_a_graph_may_be_disconnected_where_that_is_allowed() -> None:
    assert validate_graph(nx.empty_graph(3), 3, connected=False).number_of_edges() == 0


def test_task_edges_must_be_within_k_hops() -> None:
    line = nx.path_graph(6)
    task = nx.empty_graph(6)
    task.add_edges_from([(0, 1), (0, 3)])
    assert set(check_task_graph(task, line, 3).edges) == {(0, 1), (0, 3)}
    task.add_edges_from([(0, 4), (5, 0)])
    with pytest.raises(ValueError, match=r"k = 3 hops apart: \(0, 4\) at distance 4, \(0, 5\) at distance 5"):
        check_task_graph(task, line, 3)
    with pytest.raises(ValueError, match=r"missing 4, 5; graph\.add_nodes_from\(range\(6\)\) adds agents"):
        check_task_graph(nx.path_graph(4), line, 3)


def test_paper_tree_reproduces_agent_4s_published_constants() -> None:
    graph = validate_graph(paper_tree(), 8)
    assert nx.is_tree(graph)
    observers = k_hop_neighbors(graph, 3)[3]
    among = graph.subgraph(observers)
    laplacian = nx.laplacian_matrix(among, nodelist=observers).toarray()
    common = [len(set(graph[j]) & set(graph[3])) for j in observers]
    smallest = np.linalg.eigvalsh(laplacian + np.diag(common))[0]
    assert len(observers) == 5
    assert smallest == pytest.approx((3 - math.sqrt(5)) / 2)
    assert smallest / math.sqrt(5) == pytest.approx(0.02 / 0.117, rel=1e-3)


@settings(max_examples=30)
@given(agents=st.integers(1, 60), mean_degree=st.floats(0.01, 20), seed=st.integers(0, 10**6))
def test_geometric_graph_is_the_disk_graph_and_the_spanning_tree(agents: int, mean_degree: float, seed: int) -> None:
    graph, points = random_geometric_graph(agents, mean_degree, np.random.default_rng(seed))
    assert points.shape == (agents, 2)
    assert ((points >= 0) & (points <= math.sqrt(agents))).all()
    validate_graph(graph, agents)
    distance = np.linalg.norm(points[:, None] - points[None], axis=-1)
    complete = nx.from_numpy_array(distance)
    tree = {tuple(sorted(edge)) for edge in nx.minimum_spanning_edges(complete, data=False)}
    disk = {(i, j) for i in range(agents) for j in range(i) if distance[i, j] < math.sqrt(mean_degree / math.pi)}
    assert {tuple(sorted(edge)) for edge in graph.edges} == tree | {edge[::-1] for edge in disk}


def test_geometric_graph_has_about_the_mean_degree_and_follows_its_generator() -> None:
    graph, points = random_geometric_graph(3000, 8.0, np.random.default_rng(1))
    assert 2 * graph.number_of_edges() / 3000 == pytest.approx(8.0, rel=0.06)
    again, same = random_geometric_graph(3000, 8.0, np.random.default_rng(1))
    assert set(graph.edges) == set(again.edges)
    np.testing.assert_array_equal(points, same)


@pytest.mark.parametrize(("agents", "mean_degree"), [(0, 3.0), (5, 0.0), (5, math.nan)])
def test_geometric_graph_refuses_nonsense(agents: int, mean_degree: float) -> None:
    with pytest.raises(ValueError, match="at least one agent and a positive mean degree"):
        random_geometric_graph(agents, mean_degree, np.random.default_rng(0))


@settings(max_examples=60, deadline=None)
@given(
    agents=st.integers(1, 80), mean_degree=st.floats(0.5, 15) | st.sampled_from([1e-30, 1e9]), seed=st.integers(0, 99)
)
def test_geometric_graphs_have_their_edges_in_order_of_all_pairs(agents: int, mean_degree: float, seed: int) -> None:
    """Row by row, then along the tree as Prim's algorithm finds it: task graphs are drawn from this order."""
    graph, points = random_geometric_graph(agents, mean_degree, np.random.default_rng(seed))
    away2 = ((points[:, None] - points[None]) ** 2).sum(axis=-1)
    expected = nx.empty_graph(agents)
    expected.add_edges_from(
        (i, j) for i in range(agents) for j in range(i + 1, agents) if away2[i, j] < mean_degree / np.pi
    )
    inside = [0]
    while len(inside) < agents:
        outside = [j for j in range(agents) if j not in inside]
        parent, new = min(((i, j) for j in outside for i in inside), key=lambda edge: away2[edge])
        expected.add_edge(parent, new)
        inside.append(new)
    assert [list(graph.adj[i]) for i in range(agents)] == [list(expected.adj[i]) for i in range(agents)]
