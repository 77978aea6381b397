"""Estimation over networks, measured: errors, certified bounds and violations, per network, estimator and period."""

from __future__ import annotations

import math
from collections.abc import Iterator, Sequence
from dataclasses import asdict, dataclass, replace
from typing import Any, get_args

import numpy as np

from khop_env.network import Network
from khop_env.observers import (
    Estimator,
    IntArray,
    Message,
    Networked,
    ObserverDesign,
    Observers,
    PairLayout,
    Proximal,
)
from khop_env.observers.wire import EstimatorName
from khop_env.results.metrics import finite, violations
from khop_env.scenarios import Scenario
from khop_env.scenarios.scenario import number_of_steps
from khop_env.simulation import Law, Observe, Simulator

SWEPT_PERIODS = (0.01, 0.02, 0.05, 0.1, 0.2, 0.5)  # s
SWEPT_LOSSES = (0.01, 0.03, 0.1, 0.3, 0.6, 0.9)

_TRANSIENT = 0.25  # of an episode, in which estimates start from the first guess
_LEAST_STEPS = 4  # of the simulator in a period, so that errors between messages count, too


@dataclass(frozen=True)
class NetworkRow:
    """The results of one estimator over one network.

    Errors and bounds are of positions, over all pairs of an agent and another up to k hops away, neighbours included,
    over all episodes but for their first quarter, in which estimates start. Violations are counted in all states, from
    the start.

    Attributes:
        network: as it was named; "continuous" for exchange without messages.
        estimator: its name.
        period: between messages of an agent, in s; None for continuous exchange.
        loss: mean share of lost messages.
        mean_error: of the estimates of positions, each coordinate for itself.
        max_error: the largest one.
        mean_bound: of the guaranteed bounds on these errors; None where they aren't certified.
        bound_to_limit: mean bound over the mean information limit, the bound of who had the freshest state that this
            network could have brought without losses; None without certificates, or where a schedule takes links down.
        violations: pairs and steps with an error above its guaranteed bound in any state, by more than rounding.
        pair_steps: of how many: pairs times steps times episodes.
        messages_per_s: that each agent sends.
        bytes_per_message: of the agent with the largest one, packed as float32.
    """

    network: str
    estimator: str
    period: float | None
    loss: float
    mean_error: float | None
    max_error: float | None
    mean_bound: float | None
    bound_to_limit: float | None
    violations: int
    pair_steps: int
    messages_per_s: float | None
    bytes_per_message: int | None

    def as_dict(self) -> dict[str, Any]:
        """The values by name, as plain JSON has them."""
        return asdict(self)


def measure_networks(
    scenario: Scenario,
    law: Law,
    networks: Sequence[str | Network | None],
    estimators: Sequence[str | Estimator] = ("ppso", "relay"),
    periods: Sequence[float] | None = None,
    *,
    observe: Observe = "estimate",
    episodes: int = 16,
    duration: float | None = None,
    seed: int = 0,
) -> Iterator[NetworkRow]:
    """Measure estimators over networks, in the closed loop of a scenario; all rows have the same episodes.

        rows = list(measure_networks(paper(), make_law("tanh"), ["ideal", "wifi"]))

    The simulator's steps divide a period into equal parts, at least four, none longer than the scenario's.

    Args:
        scenario: agents, graphs, disturbances and bounds.
        law: feedback law, e.g. `agents.make_law(scenario.law)`.
        networks: what `Network.of` takes; None for the paper's continuous exchange, without messages.
        estimators: names or objects, as in `Networked`; continuous exchange has the paper's observers only.
        periods: in s, instead of each network's own.
        observe: what the law acts on: "estimate"; or "oracle" (true states), so that all rows have the same motion.
        episodes: of each row, all at once.
        duration: of an episode in s; by default the scenario's.
        seed: of the first episode.

    Yields:
        A row for each network, estimator and period, in this order, when it is measured.

    Raises:
        ValueError: for an unknown network or estimator, a period that isn't positive, or too many steps; before
            anything is measured.
        SolveError: if states stop being finite.
    """
    duration = scenario.duration if duration is None else duration
    plan: list[tuple[str, Network | None, Observers]] = []
    for chosen in networks:
        base = Network.of(chosen)
        if base is None:
            plan.append(("continuous", None, Proximal(scenario.order)))
            continue
        name = chosen if isinstance(chosen, str) else base.described()
        for estimator in estimators:
            for network in [base] if periods is None else [replace(base, period=period) for period in periods]:
                plan.append((name, network, Networked(network, estimator)))
    for _, planned, _ in plan:
        number_of_steps(duration, _step(scenario, planned))
    if not scenario.design.knowledge.pairs:
        raise ValueError(f"scenario {scenario.name!r}: no agent is within k hops of another, so nothing is estimated")
    return (
        _measured(
            scenario.build(law=law, observe=observe, observers=observers, num_envs=episodes).reset(seed),
            name,
            network,
            duration,
            _step(scenario, network),
        )
        for name, network, observers in plan
    )


def sweeps(network: Network) -> tuple[list[Network], list[Network]]:
    """A network at `SWEPT_PERIODS`, and one at those of `SWEPT_LOSSES` that its bursts allow, for `network_figure`."""
    longest = 1.0
    if network.burst is not None:
        shortest = network.bounds("burst")[0]
        longest = shortest / (1.0 + shortest)
    return [replace(network, period=period) for period in SWEPT_PERIODS], [
        replace(network, loss=loss) for loss in SWEPT_LOSSES if loss <= longest
    ]


def _step(scenario: Scenario, network: Network | None) -> float:
    if network is None:
        return scenario.dt
    return network.period / max(_LEAST_STEPS, math.ceil(network.period / scenario.dt - 1e-9))


def _measured(simulator: Simulator, name: str, network: Network | None, duration: float, dt: float) -> NetworkRow:
    steps = number_of_steps(duration, dt)
    observers, layout = simulator.observers, simulator.observers.layout
    positions = _positions(simulator, layout)
    # of all agents up to k hops away; where exchange is continuous, neighbours are known exactly, without an error
    width = len(_positions(simulator, simulator.design.knowledge)) * simulator.num_envs
    limit = np.zeros((layout.size, simulator.num_envs))
    sums, largest, counted, wrong = np.zeros(2), 0.0, 0, 0
    compared = np.zeros(2)  # bounds and limits, where limits are evaluated: in each phase of a period in turn
    every = 1 if network is None else round(network.period / dt) + 1
    for step in range(1, steps + 1):
        simulator.step(dt)
        error, bound = np.abs(simulator.errors()).T, simulator.error_bounds().bound
        wrong += violations(error, bound, simulator.state.x, layout)
        if step > _TRANSIENT * steps:
            counted += width
            sums += [values[positions].sum() for values in (error, bound)]
            # limits are of all links, so that there is no comparison where some are down
            if isinstance(observers, Networked) and step % every == 0 and simulator.design.schedule is None:
                observers.limits(simulator.state, limit)
                compared += [values[positions].sum() for values in (bound, limit)]
            largest = max(largest, float(error[positions].max(initial=0.0)))
    mean_error, mean_bound = (sums / counted).tolist()
    return NetworkRow(
        network=name,
        estimator=observers.estimator.name if isinstance(observers, Networked) else "ppso",
        period=None if network is None else network.period,
        loss=0.0 if network is None else sum(network.bounds("loss")) / 2.0,
        mean_error=finite(mean_error),
        max_error=finite(largest),
        mean_bound=finite(mean_bound),
        bound_to_limit=finite(compared[0] / compared[1]) if 0.0 < compared[1] < math.inf else None,
        violations=wrong,
        pair_steps=layout.pairs * simulator.num_envs * steps,
        messages_per_s=None if network is None else 1.0 / network.period,
        bytes_per_message=_bytes(simulator.design, observers),
    )


def _bytes(design: ObserverDesign, observers: Observers) -> int | None:
    """Bytes of the largest message of an agent; None where there are none, or for an estimator of a user's own."""
    if not isinstance(observers, Networked):
        return None
    for name in get_args(EstimatorName):
        if name == observers.estimator.name:
            return max(Message.size(design, agent, name) for agent in range(len(design.fleet)))
    return None


def _positions(simulator: Simulator, layout: PairLayout) -> IntArray:
    """The rows of the estimates of positions."""
    return np.flatnonzero(np.isin(layout.column_source, simulator.fleet.position_index))
