"""Speed of the environments: shares of a step's parts, and ratios to particle environments, measured in alternation."""

from __future__ import annotations

import time
from collections.abc import Callable
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from benchmarks.comparison import compare, run_peer
from benchmarks.report import Report
from benchmarks.threads import thread_rows
from khop_env import consensus_v0
from khop_env.env import BatchedEnv, KHopEnv, Settings
from khop_env.registry import make_batched

BATCH = 1024
TURNS = 5  # repetitions of both sides of a ratio
Rate = Callable[[float], float]
"""Agent-steps per second; the argument is the time to measure in s."""


def single(scenario: str, order: int) -> tuple[KHopEnv, Callable[[int], None]]:
    """One `consensus_v0.parallel_env`, and a step with random actions that resets it after 200."""
    env = consensus_v0.parallel_env(scenario, order=order)
    env.batched.simulator.warm_up(long=True)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    pool = [{agent: rng.uniform(-1, 1, 2).astype(np.float32) for agent in env.possible_agents} for _ in range(64)]

    def step(number: int) -> None:
        env.step(pool[number % len(pool)])
        if not env.agents:
            env.reset()

    return env, step


def single_rate(seconds: float, scenario: str, order: int) -> float:
    """Agent-steps per second of one `consensus_v0.parallel_env`, resets, observations and dictionaries included."""
    env, step = single(scenario, order)
    return len(env.possible_agents) * calls_per_second(step, seconds)


def batched(
    scenario: str, order: int, threads: int, batch: int = BATCH, environment: str = "consensus_v0", **arguments: Any
) -> tuple[BatchedEnv, Callable[[int], None]]:
    """A batched environment and a step with random actions that resets finished environments."""
    env = make_batched(environment, scenario, num_envs=batch, order=order, threads=threads, **arguments)
    env.simulator.warm_up(long=True)
    env.reset(seed=0)
    rng = np.random.default_rng(0)
    shape = batch, len(env.agents), 2
    pool = [rng.uniform(-1, 1, shape).astype(np.float32) for _ in range(16)]

    def step(number: int) -> None:
        _, _, terminated, truncated, _ = env.step(pool[number % len(pool)])
        if (terminated | truncated).any():
            env.reset(env_ids=np.flatnonzero(terminated | truncated))

    return env, step


def vector_rate(seconds: float, scenario: str, order: int, threads: int, batch: int = BATCH) -> float:
    """Agent-steps per second of a batch of `consensus_v0`, resets and observations included."""
    env, step = batched(scenario, order, threads, batch)
    return batch * len(env.agents) * calls_per_second(step, seconds)


def shares(env: BatchedEnv, step: Callable[[int], None], steps: int) -> dict[str, float]:
    """Microseconds per environment and step in each part of `step`, which steps `env`.

    The parts of a compiled step can't be told apart, so that these are of the same loops called from Python.
    """
    simulator: Any = env.simulator
    simulator._compiled = None
    for number in range(5):
        step(number)
    observers = simulator.observers
    spent: dict[str, float] = {}
    for name, holder, attributes in (
        ("solve", observers, ("_solve_states", "_solve_inputs")),
        ("right-hand sides", simulator.plant, ("stage", "actuate")),
        ("right-hand sides", observers.prediction, ("rate",)),
        ("observation", env._read_observations, ("write",)),
    ):
        for attribute in attributes:
            setattr(holder, attribute, _timed(getattr(holder, attribute), name, spent))
    start = time.perf_counter()
    for number in range(steps):
        step(number)
    total = time.perf_counter() - start
    spent["rest, Python and NumPy"] = total - sum(spent.values())
    return {name: seconds / (steps * env.num_envs) * 1e6 for name, seconds in spent.items()}


def environment_rows(report: Report, quick: bool, say: Callable[[str], None], peers: Path | None) -> None:
    """Measure rates, shares, and ratios to the peers installed under `peers`.

    Args:
        report: takes the rows.
        quick: as `benchmark`.
        say: called with a line before each row.
        peers: folder with one virtual environment per peer, named mpe2, vmas, jaxmarl; None to leave them out.
    """
    add = report.add
    seconds, batch = (0.05, 64) if quick else (1.0, BATCH)
    settings = Settings()  # the defaults, which all rows have but for the order and the threads that they name
    add("environment_control_period", settings.control_period, "s between actions, in all rows below")
    add("environment_substeps", settings.substeps, "simulator steps in a control period")
    for scenario in ("paper", "convoy"):
        say(f"environments: where a step spends its time on {scenario}, one copy and {batch}")
        alone, step_alone = single(scenario, 1)
        many, step_many = batched(scenario, 1, 1, batch)
        for kind, env, step, steps in (("single", alone.batched, step_alone, 3000), ("vector", many, step_many, 60)):
            for part, value in shares(env, step, 3 if quick else steps).items():
                add(f"{kind}_{scenario}: {part}", value, "us per copy and step")

    def step_of(count: int, environment: str, scenario: str, **arguments: Any) -> Callable[[int], None]:
        return batched(scenario, 1, count, batch, environment, **arguments)[1]

    cases: dict[str, Callable[[int], Callable[[int], None]]] = {
        "threads_paper": lambda count: step_of(count, "consensus_v0", "paper"),
        "threads_convoy": lambda count: step_of(count, "leader_following_v0", "convoy"),
        "threads_paper_wifi": lambda count: step_of(count, "consensus_v0", "paper", network="wifi"),
    }
    thread_rows(report, cases, seconds / 2.0, 1 if quick else TURNS, say)

    def ours(scenario: str, order: int, threads: int) -> Rate:
        return lambda s: vector_rate(s, scenario, order, threads, batch)

    vmas = f"VMAS simple_spread, batch {batch}"
    plan: list[tuple[str, str, Rate, str, int, int, float | None]] = [
        (f"single_order{order}", "MPE2 simple_spread", _single(order), "mpe2", 1, 1, 20.0 if order == 1 else None)
        for order in (1, 2)
    ]
    for scenario in ("paper", "convoy"):
        for order in (1, 2):
            wanted = 2.0 if order == 1 else None
            plan.append((f"vector_{scenario}_order{order}", vmas, ours(scenario, order, 1), "vmas", batch, 1, wanted))
        plan.append((f"vector_{scenario}_threads2", vmas, ours(scenario, 1, 2), "vmas", batch, 2, None))
        name = f"JaxMARL simple_spread, batch {batch}, a step a call: our one thread against XLA's own pool"
        plan.append((f"vector_{scenario}_jax", name, ours(scenario, 1, 1), "jaxmarl", batch, 1, 1.0))
    for name, peer_name, rate, peer, size, count, target in plan:
        say(f"environments: {name}")
        compare(
            report,
            name,
            "agent-steps/s",
            partial(rate, seconds),
            partial(_peer_rate, peer=peer, batch=size, threads=count, seconds=seconds),
            (peers, peer),
            (f"x {peer_name}", target),
            1 if quick else TURNS,
        )


def _single(order: int) -> Rate:
    return lambda seconds: single_rate(seconds, "paper", order)


def _peer_rate(python: Path, peer: str, batch: int, threads: int, seconds: float) -> float:
    return run_peer(python, f"{peer}_rate.py", batch, threads, seconds, threads=threads)


def _timed(function: Callable[..., Any], name: str, spent: dict[str, float]) -> Callable[..., Any]:
    def call(*arguments: Any) -> Any:
        start = time.perf_counter()
        result = function(*arguments)
        spent[name] = spent.get(name, 0.0) + time.perf_counter() - start
        return result

    return call


def calls_per_second(step: Callable[[int], None], seconds: float) -> float:
    """Calls of `step`, with their number, within about `seconds`; the first three aren't counted."""
    for number in range(3):
        step(number)
    number, start = 0, time.perf_counter()
    while (elapsed := time.perf_counter() - start) < seconds or number == 0:
        step(number)
        number += 1
    return number / elapsed
