"""Time against error: steps of given and of controlled size, the explicit step, and SciPy's stiff solvers.

Everybody integrates the same closed loop over 10 s, and is judged by the largest error of a state at 1000 instants.
SciPy's solvers call a right-hand side that is one compiled call, of the functions that the simulator's step consists
of.
"""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable, Mapping, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import numpy as np

from agents import make_law
from benchmarks.report import Report
from benchmarks.yardsticks import CompiledPaper
from khop_env.compiled import compiled
from khop_env.observers import FloatArray, Proximal
from khop_env.observers.disagreement import correction, disagreement
from khop_env.observers.layout import PairArrays
from khop_env.observers.performance import exponentials
from khop_env.observers.prediction import predict
from khop_env.physics.right_hand_sides import drifts, input_maps
from khop_env.physics.waveforms import disturb
from khop_env.registry import scenario
from khop_env.scenarios import Scenario
from khop_env.simulation import Simulator, StepControl
from khop_env.simulation.edge_law import command_inputs
from khop_env.simulation.packing import (
    Values,
    Work,
    all_drifts_in,
    edges_in,
    estimates_in,
    input_runs_in,
    inputs_in,
    omega_in,
    rho_in,
    runs_in,
    states_in,
    terms_in,
)

DURATION = 10.0  # s
INTERVAL = 0.01  # s, between the instants
ACCURACY = 2e-3  # of the rows of `khop bench`: largest error, in the states' units
TOLERANCES = tuple(10.0 ** (-k / 8) for k in range(12, 41))  # 0.03 to 1e-5
_ONCE = 3.0  # s, above which a run isn't repeated
SOLVERS = ("LSODA", "BDF", "Radau")
ROWS = tuple(f"speedup_vs_scipy{kind}" for kind in ("", "_fixed", "_batch", "_mixed_fleet"))
Run = Callable[[], FloatArray | None]
"""Integrates, and returns the states (instants, n); None where it failed."""
Points = dict[str, list[tuple[float, float]]]
"""By method: errors, and times in s."""


@compiled
def closed_loop(
    integers: Any, floats: FloatArray, law: Any, now: Any, drawn: FloatArray, work: Any, rates: Any, xi: Any, e: Any
) -> None:
    """Write the rates of x, x_hat and g_hat of one environment into `rates`; `now` are `Values`, `work` is `Work`."""
    n, f, now, work = integers, floats, Values(*now), Work(*work)
    dx, dy, dghat = rates
    runs, terms, edges, rho, omega = runs_in(n, f), terms_in(n, f), edges_in(n, f), rho_in(n, f), omega_in(n, f)
    states, inputs = PairArrays(*states_in(n, f)), PairArrays(*inputs_in(n, f))
    command_inputs(law, edges, runs, now.x, now.estimate, now.u, work.terms, work.velocity, work.drift, 0, 1)
    input_maps(runs, now.x, now.u, now.g, 0, 1)
    drifts(runs, now.x, dx, 0, 1)
    if terms[0].size:
        disturb(terms, now.t, now.x, drawn, work.w, 0, 1)
    for row in range(dx.shape[0]):
        dx[row, 0] += now.g[row, 0] + work.w[row, 0]
    exponentials(now.t, rho[0], rho[1], rho[2], work.rho, 0, 1)
    disagreement(states, now.estimate, now.x, xi[0])
    correction(states, xi[0], work.rho, e[0], dy)
    predict(estimates_in(n, f), all_drifts_in(n), input_runs_in(n), now.estimate, now.input_estimate, xi[0], 0, 1)
    for row in range(dy.shape[0]):
        dy[row, 0] += xi[0][row, 0]
    exponentials(now.t, omega[0], omega[1], omega[2], work.omega, 0, 1)
    disagreement(inputs, now.input_estimate, now.g, xi[1])
    correction(inputs, xi[1], work.omega, e[1], dghat)


class RightHandSide:
    """The closed loop of a simulator of one environment as SciPy's solvers call it, from its state on.

    Args:
        simulator: without Python in its step; its state isn't changed.
    """

    def __init__(self, simulator: Simulator) -> None:
        step, state = simulator._compiled, simulator.save()
        assert step is not None
        self.start = np.concatenate([state.x[:, 0], *(state.memory[name][:, 0] for name in _ESTIMATES)])
        self._blocks = state.x, *(state.memory[name] for name in _ESTIMATES)
        self._cuts = np.cumsum([len(block) for block in self._blocks])[:-1]
        self._t, self._rates = state.t, tuple(np.zeros_like(block) for block in self._blocks)
        scratch = [tuple(np.zeros_like(block) for block in self._blocks[1:]) for _ in range(2)]
        work = tuple(np.zeros_like(each) for each in step._work)
        law, now = simulator.plant.edge_law(), tuple(Values.of(state))
        self._arguments: tuple[Any, ...] = (*step._system, law, now, state.drawn, work, self._rates, *scratch)

    def __call__(self, t: float, flat: FloatArray) -> FloatArray:
        """Rates of all values in one vector."""
        self._t[0] = t
        for block, part in zip(self._blocks, np.split(flat, self._cuts), strict=True):
            block[:, 0] = part
        closed_loop(*self._arguments)
        return np.concatenate([rate[:, 0] for rate in self._rates])


_ESTIMATES = ("estimate", "input_estimate")


class Problem:
    """The closed loop of a scenario, and its exact solution.

    Args:
        name: of the scenario.
        duration: in s.
    """

    def __init__(self, name: str, duration: float = DURATION) -> None:
        self.name, self.duration, self.scenario = name, duration, scenario(name)
        self.times = INTERVAL * np.arange(1, round(duration / INTERVAL) + 1)
        self.exact = self.steps(3, INTERVAL / 10)()

    def error(self, found: FloatArray | None) -> float:
        """The largest error of a state; inf where there are none."""
        assert self.exact is not None
        if found is None or found.shape != self.exact.shape:
            return np.inf
        largest = float(np.abs(found - self.exact).max())
        return largest if np.isfinite(largest) else np.inf

    def steps(self, order: int, dt: float, batch: int = 1) -> Run:
        """Proximal steps of `dt` seconds, of which instants are a multiple or the other way round."""
        simulator = simulator_of(self.scenario, order, batch)
        start = simulator.save()

        def run() -> FloatArray:
            simulator.restore(start)
            found = [simulator.x[0].copy()]
            for _ in range(round(self.duration / dt)):
                simulator.step(dt)
                found.append(simulator.x[0].copy())
            if dt <= INTERVAL:
                return np.array(found[round(INTERVAL / dt) :: round(INTERVAL / dt)])
            return cubic(dt, np.array(found), self.times)

        return run

    def controlled(self, tolerance: float, order: int = 3) -> Run:
        """Steps of controlled size, with the states inside them."""
        simulator = simulator_of(self.scenario, order)
        StepControl(simulator, tolerance).warm_up()
        start, out = simulator.save(), np.zeros((simulator.fleet.n, len(self.times)))

        def run() -> FloatArray:
            simulator.restore(start)
            control, done = StepControl(simulator, tolerance), 0
            while done < len(self.times):
                control.step(self.duration)
                end = float(simulator.t[0])
                inside = self.times[done : int(np.searchsorted(self.times, end + 1e-12, "right"))]
                control.states_at(np.minimum(1.0 - (end - inside) / control.last, 1.0), control.last, done, out)
                done += len(inside)
            return out.T

        return run

    def explicit(self, dt: float) -> Run:
        """The paper's sampling, compiled whole; of `paper` only."""
        simulator = simulator_of(self.scenario, 2)

        def run() -> FloatArray:
            loop, found = CompiledPaper(simulator), []
            for _ in self.times:
                loop.run(dt, round(INTERVAL / dt))
                found.append(loop.z[0][:, 0].copy())
            return np.array(found)

        return run

    def scipy(self, method: str, tolerance: float) -> Run:
        """A solver of SciPy, rtol = atol = tolerance."""
        from scipy.integrate import solve_ivp

        simulator = simulator_of(self.scenario, 2)
        equations, n = RightHandSide(simulator), simulator.fleet.n
        options = {"t_eval": self.times, "rtol": tolerance, "atol": tolerance}

        def run() -> FloatArray | None:
            try:
                with np.errstate(all="ignore"):  # trial points outside the funnels
                    found = solve_ivp(equations, (0.0, self.times[-1]), equations.start, method, **options)
            except ValueError:  # a Jacobian at such a point
                return None
            return found.y[:n].T if found.success else None

        return run

    def loosest(self, make: Callable[[float], Run]) -> tuple[float, Run] | None:
        """The loosest tolerance with the required accuracy, and the run; None if none has it."""
        for tolerance in TOLERANCES:
            run = make(tolerance)
            if self.error(run()) <= ACCURACY:
                return tolerance, run
        return None


def simulator_of(chosen: Scenario, order: int, batch: int = 1) -> Simulator:
    """A closed loop, reset with seed 0."""
    simulator = chosen.build(law=make_law(chosen.law), observers=Proximal(order), num_envs=batch)
    simulator.warm_up(long=True)
    return simulator


def cubic(dt: float, values: FloatArray, times: Any) -> FloatArray:
    """Values (steps + 1, n) every `dt` seconds, at other times: by cubic polynomials through the four nearest."""
    first = np.clip(np.floor(times / dt).astype(int) - 1, 0, len(values) - 4)
    share = times / dt - first
    found = np.zeros((len(times), values.shape[1]))
    for k in range(4):
        others = [j for j in range(4) if j != k]
        weight = np.prod([(share - j) / (k - j) for j in others], axis=0)
        found += weight[:, None] * values[first + k]
    return found


def medians(runs: Mapping[Any, Run], repeats: int) -> dict[Any, float]:
    """Median of the times of each run in s; they take turns, so that a busy moment hits all."""
    seconds: dict[Any, list[float]] = {name: [] for name in runs}
    for _ in range(repeats):
        for name, run in runs.items():
            start = time.perf_counter()
            run()
            seconds[name].append(time.perf_counter() - start)
    return {name: statistics.median(each) for name, each in seconds.items()}


def scipy_rows(report: Report, quick: bool, say: Callable[[str], None], batch: int = 64) -> None:
    """Time of SciPy's LSODA over ours, each at the loosest tolerance that keeps the error below `ACCURACY`."""
    duration, repeats = (0.2, 1) if quick else (DURATION, 7)
    for name, suffix in (("paper", ""), ("mixed_fleet", "_mixed_fleet")):
        problem = Problem(name, duration)
        ours, theirs = problem.loosest(problem.controlled), problem.loosest(partial(problem.scipy, "LSODA"))
        if ours is None or theirs is None:
            report.skip(f"speedup_vs_scipy{suffix}", f"no tolerance kept the error below {ACCURACY:g}")
            continue
        say(f"  {name}: tolerance {ours[0]:.3g}; LSODA: rtol = atol = {theirs[0]:.3g}")
        runs = {"ours": ours[1], "theirs": theirs[1]}
        if name == "paper":
            runs |= {"fixed": problem.steps(2, INTERVAL), "batch": problem.steps(2, INTERVAL, batch)}
        seconds = medians(runs, repeats)
        report.add(f"speedup_vs_scipy{suffix}", seconds["theirs"] / seconds["ours"], least=3.0)
        if name == "paper":
            report.add("speedup_vs_scipy_fixed", seconds["theirs"] / seconds["fixed"])
            report.add("speedup_vs_scipy_batch", seconds["theirs"] / (seconds["batch"] / batch))


def work_precision(name: str, say: Callable[[str], None], repeats: int = 3) -> Points:
    """Error and median time in s of each method, from loose to tight."""
    problem = Problem(name)
    proximal = {f"proximal, order {order}": partial(problem.steps, order) for order in (1, 2, 3)}
    methods: dict[str, tuple[Callable[[float], Run], Sequence[float]]] = {
        method: (make, [0.05, 0.02, 0.01, 0.005, 0.002]) for method, make in proximal.items()
    }
    methods["controlled size"] = problem.controlled, TOLERANCES[::4]
    methods |= {method: (partial(problem.scipy, method), TOLERANCES[4::8]) for method in SOLVERS}
    if name == "paper":
        methods["explicit"] = problem.explicit, [2e-5, 1e-5]
    runs, errors, seconds = {}, {}, {}
    for method, (make, settings) in methods.items():
        for setting in settings:
            run = make(setting)
            start = time.perf_counter()
            errors[method, setting] = error = problem.error(run())
            taken = time.perf_counter() - start
            say(f"  {name}, {method}, {setting:.3g}: error {error:.3g}, {taken:.3g} s")
            if np.isfinite(error):
                seconds[method, setting] = taken
                if taken < _ONCE:
                    runs[method, setting] = run
            elif taken > _ONCE:
                break  # tighter ones take longer still
    seconds |= medians(runs, repeats)
    found: Points = {}
    for (method, setting), taken in seconds.items():
        found.setdefault(method, []).append((errors[method, setting], taken))
    return found


def figure(points: Mapping[str, Points], path: Path) -> None:
    """Draw time against error, one panel per scenario."""
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    from khop_env.results.figures import COLORS, STYLE

    methods = dict.fromkeys(method for each in points.values() for method in each)
    thin = [method for method in methods if method not in ("controlled size", "explicit")]
    colors = {method: COLORS[number] for number, method in enumerate(thin)}
    colors |= {"controlled size": "black", "explicit": "#888888"}
    with rc_context(STYLE):
        drawn = Figure(figsize=(8.4, 4.2), layout="constrained")
        panels = drawn.subplots(1, len(points), sharey=True, squeeze=False)[0]
        for axes, (name, each) in zip(panels, points.items(), strict=True):
            for method, values in each.items():
                bold = method == "controlled size"
                error, seconds = np.array(values).T
                axes.loglog(
                    error,
                    seconds,
                    "o-" if method not in SOLVERS else "s--",
                    color=colors[method],
                    linewidth=2.2 if bold else 1.2,
                    markersize=4,
                    label=method,
                )
            axes.axvline(ACCURACY, color="#999999", linewidth=0.8, linestyle=":")
            axes.set_title(name, fontsize=10)
            axes.set_xlabel("largest error of a state")
        panels[0].set_ylabel("time for 10 s (s)")
        panels[0].legend(fontsize=8)
        drawn.savefig(path, dpi=150)
