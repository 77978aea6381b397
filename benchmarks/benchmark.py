"""The benchmark: speed of the proximal step, its overhead over the bare arithmetic, and its growth with the fleet.

Every value is a ratio of times measured in this run, each the best of several repeats, or a memory size.
"""

from __future__ import annotations

import importlib.util
import os
import platform
import time
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from agents import make_law
from benchmarks.comparison import left_out
from benchmarks.environments import environment_rows
from benchmarks.growth import growth_rows
from benchmarks.networks import network_rows, violation_rows
from benchmarks.precision import ACCURACY, scipy_rows
from benchmarks.precision import ROWS as SCIPY_ROWS
from benchmarks.report import Report, reason
from benchmarks.safety import collision_rows
from benchmarks.safety_speed import speed_rows
from benchmarks.training import training_rows
from benchmarks.yardsticks import CompiledPaper, bare_loop
from khop_env.extras import how_to_install
from khop_env.observers import FloatArray, Proximal
from khop_env.observers.solve import solve
from khop_env.scenarios import Scenario, paper
from khop_env.simulation import Simulator

DURATION = 10.0  # s, of the closed loop
DT = 0.01
EXPLICIT_DT = 1e-5
BATCH = 64
PARTS = (
    "explicit",
    "scipy",
    "solve",
    "growth",
    "environments",
    "network",
    "violations",
    "filter",
    "collisions",
    "training",
)
"""Keys of the parts, in the order in which they are measured."""
Progress = Callable[[str], None]


@dataclass(frozen=True)
class Part:
    """Some rows of the table.

    Attributes:
        key: of `--only`.
        name: name of the measurement.
        minutes: how long it takes on two cores, about.
        measure: measures and adds the rows.
        needs: required packages that aren't dependencies of the core.
        rows: names of the rows that need these packages.
    """

    key: str
    name: str
    minutes: float
    measure: Callable[[], None]
    needs: tuple[str, ...] = ()
    rows: tuple[str, ...] = ()


def benchmark(
    quick: bool = False,
    progress: Progress | None = None,
    peers: Path | None = None,
    only: Sequence[str] | None = None,
) -> dict[str, Any]:
    """Run all benchmarks; parts without their packages are left out, and an interrupt returns the rows until then.

    Args:
        quick: whether to do a hundredth of the work, as a test; the values mean little.
        progress: called with a line for each part that is left out, and then before each part.
        peers: folder with virtual environments of other libraries to compare with; None for no comparison.
        only: keys of the parts to run, see `PARTS`; by default all.

    Returns:
        "machine"; "rows", see `Report`; "failed", the parts that ended with an error; and "interrupted".

    Raises:
        ValueError: if `peers` has no virtual environment of a peer, or a part is unknown.
    """
    say = progress or (lambda line: None)
    report = Report()
    parts: tuple[Part, ...] = (
        Part(
            "explicit",
            "proximal against explicit, closed loop of `paper`",
            0.5,
            partial(_against_explicit, report.add, quick),
        ),
        Part(
            "scipy",
            "steps of controlled size against SciPy's LSODA",
            0.7,
            partial(scipy_rows, report, quick, say),
            needs=("scipy",),
            rows=SCIPY_ROWS,
        ),
        Part(
            "solve",
            "the solve against its bare arithmetic",
            0.2,
            lambda: report.add("ratio_to_floor", _ratio_to_floor(quick), most=6.0),
        ),
        Part("growth", "growth with the number of agents", 1.0, partial(growth_rows, report.add, quick, say)),
        Part(
            "environments",
            "environments",
            0.9 if peers is None else 3.4,
            partial(environment_rows, report, quick, say, peers),
        ),
        Part(
            "network",
            "environments over a network, against continuous exchange",
            0.3,
            partial(network_rows, report, quick),
        ),
        Part("violations", "errors against certified bounds", 1.2, partial(violation_rows, report, quick)),
        Part("filter", "the safety filter", 0.3, partial(speed_rows, report, quick)),
        Part("collisions", "collisions under the safety filter", 1.0, partial(collision_rows, report, quick)),
        Part(
            "training",
            "training: PPO, 64 environments of 8 agents",
            0.2 if peers is None else 0.7,
            partial(training_rows, report, quick, peers),
            needs=("stable_baselines3", "torch"),
            rows=("training", "training_environment_share"),
        ),
    )
    if only is not None:
        if unknown := [key for key in only if key not in PARTS]:
            raise ValueError(f"unknown part {unknown[0]!r} of the benchmark; the parts are {', '.join(PARTS)}")
        parts = tuple(part for part in parts if part.key in only)
    missing = {part.name: [name for name in part.needs if not _installed(name)] for part in parts}
    for part in parts:
        if missing[part.name]:
            say(f"left out: {part.name} ({_to_install(missing[part.name])})")
    for line in left_out(peers):
        say(f"left out: {line}")
    if not quick:
        minutes = sum(part.minutes for part in parts if not missing[part.name])
        say(f"this takes about {minutes:.0f} minutes on two cores; Ctrl-C ends it with the rows until then")
    failed, interrupted = [], False
    try:
        for part in parts:
            if missing[part.name]:
                for name in part.rows:
                    report.skip(name, _to_install(missing[part.name]))
                continue
            say(part.name)
            try:
                part.measure()
            except Exception as error:  # other parts still run
                report.skip(part.name, f"failed: {reason(error)}")
                say(f"{part.name} failed: {reason(error)}")
                failed.append(part.name)
    except KeyboardInterrupt:
        interrupted = True
    return {"machine": _machine(), "rows": report.rows, "failed": failed, "interrupted": interrupted}


def _installed(package: str) -> bool:
    try:
        return importlib.util.find_spec(package) is not None
    except (ImportError, ValueError):
        return False


def _to_install(packages: Sequence[str]) -> str:
    return f"needs {' and '.join(packages)}: {how_to_install('bench')}"


def _best(action: Callable[[], object], repeats: int) -> float:
    """Shortest of several timings, in s."""
    best = np.inf
    for _ in range(repeats):
        start = time.perf_counter()
        action()
        best = min(best, time.perf_counter() - start)
    return best


def _simulator(scenario: Scenario, batch: int, order: int = 2) -> Simulator:
    simulator = scenario.build(law=make_law(scenario.law), observers=Proximal(order), num_envs=batch)
    simulator.warm_up(long=True)
    return simulator


def _run(
    simulator: Simulator, dt: float, duration: float, on_step: Callable[[FloatArray], object] | None = None
) -> None:
    simulator.reset(seed=0)
    for _ in range(round(duration / dt)):
        simulator.step(dt)
        if on_step is not None:
            on_step(simulator.x[0].copy())


def _trajectory(dt: float, duration: float, every: int = 1) -> FloatArray:
    """States of `paper` after every `every` steps of order 2, (samples, n)."""
    samples: list[FloatArray] = []
    _run(_simulator(paper(), 1), dt, duration, samples.append)
    return np.array(samples[every - 1 :: every])


def _against_explicit(add: Callable[..., None], quick: bool) -> None:
    duration = DURATION / 100 if quick else DURATION
    fine = 20
    reference = _trajectory(DT / fine, duration, every=fine)
    error = np.abs(_trajectory(DT, duration) - reference).max()
    add("proximal_error", error, "m", most=ACCURACY)
    for batch, suffix, least in ((BATCH, "", 100.0), (1, "_single", 25.0)):
        simulator = _simulator(paper(), batch)
        _run(simulator, DT, 10 * DT)
        proximal = _best(partial(_run, simulator, DT, duration), 2 if batch > 1 else 5) / duration
        simulator.reset(seed=0)
        loop = CompiledPaper(simulator)
        loop.run(EXPLICIT_DT, 10)
        steps = 200 if quick else (20_000 if batch > 1 else 200_000)  # of equal cost, so a part of the 10 s is enough
        explicit = _best(partial(loop.run, EXPLICIT_DT, steps), 2) / (steps * EXPLICIT_DT)
        add(f"speedup_vs_explicit{suffix}", explicit / proximal, least=least)
        elements = 2 * simulator.design.states.layout.size * batch  # state and input observers
        bare = _bare_time(elements, steps) / (steps * EXPLICIT_DT)
        add(f"explicit_to_floor{suffix}", explicit / bare, most=2.0 if batch > 1 else None)
        add(f"proximal{suffix}", proximal / batch * 1e3, "ms per environment and simulated s")
        add(f"explicit{suffix}", explicit / batch * 1e3, "ms per environment and simulated s")


def _bare_time(elements: int, repeats: int) -> float:
    e = np.random.default_rng(0).uniform(-0.95, 0.95, elements)
    slope, curvature = np.empty(elements), np.empty(elements)
    bare_loop(e, slope, curvature, 1)
    return _best(lambda: bare_loop(e, slope, curvature, repeats), 3)


def _ratio_to_floor(quick: bool, batch: int = 1024) -> float:
    """Time of the compiled solve per pair, component and Newton iteration, over the bare loop's per element."""
    simulator = _simulator(paper(), 16 if quick else batch)
    for _ in range(5):
        simulator.step(DT)
    layout, state = simulator.design.states.layout, simulator.state
    tau = DT * (1.0 - 1.0 / np.sqrt(2.0))
    whole = (0, simulator.num_envs), (0, len(layout.target))
    rho = np.empty((layout.rows, simulator.num_envs))
    estimate, slope = np.empty_like(state.memory["estimate"]), np.empty_like(state.memory["estimate"])
    seconds, evaluations = 0.0, 0
    for number in range(4 if quick else 51):  # along a run, for realistic warm starts
        simulator.step(DT)
        predictor, eps = state.memory["estimate"] + tau * DT, state.memory["eps"].copy()
        simulator.design.states.rho.evaluate(state.t, rho)
        start = time.perf_counter()
        count, failed, _ = solve(layout.arrays, tau, predictor, state.x, rho, eps, estimate, slope, *whole)
        if number:  # the first call may compile
            seconds += time.perf_counter() - start
            evaluations += count
        assert failed < 0
    elements = layout.size * simulator.num_envs
    return (seconds / evaluations) / (_bare_time(elements, 20) / (20 * elements))


def _machine() -> dict[str, Any]:
    return {
        "processor": platform.processor() or platform.machine(),
        "cores": os.cpu_count(),
        "load": os.getloadavg()[0] if hasattr(os, "getloadavg") else None,
        "python": platform.python_version(),
        "numpy": np.__version__,
    }
