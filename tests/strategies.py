"""Random test cases: connected graphs, mixed fleets, funnels that their initial set fits into, and whole systems.

The paper's definitions are written out here once more, from the graph alone (networkx), for tests to compare with.
"""

from __future__ import annotations

import functools
import operator
from dataclasses import dataclass
from typing import get_args

import networkx as nx
import numpy as np
from hypothesis import strategies as st

from khop_env.network import Fixed, Network, Outage, RandomLinks, Range, Schedule, Switching
from khop_env.observers import DesignRule, Exponential, Funnels, ObserverDesign, Observers, PairLayout, TargetObservers
from khop_env.physics import (
    BandLimitedNoise,
    Coupling,
    DoubleIntegrator,
    DriftingIntegrator,
    Fleet,
    Gust,
    SingleIntegrator,
    Sinusoid,
    Sum,
    SurfaceVessel,
    Unicycle,
)
from khop_env.simulation import InitialSet, Simulator, View

SEEDS = st.integers(0, 2**32 - 1)
NETWORKS = st.builds(
    lambda loss, burst, latency, jitter, period: Network(
        period,
        loss,
        None if burst is None else tuple(max(each, loss[1] / (1.0 - loss[1])) for each in burst),
        latency,
        tuple(min(each, latency[0]) for each in jitter),
    ),
    loss=st.tuples(st.floats(0, 0.45), st.floats(0.45, 0.9)),
    burst=st.sampled_from([None, (1.0, 1.0), (1.0, 5.0), (5.0, 20.0)]),
    latency=st.tuples(st.floats(0, 0.2), st.floats(0.2, 0.4)),
    jitter=st.tuples(st.floats(0, 0.1), st.floats(0.1, 0.2)),
    period=st.sampled_from([0.005, 0.05, 0.1]),
)
PLANAR = (
    SingleIntegrator(),
    DriftingIntegrator(input_limit=3.0),
    DoubleIntegrator(),
    DoubleIntegrator(2.0, input_limit=4.0),
    SurfaceVessel(),
    Unicycle(),
)
OBSERVABLE_INPUT = tuple(model for model in PLANAR if not model.input_map_uses_state)


# -- the paper's definitions, from the graph alone -----------------------------------------------------------------


def heard(graph: nx.Graph, agent: int) -> set[int]:
    """The agents whose messages an agent receives: its neighbours, or those with a link to it."""
    return set(graph.predecessors(agent) if graph.is_directed() else graph[agent])


def k_hop_sets(graph: nx.Graph, k: int, relay: bool) -> list[set[int]]:
    """N_i^{k-hop}: the agents at distance 2..k; from 1 on where Assumption 4 doesn't hold (remark after Lemma 1).

    Of a directed graph those that i reaches at that distance.
    """
    distance = dict(nx.all_pairs_shortest_path_length(graph))
    nearest = 2 if relay else 1
    return [{j for j, hop in distance[i].items() if nearest <= hop <= k} for i in sorted(graph)]


def relays(graph: nx.Graph, observer: int, target: int, relay: bool) -> int:
    """The diagonal of H_i: |N_a cap N_i|, or without relay whether a is a neighbour of i.

    Of a directed graph the number of agents that a hears and that hear i, or whether a hears i.
    """
    if relay:
        return sum(target in heard(graph, middle) for middle in heard(graph, observer))
    return int(target in heard(graph, observer))


def definition_of_m(graph: nx.Graph, members: list[int], target: int, relay: bool) -> np.ndarray:
    """M_i = L_i + H_i over `members`, the k-hop neighbours of the target in the order wanted."""
    adjacency = np.array([[float(other in heard(graph, member)) for other in members] for member in members])
    adjacency = adjacency.reshape(len(members), len(members))
    laplacian = np.diag(adjacency.sum(axis=1)) - adjacency
    return laplacian + np.diag([float(relays(graph, member, target, relay)) for member in members])


def observers_of(layout: PairLayout, index: int) -> list[int]:
    """The agents that estimate `layout.target[index]`, in the layout's order."""
    return layout.observer[layout.blocks[index].pairs].tolist()


# -- strategies ----------------------------------------------------------------------------------------------------


@st.composite
def connected_graphs(draw: st.DrawFn, smallest: int = 3, largest: int = 9) -> nx.Graph:
    """A random tree, each agent joined to an earlier one, and up to N more edges."""
    agents = draw(st.integers(smallest, largest))
    graph = nx.Graph()
    graph.add_nodes_from(range(agents))
    graph.add_edges_from((draw(st.integers(0, i - 1)), i) for i in range(1, agents))
    ends = st.tuples(st.integers(0, agents - 1), st.integers(0, agents - 1))
    graph.add_edges_from((i, j) for i, j in draw(st.lists(ends, max_size=agents)) if i != j)
    return graph


@st.composite
def digraphs(draw: st.DrawFn, smallest: int = 3, largest: int = 9) -> nx.DiGraph:
    """A connected graph of which each edge is a link one way or the other, or both."""
    graph = draw(connected_graphs(smallest, largest))
    links = nx.DiGraph()
    links.add_nodes_from(graph)
    for i, j in graph.edges:
        ways = draw(st.sampled_from([((i, j),), ((j, i),), ((i, j), (j, i))]))
        links.add_edges_from(ways)
    return links


@st.composite
def hops(draw: st.DrawFn, relay: bool | None = None) -> tuple[int, bool]:
    """k and whether neighbours relay; all k that leave something to estimate."""
    relay = draw(st.booleans()) if relay is None else relay
    return draw(st.integers(2 if relay else 1, 4)), relay


@st.composite
def schedules(draw: st.DrawFn, graph: nx.Graph) -> Schedule:
    """One to three schedules of a graph's links, of all kinds, joined."""

    def some_links() -> nx.Graph:
        part = nx.empty_graph(len(graph), create_using=type(graph))
        part.add_edges_from(edge for edge in graph.edges if draw(st.booleans()))
        return part

    period = draw(st.floats(np.log(0.05), np.log(20.0)).map(lambda exponent: float(np.exp(exponent))))
    share = st.floats(0.0, 1.0)
    chosen = []
    for kind in draw(st.lists(st.sampled_from(["fixed", "switching", "random", "range", "outage"]), max_size=3)):
        if kind == "fixed":
            chosen.append(Fixed(some_links()))
        elif kind == "switching":
            graphs = tuple(some_links() for _ in range(draw(st.integers(1, 4))))
            times = tuple(period * i for i in range(len(graphs)))
            chosen.append(Switching(graphs, period) if draw(st.booleans()) else Switching(graphs, None, times))
        elif kind == "random":
            both, low = draw(st.booleans()), draw(share)
            connected = both and not graph.is_directed() and draw(st.booleans())
            chosen.append(RandomLinks((low, draw(st.floats(low, 1.0))), both, connected))
        elif kind == "range":
            chosen.append(Range(draw(st.floats(0.3, 6.0))))
        else:
            where = draw(st.sampled_from(["agent", "link", "drawn"]))
            agent = draw(st.integers(0, len(graph) - 1)) if where == "agent" else None
            link = draw(st.sampled_from(sorted(graph.edges))) if where == "link" else None
            chosen.append(Outage((0.0, period), (0.0, period), agent, link))
    return functools.reduce(operator.and_, chosen or [Fixed()])


def exponentials(smallest: float = 1e-3, largest: float = 1e3) -> st.SearchStrategy[Exponential]:
    """Decreasing exponential performance functions."""
    sizes = st.floats(np.log(smallest), np.log(largest)).map(np.exp)
    return st.builds(lambda a, b, rate: Exponential(max(a, b), min(a, b), rate), sizes, sizes, st.floats(0.05, 20.0))


@dataclass(frozen=True, eq=False)
class System:
    """A fleet, its observers and disturbances, and where it starts.

    Attributes:
        design: observers whose funnels hold the whole initial set.
        initial: that set.
        disturbance: what acts on the agents.
        task: pairs of agents within k hops.
        deltas: per target the bounds that the design was given, one per component.
        thetas: likewise for inputs.
        seed: for whatever else a test draws.
    """

    design: ObserverDesign
    initial: InitialSet
    disturbance: Sum
    task: nx.Graph
    deltas: dict[int, list[Exponential]]
    thetas: dict[int, list[Exponential]]
    seed: int

    def simulator(self, observers: Observers, num_envs: int = 1, **options: object) -> Simulator:
        """A simulator of this system, reset with its seed."""
        simulator = Simulator(
            self.design,
            self.initial,
            disturbance=self.disturbance,
            task=self.task,
            observers=observers,
            num_envs=num_envs,
            **options,
        )
        return simulator.reset(self.seed)


def fitting(
    funnels: Funnels, radius: np.ndarray, rng: np.random.Generator, floor: float, margin: float
) -> dict[int, list[Exponential]]:
    """Per target one bound a component: `margin` to 5 times the smallest feasible delta(0), decaying to `floor` or
    above.
    """
    smallest = np.maximum(funnels.smallest_initial_bound(radius), 2.0 * floor)
    bounds: dict[int, list[Exponential]] = {}
    for block in funnels.layout.blocks:
        n = block.components
        initial = smallest[block.rows] * np.exp(rng.uniform(np.log(margin), np.log(5.0), n))
        final = initial * np.exp(rng.uniform(np.log(floor / initial), 0.0))
        bounds[block.agent] = [Exponential(a, b, rng.uniform(0.2, 8.0)) for a, b in zip(initial, final, strict=True)]
    return bounds


@st.composite
def systems(
    draw: st.DrawFn,
    *,
    models: tuple = PLANAR,
    relay: bool | None = None,
    drift: bool | None = None,
    input_observer: bool | None = None,
    floor: float = 0.02,
    margin: float = 1.05,
    largest: int = 9,
    rule: DesignRule | None = None,
    directed: bool = False,
) -> System:
    """A whole random system.

    Args:
        draw: Hypothesis.
        models: what the fleet is mixed from.
        relay: whether Assumption 4 holds; drawn if left out.
        drift: whether the observers know f_i; drawn agent by agent if left out.
        input_observer: whether there are input observers, where they can be; drawn agent by agent if left out.
        floor: the smallest bound on an estimation error at steady state.
        margin: how much larger than the smallest feasible one the bounds start, at least.
        largest: number of agents at most.
        rule: the design rule; drawn if left out, or sharp where links go one way.
        directed: whether they may.
    """
    graph = draw((digraphs if directed else connected_graphs)(largest=largest))
    if rule is None:
        rule = "sharp" if directed else draw(st.sampled_from(get_args(DesignRule)))
    k, relay = draw(hops(relay))
    agents = len(graph)
    fleet = Fleet([draw(st.sampled_from(models)) for _ in range(agents)])
    options = [
        TargetObservers(
            drift=draw(st.booleans()) if drift is None else drift,
            input_observer=not model.input_map_uses_state
            and (draw(st.booleans()) if input_observer is None else input_observer),
        )
        for model in fleet.models
    ]
    seed = draw(SEEDS)
    rng = np.random.default_rng(seed)
    initial = InitialSet(rng.uniform(-2.0, 2.0, fleet.n), rng.uniform(0.0, 1.5, fleet.n))
    anything = Exponential(1.0, 1.0, 1.0)
    probe = ObserverDesign(fleet, graph, k, anything, anything, relay, options, rule)
    deltas = fitting(probe.states, initial.radius, rng, floor, margin)
    thetas = fitting(probe.inputs, fleet.input_map_bound, rng, 5.0 * floor, margin)
    design = ObserverDesign(fleet, graph, k, deltas, thetas, relay, options, rule)
    disturbance = Sum(
        (
            Sinusoid(rng.uniform(0.0, 0.5)),
            BandLimitedNoise(rng.uniform(0.0, 0.5), band=(0.5, 20.0), components=3),
            Gust(rng.uniform(0.0, 0.5), duration=0.2, period=0.5),
            Coupling(rng.uniform(0.0, 0.5)),
        )
    )
    within = dict(nx.all_pairs_shortest_path_length(graph, k))
    pairs = [(i, j) for i in range(agents) for j in range(i) if j in within[i] and i in within[j]]
    task = nx.empty_graph(agents)
    task.add_edges_from(pairs[p] for p in rng.permutation(len(pairs))[: agents + 1])
    return System(design, initial, disturbance, task, deltas, thetas, seed)


class SmoothSignals:
    """Inputs that are sines of time within the limits: bounded derivatives, so Assumption 2-ii holds.

    Args:
        fleet: whose inputs.
        seed: of amplitudes, frequencies and phases.
    """

    def __init__(self, fleet: Fleet, seed: int) -> None:
        rng = np.random.default_rng(seed)
        self.amplitude = rng.uniform(0.0, 1.0, fleet.m) * fleet.input_limit
        self.frequency, self.phase = rng.uniform(0.1, 8.0, fleet.m), rng.uniform(0.0, 7.0, fleet.m)

    def __call__(self, t: np.ndarray, view: View) -> np.ndarray:
        return self.amplitude * np.sin(self.frequency * t[:, None] + self.phase)
