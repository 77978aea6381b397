"""Clocks that differ: a recorded run replayed through one node per agent, whose clocks are off by up to half the skew.

python -m benchmarks.clocks paper
"""

from __future__ import annotations

import argparse
from typing import Any

import numpy as np

from agents import make_law
from khop_env.observers import FloatArray, ObserverNode, Proximal
from khop_env.registry import scenario
from khop_env.scenarios import Scenario

PERIOD, ROUNDS, FIRST = 0.05, 120, 30  # s, messages of an agent, and those of the start, which don't count
SKEWS = (0.0, 0.01, 0.025, 0.05)  # s


def recorded(chosen: Scenario) -> tuple[list[FloatArray], list[FloatArray]]:
    """States (n,) and inputs (m,) every period, under the scenario's law on the true states."""
    simulator = chosen.build(law=make_law(chosen.law), observers=Proximal(), observe="oracle").reset(0)
    x, u = [], []
    for _ in range(ROUNDS):
        x.append(simulator.x[0].copy())
        u.append(simulator.u[0].copy())
        for _ in range(5):
            simulator.step(PERIOD / 5)
    return x, u


def replay(chosen: Scenario, run: tuple[list[FloatArray], list[FloatArray]], estimator: Any, skew: float) -> str:
    """Mean error and bound of estimated positions, and errors above their bounds, as a line of the table."""
    design, fleet = chosen.design, chosen.design.fleet
    pushed = 0.0 if chosen.disturbance is None else chosen.disturbance.attach(fleet).bound
    offset = np.random.default_rng(1).uniform(-skew / 2.0, skew / 2.0, len(fleet))
    known: dict[str, Any] = {
        "disturbance": pushed,
        "center": chosen.initial.center,
        "radius": chosen.initial.radius,
        "skew": skew,
    }
    nodes = [ObserverNode(design, a, estimator=estimator, period=PERIOD, **known) for a in fleet.ids]
    errors: list[float] = []
    bounds: list[float] = []
    above = 0
    for number, (x, u) in enumerate(zip(*run, strict=True)):
        clocks = 1.0 + number * PERIOD + offset
        for a, node in enumerate(nodes):
            node.update(clocks[a], x[fleet.state_slice(a)], u[fleet.input_slice(a)])
        sent = [node.message() for node in nodes]
        for sender, receiver in design.links.index:
            nodes[receiver].receive(sent[sender])
        for a, node in enumerate(nodes):
            for target, (estimate, bound, *_) in node.estimates(clocks[a]).items():
                i = fleet.agent(target)
                error, position = np.abs(estimate - x[fleet.state_slice(i)]), fleet.models[i].position_index
                above += bool((error > bound * (1.0 + 1e-9) + 1e-12).any())
                if number >= FIRST:
                    errors += error[position].tolist()
                    bounds += bound[position].tolist()
    return f"{1e3 * skew:9g}  {estimator:9}  {np.mean(errors):9.4f}  {np.mean(bounds):9.3f}  {above:5}"


def main() -> None:
    """Print a table of one scenario."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("scenario", nargs="?", default="paper")
    chosen = scenario(parser.parse_args().scenario)
    run = recorded(chosen)
    print("skew (ms)  estimator  error (m)  bound (m)  above")
    for skew in SKEWS:
        for estimator in ("relay", "ppso"):
            print(replay(chosen, run, estimator, skew), flush=True)


if __name__ == "__main__":
    main()
