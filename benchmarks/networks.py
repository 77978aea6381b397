"""Estimation over a network: speed and memory beside continuous exchange, and errors against certified bounds."""

from __future__ import annotations

import statistics
import tracemalloc

from benchmarks.environments import BATCH, TURNS, batched, calls_per_second
from benchmarks.report import Report
from benchmarks.violations import count_violations

NETWORK = "wifi"  # a message every 50 ms, which is the control period
ESTIMATORS = ("relay", "ppso")


def network_rows(report: Report, quick: bool) -> None:
    """Agent-steps/s of `paper` over those of continuous exchange, measured in turns, and bytes per environment.

    Args:
        report: takes the rows.
        quick: as `benchmark`.
    """
    seconds, batch = (0.05, 64) if quick else (1.0, BATCH)
    choices: dict[str, dict[str, str]] = {"continuous": {}}
    choices |= {name: {"network": NETWORK, "estimator": name} for name in ESTIMATORS}
    steps, held = {}, {}
    for name, arguments in choices.items():
        batched("paper", 1, 1, batch, **arguments)[1](0)  # compiles, and designs the observers
        tracemalloc.start()
        env, steps[name] = batched("paper", 1, 1, batch, **arguments)
        steps[name](0)
        held[name] = tracemalloc.get_traced_memory()[0]
        tracemalloc.stop()
    rates: dict[str, list[float]] = {name: [] for name in choices}
    for _ in range(1 if quick else TURNS):
        for name, step in steps.items():
            rates[name].append(batch * len(env.agents) * calls_per_second(step, seconds))
    for name in choices:
        report.add(f"{name}_memory", held[name] / batch / 1024.0, "KiB per environment")
    for name in ESTIMATORS:
        report.add(f"network_{name}", statistics.median(rates[name]), "agent-steps/s")
        ratios = [rate / ideal for rate, ideal in zip(rates[name], rates["continuous"], strict=True)]
        report.add(f"network_{name}_ratio", statistics.median(ratios), "x continuous exchange", least=1.0)


def violation_rows(report: Report, quick: bool) -> None:
    """Errors above their certified bounds, of random fleets, graphs and networks under adversarial inputs.

    Args:
        report: takes the rows.
        quick: as `benchmark`.
    """
    found = count_violations(1e5 if quick else 1e8, batch=16 if quick else 256)
    report.add("violations", found.violations, f"in {found.pair_steps:.4g} pairs and steps", most=0.0)
    report.add("error_to_certified_bound", found.largest, "largest", most=1.0 + 1e-6)
