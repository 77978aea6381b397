"""A family of generated fleets of any size, for scaling and for training on many graphs."""

from __future__ import annotations

import math

import networkx as nx
import numpy as np

from khop_env.collection import collection_paused
from khop_env.observers import Exponential
from khop_env.physics import SingleIntegrator, Sinusoid, hop_distances, random_geometric_graph
from khop_env.scenarios.scenario import MOST_AGENTS, LawChoice, Scenario

MEAN_DEGREE = 5.0
GAIN = 2.0
RATE = 5.0  # 1/s, the paper's


@collection_paused()
def random_geometric(agents: int = 100, k: int = 2, seed: int = 0, rate: float = RATE) -> Scenario:
    """Single integrators on a random geometric graph, each to agree with neighbours and with a k-hop target.

    Agents are uniform points at unit density; their communication range makes the mean degree about 5, and they are
    connected by construction: the Euclidean minimum spanning tree is added. The task graph is a spanning tree of
    communication edges, so that the team can agree, and for every agent an edge to a random k-hop target. The bounds'
    initial values are sized from the initial set, so that every member of the family is feasible.

    Args:
        agents: N, from 4 to 10 000 and more.
        k: agents up to k hops away are estimated, at least 2.
        seed: of the positions and of the task graph.
        rate: decay rate of the bounds on estimation errors, in 1/s.

    Raises:
        ValueError: for fewer than 4 agents or more than 100 000, k below 2, a negative or huge seed, or a rate that
            isn't positive.
    """
    for name, value, least, most in (
        ("agents", agents, 4, MOST_AGENTS),
        ("k", k, 2, 2**63),
        ("seed", seed, 0, 2**63),
    ):
        if isinstance(value, bool) or not isinstance(value, int | np.integer):
            raise ValueError(f"random_geometric: {name} must be an integer; got {value!r}")
        if not least <= value <= most:
            bound = f"at least {least}" if value < least else f"at most {most}"
            raise ValueError(f"random_geometric: {name} must be {bound}; got {name}={value}")
    if not 0.0 < rate < math.inf:
        raise ValueError(f"random_geometric needs a positive, finite rate; got rate={rate}")
    rng = np.random.default_rng(seed)
    communication, _ = random_geometric_graph(agents, MEAN_DEGREE, rng)
    task = nx.Graph(nx.bfs_edges(communication, 0))
    task.add_nodes_from(range(agents))
    for i, reached in enumerate(hop_distances(communication, k)):
        targets = [j for j, hops in reached.items() if hops >= 2]
        if targets:
            task.add_edge(i, int(rng.choice(targets)))
    most_edges = max(degree for _, degree in task.degree)
    return Scenario(
        name=f"random_geometric:agents={agents},k={k},seed={seed}" + (f",rate={rate:g}" if rate != RATE else ""),
        description=f"{agents} single integrators on a random geometric graph, k = {k}, seed {seed}",
        models=(SingleIntegrator(input_limit=GAIN * most_edges),) * agents,
        communication=communication,
        task=task,
        k=k,
        delta=Exponential(1.0, 0.1, rate),
        theta=Exponential(1.0, 1.0, rate),
        disturbance=Sinusoid(0.3, frequency=(0.5, 2.0)),
        radius=1.5,
        law=LawChoice("tanh", {"gain": GAIN}),
    ).sized()
