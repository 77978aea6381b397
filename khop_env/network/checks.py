"""Values of schedules as users write them: graphs, the links that they have, and numbers."""

from __future__ import annotations

import math
from collections.abc import Sequence

import networkx as nx
import numpy as np

from khop_env.network.reading import Span, number
from khop_env.physics import Links


def graph_of(edges: object, directed: bool, what: str) -> nx.Graph:
    """A graph from a list of edges, which it keeps as it is if it is a graph already."""
    if isinstance(edges, nx.Graph):
        return edges
    if not isinstance(edges, Sequence) or not all(
        isinstance(edge, Sequence) and len(edge) == 2 and all(map(is_index, edge)) for edge in edges
    ):
        raise ValueError(f"{what} must be a list of edges [i, j] between agents' indices; got {edges!r}")
    graph = nx.DiGraph() if directed else nx.Graph()
    graph.add_edges_from(tuple(edge) for edge in edges)
    return graph


def mask_of(links: Links, graph: nx.Graph, what: str) -> np.ndarray:
    """(L,) the links of a graph among all.

    Raises:
        ValueError: naming those that the communication graph doesn't have.
    """
    edges = list(graph.edges)
    if not graph.is_directed():
        edges += [(j, i) for i, j in edges]
    absent = sorted(edge for edge in edges if edge not in links.index)
    if absent:
        raise ValueError(
            f"{what} has {len(absent)} link{'s' * (len(absent) > 1)} that the communication graph doesn't have, the "
            f"first from {absent[0][0]} to {absent[0][1]}; the communication graph has all links that may ever be up: "
            "add them to it"
        )
    mask = np.zeros(len(links), np.bool_)
    mask[[links.index[edge] for edge in edges]] = True
    return mask


def require_graph(graph: object, what: str) -> None:
    """Refuse what isn't a graph of agents' indices.

    Raises:
        ValueError: naming `what`.
    """
    if not isinstance(graph, nx.Graph) or graph.is_multigraph():
        raise ValueError(f"{what} must be a networkx.Graph or DiGraph of agents' indices; got {graph!r}")
    wrong = [node for node in graph if not is_index(node)]
    if wrong:
        raise ValueError(f"{what}: nodes must be agents' indices; got {wrong[0]!r}")


def require_bools(schedule: object, *names: str) -> None:
    """Refuse attributes that aren't True or False.

    Raises:
        ValueError: naming the first.
    """
    for name in names:
        if not isinstance(getattr(schedule, name), bool | np.bool):
            raise ValueError(f"{type(schedule).__name__}.{name} must be True or False; got {getattr(schedule, name)!r}")


def positive(value: object, what: str, unit: str) -> float:
    """A positive, finite number; `what` it is, in its `unit`, for error messages.

    Raises:
        ValueError: for anything else.
    """
    found = number(value, what)
    if not 0.0 < found < math.inf:
        raise ValueError(f"{what} must be positive and finite, in {unit}; got {value!r}")
    return found


def is_index(value: object) -> bool:
    """Whether a value can be an agent's index."""
    return isinstance(value, int | np.integer) and not isinstance(value, bool) and bool(value >= 0)


def bounds_of(value: Span) -> tuple[float, float]:
    """Lowest and highest value of a number or a range."""
    return value if isinstance(value, tuple) else (value, value)
