"""What is certain over a network, before a run: certificates of the agents' types, and bounds by distance."""

from __future__ import annotations

from typing import Any

import numpy as np

from khop_env.network import Network
from khop_env.observers import Certificate, FloatArray
from khop_env.physics import hops_from_targets
from khop_env.results.metrics import finite
from khop_env.scenarios import Scenario

_ACROSS = 1000  # values of a range, of which means are taken


def network_report(scenario: Scenario, network: Network) -> dict[str, Any]:
    """The guarantees of a scenario's estimates over a network, as plain JSON.

    Keys:
        network: in words.
        types: per type of agents whether all its states are certified, and the reason if not.
        bounds: per type and distance in links from its agents: expected_age of the state that is known, in s, where
            messages come by one shortest path; certified, the bound on the error of the type's first state at that
            age, the largest of its agents; and ideal, the largest bound under continuous exchange, after its transient
            (0 for neighbours). null where there is none.
    """
    fleet, design = scenario.fleet, scenario.design
    pushed = np.zeros(fleet.n) if scenario.disturbance is None else scenario.disturbance.attach(fleet).bound
    reach = np.abs(scenario.initial.center) + scenario.initial.radius
    certificates = []
    for i, model in enumerate(fleet.models):
        part = fleet.state_slice(i)
        region = model.operating_region(reach[part], pushed[part])
        certificates.append(Certificate(model, disturbance=pushed[part], start=network.noise, region=region))
    reasons = {model.type: "" for model in fleet.models}
    for model, certificate in zip(fleet.models, certificates, strict=True):
        reasons[model.type] = reasons[model.type] or certificate.reason
    hops = hops_from_targets(design.communication, design.k)
    ideal = _ideal_bounds(scenario)
    found: dict[tuple[str, int], tuple[float, float]] = {}
    for a, i in design.knowledge.slot:
        key = fleet.models[i].type, hops[a][i]
        age = expected_age(network, hops[a][i])
        radius = float(certificates[i].radius(np.array(age))[0]) if np.isfinite(age) else np.inf
        certified, bound = found.get(key, (0.0, 0.0))
        found[key] = max(certified, radius), max(bound, ideal.get((a, i), 0.0))
    first = {model.type: next(iter(model.states.items())) for model in fleet.models}
    return {
        "network": network.described(),
        "types": [{"type": kind, "certified": not why, "reason": why or None} for kind, why in reasons.items()],
        "bounds": [
            {
                "type": kind,
                "hops": distance,
                "component": first[kind][0],
                "unit": first[kind][1],
                "expected_age": finite(expected_age(network, distance)),
                "certified": finite(certified),
                "ideal": finite(bound),
            }
            for (kind, distance), (certified, bound) in sorted(found.items())
        ],
    }


def expected_age(network: Network, hops: int) -> float:
    """Mean age of the newest known state of an agent `hops` links away, in s, were there only one path to it.

    A round passes half on average; then the delay of each link in whole rounds, one round for each message that is
    passed on without delay; and on each link the mean number of losses in a row until now, loss times burst. Of ranges
    it is the mean over what episodes draw.
    """
    loss, late = _across(network.bounds("loss")), [network.rounds_late(x) for x in _across(network.bounds("latency"))]
    fastest = np.mean([hops * rounds if rounds else hops - 1 for rounds in late])
    with np.errstate(divide="ignore"):
        burst = 1.0 / (1.0 - loss) if network.burst is None else np.mean(network.bounds("burst"))
    return network.period * float(0.5 + fastest + np.mean(hops * loss * burst))


def _across(span: tuple[float, float]) -> FloatArray:
    """Values that are spread evenly over a range; one if its ends are equal."""
    low, high = span
    count = _ACROSS if low < high else 1
    return low + (high - low) * (np.arange(count) + 0.5) / count


def _ideal_bounds(scenario: Scenario) -> dict[tuple[int, int], float]:
    """The final bound of each pair of continuous exchange, on the target's first state."""
    states = scenario.design.states
    final = states.delta.infimum()[states.layout.column_row] * states.share[states.layout.column_pair]
    return {pair: float(final[at]) for pair, at in states.layout.slot.items()}
