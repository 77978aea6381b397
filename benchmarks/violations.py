"""Search for errors above their certified bounds: random fleets, graphs, schedules and networks, adversarial inputs.

python -m benchmarks.violations 1e9         # so many pairs of agents, times environments, times steps
"""

from __future__ import annotations

import argparse
from collections.abc import Callable
from dataclasses import dataclass
from typing import NamedTuple

import networkx as nx
import numpy as np

from khop_env.network import Network, Outage, RandomLinks, Range, Schedule, Switching
from khop_env.observers import ESTIMATORS, Exponential, FloatArray, Networked
from khop_env.physics import (
    AgentModel,
    DoubleIntegrator,
    DriftingIntegrator,
    SingleIntegrator,
    SurfaceVessel,
    Term,
    Unicycle,
)
from khop_env.physics.disturbance import Channels
from khop_env.results.metrics import violations
from khop_env.scenarios import Scenario
from khop_env.simulation import Simulator

BATCH = 256
_STEPS = 150  # of a case
_SWITCHED = 0.05  # share of inputs that change their sign in a step


class Count(NamedTuple):
    """Result of a search.

    Attributes:
        violations: pairs, environments and steps with an error above its bound by more than rounding.
        pair_steps: of how many.
        largest: largest |error| / bound.
        cases: fleets, graphs and networks that were drawn.
    """

    violations: int
    pair_steps: int
    largest: float
    cases: int


@dataclass(frozen=True)
class BangBang(Term):
    """A square wave between the bounds, of each channel its own frequency, constant to 20 Hz, and phase.

    It jumps, which a certificate allows (w need only be measurable), and the paper's observers don't.
    """

    def draw(self, rng: np.random.Generator, channels: Channels) -> FloatArray:
        """Frequencies in rad/s, 0 in a quarter of the channels, and phases, (2, C)."""
        count = len(channels.index)
        fast = 2.0 * np.pi * np.exp(rng.uniform(np.log(0.05), np.log(20.0), count)) * (rng.random(count) > 0.25)
        return np.stack([fast, rng.uniform(0.0, 2.0 * np.pi, count)])

    def add(self, t: FloatArray, x: FloatArray, drawn: FloatArray, channels: Channels, out: FloatArray) -> None:
        """Add the waves."""
        frequency, phase = np.split(drawn, 2, axis=1)
        out[:, channels.index] += channels.amplitude * np.sign(np.sin(frequency * t[:, None] + phase))


def count_violations(
    pair_steps: float,
    *,
    seed: int = 0,
    batch: int = BATCH,
    factor: float = 1.0,
    progress: Callable[[float], None] | None = None,
) -> Count:
    """Count errors above their certified bounds, until there were `pair_steps` pairs, environments and steps.

    Inputs are at their limits all the time: constant, switching at random, or chosen to drive an agent away from where
    one of its observers believes it.

    Args:
        pair_steps: how many at least.
        seed: of the search.
        batch: environments of each case.
        factor: what bounds are multiplied by; below 1 it shows that the search would find bounds that are too small.
        progress: called with the completed fraction.
    """
    rng = np.random.default_rng(seed)
    total = Count(0, 0, 0.0, 0)
    estimators = sorted(ESTIMATORS)
    while total.pair_steps < pair_steps:
        scenario, network = _scenario(rng), _network(rng)
        estimator = estimators[total.cases % len(estimators)]
        simulator = scenario.build(observers=Networked(network, estimator), num_envs=batch)
        dt = network.period / rng.integers(1, 5) if rng.random() < 0.5 else rng.uniform(0.2, 1.2) * network.period
        found, largest = _case(simulator, float(min(dt, 0.1)), factor, rng)
        checked = simulator.observers.layout.pairs * batch * (_STEPS + 1)
        total = Count(
            total.violations + found, total.pair_steps + checked, max(total.largest, largest), total.cases + 1
        )
        if progress is not None:
            progress(min(1.0, total.pair_steps / pair_steps))
    return total


def _case(simulator: Simulator, dt: float, factor: float, rng: np.random.Generator) -> tuple[int, float]:
    initial, fleet, batch = simulator.initial, simulator.fleet, simulator.num_envs
    layout = simulator.observers.layout
    corners = np.sign(rng.uniform(-1.0, 1.0, (batch, fleet.n)))
    inside = np.where(rng.random((batch, 1)) < 0.5, corners, rng.uniform(-1.0, 1.0, (batch, fleet.n)))
    seeds = [int(number) for number in rng.integers(2**63, size=batch)]
    simulator.reset(seeds, initial.center + inside * initial.radius)
    limit = fleet.input_limit[:, None]
    u = limit * np.sign(rng.uniform(-1.0, 1.0, (fleet.m, batch)))
    kind = np.arange(batch) % 3
    observer_of = _an_observer(simulator, rng)
    found = 0
    for step in range(_STEPS + 1):
        if step:
            simulator.step(dt, u.T)
        error = simulator.errors().T
        bound = factor * simulator.error_bounds().bound
        found += violations(np.abs(error), bound, simulator.state.x, layout)
        switched = (rng.random(u.shape) < _SWITCHED) & (kind == 1)
        u = np.where(switched, -u, u)
        if step % 5 == 0:
            u = np.where(kind == 2, _away(simulator, error, observer_of, u), u)
    return found, float(simulator.extremes.relative.max())


def _an_observer(simulator: Simulator, rng: np.random.Generator) -> dict[int, int]:
    """For each agent the place of the estimate of one of its observers."""
    slots = list(simulator.observers.layout.slot.items())
    return {target: at for (_, target), at in (slots[q] for q in rng.permutation(len(slots)))}


def _away(simulator: Simulator, error: FloatArray, observer_of: dict[int, int], u: FloatArray) -> FloatArray:
    """Inputs (m, B) at the limits that drive agents away from an estimate."""
    fleet, state = simulator.fleet, simulator.state
    chosen = u.copy()
    for number in range(max(model.m for model in fleet.models)):
        alone = np.zeros_like(u)
        rows = [(i, fleet.input_slice(i).start + number) for i, model in enumerate(fleet.models) if number < model.m]
        for _, row in rows:
            alone[row] = fleet.input_limit[row]
        effect = fleet.input_map(state.t, state.x.T, alone.T).T
        for i, row in rows:
            if i in observer_of:
                part, at = fleet.state_slice(i), observer_of[i]
                behind = np.sum(-error[at : at + fleet.models[i].n] * effect[part], axis=0)
                chosen[row] = np.where(behind == 0.0, u[row], fleet.input_limit[row] * np.sign(behind))
    return chosen


def _scenario(rng: np.random.Generator) -> Scenario:
    """A connected graph, directed in half of the cases, with agents of one to three of the five models."""
    agents = int(rng.integers(3, 11))
    tree = [(int(rng.integers(i)), i) for i in range(1, agents)]
    more = rng.integers(agents, size=(rng.integers(agents + 1), 2)).tolist()
    graph = nx.Graph([*tree, *((i, j) for i, j in more if i != j)])
    communication: nx.Graph = graph
    if rng.random() < 0.5:
        communication = nx.DiGraph([link for i, j in graph.edges for link in _ways(i, j, rng)])
        communication.add_nodes_from(range(agents))
    kinds = rng.permutation(5)[: rng.integers(1, 4)]
    models = tuple(_models(rng)[kind] for kind in rng.choice(kinds, size=agents))
    relay = bool(rng.random() < 0.5)
    types = {model.type for model in models}
    observed = {model.type for model in models if not model.input_map_uses_state}
    noisy = BangBang(float(rng.choice([0.0, 0.05, 0.5])))
    return Scenario(
        name="violations",
        description="a random fleet",
        models=models,
        communication=communication,
        task=nx.empty_graph(agents),
        k=int(rng.integers(2, 5)),
        relay=relay,
        delta=dict.fromkeys(types, Exponential(1.0, 0.1, 2.0)),
        schedule=_schedule(communication, rng),
        theta=dict.fromkeys(observed, Exponential(1.0, 0.5, 2.0)),
        disturbance=noisy,
        radius=float(rng.choice([0.1, 1.0])),
    ).sized()


def _schedule(graph: nx.Graph, rng: np.random.Generator) -> Schedule | None:
    """All links always, in half of the cases; or links that come and go."""
    fewer = graph.copy()
    fewer.remove_edges_from([edge for edge in graph.edges if rng.random() < 0.5])
    schedules: list[Schedule] = [
        RandomLinks(float(rng.random()), both_ways=bool(rng.random() < 0.5)),
        Switching((graph, fewer), period=float(rng.uniform(0.1, 3.0))),
        Outage(start=(0.0, 2.0), duration=(0.1, 2.0)) & Outage(start=(0.0, 2.0), duration=(0.1, 2.0)),
        Range(float(rng.uniform(0.1, 3.0))),
    ]
    return schedules[rng.integers(len(schedules))] if rng.random() < 0.5 else None


def _ways(i: int, j: int, rng: np.random.Generator) -> list[tuple[int, int]]:
    """A link one way, the other, or both."""
    return [[(i, j)], [(j, i)], [(i, j), (j, i)]][rng.integers(3)]


def _models(rng: np.random.Generator) -> list[AgentModel]:
    """One of each model, with random numbers."""

    def limit(low: float = 0.2, high: float = 5.0) -> float:
        return float(np.exp(rng.uniform(np.log(low), np.log(high))))

    drag = [tuple(rng.uniform(low, 5.0, 3).tolist()) for low in (0.5, 0.5)]
    return [
        SingleIntegrator(input_limit=limit()),
        DriftingIntegrator(input_limit=limit()),
        DoubleIntegrator(float(rng.choice([0.0, 0.5, 5.0])), input_limit=limit()),
        Unicycle(input_limit=(limit(), limit())),
        SurfaceVessel(linear_drag=drag[0], quadratic_drag=drag[1], input_limit=limit(0.5, 40.0)),
    ]


def _network(rng: np.random.Generator) -> Network:
    """Losses up to 90 % in bursts or not, latency up to three periods, jitter, noise; ranges in some."""
    period = float(np.exp(rng.uniform(np.log(0.005), np.log(0.2))))
    loss = float(rng.choice([0.0, rng.uniform(0.0, 0.9), 0.9]))
    burst = float(loss / (1.0 - loss) + rng.uniform(1.0, 10.0)) if rng.random() < 0.5 else None
    latency = float(rng.choice([0.0, rng.uniform(0.0, 3.0) * period]))
    return Network(
        period=period,
        loss=(0.0, loss) if rng.random() < 0.3 else loss,
        burst=burst,
        latency=latency,
        jitter=float(rng.choice([0.0, rng.random() * latency])),
        noise=float(rng.choice([0.0, 0.1 * rng.random()])),
    )


def main() -> None:
    """Print the result of a search."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("pair_steps", type=float, nargs="?", default=1e8, help="pairs x environments x steps")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--batch", type=int, default=BATCH)
    chosen = parser.parse_args()
    found = count_violations(chosen.pair_steps, seed=chosen.seed, batch=chosen.batch)
    print(
        f"{found.violations} violations of the certified bound in {found.pair_steps:.4g} pair-steps of {found.cases} "
        f"fleets and networks; largest |error| / bound = {found.largest:.9f}"
    )


if __name__ == "__main__":
    main()
