"""One simulated episode, sampled: what tables, metrics and figures are made from."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from khop_env.observers import Extremes, FloatArray, FunnelBank, FunnelError, Funnels, ObserverDesign, SolveError
from khop_env.physics import Fleet
from khop_env.scenarios.scenario import number_of_steps
from khop_env.simulation import Simulator

Progress = Callable[[float], None]
"""Called now and then with the fraction of the episode that is done."""

MOST_ROWS = 5_000_000
"""Samples times estimates that a recording may hold (40 MB an array): larger fleets are sampled less often."""

_TIME_DECIMALS = 12  # grid times are rounded to picoseconds: 0.07, not 0.07000000000000001


@dataclass(frozen=True, eq=False)
class ObserverRecord:
    """The samples of one kind of observer: of the states (PPSO), or of the inputs' effects g (PPIO).

    Attributes:
        funnels: who estimates whom, and within which bounds; P estimates in the order of `funnels.layout`.
        time: (T,) in s.
        truth: (T, n) what is estimated: the fleet's x, or its g.
        estimate: (T, P).
        disagreement: (T, P) xi, or mu.
    """

    funnels: Funnels
    time: FloatArray
    truth: FloatArray
    estimate: FloatArray
    disagreement: FloatArray

    @property
    def truth_per_estimate(self) -> FloatArray:
        """(T, P) the true value of what each estimate is an estimate of."""
        return self.truth[:, self.funnels.layout.column_source]

    @property
    def error(self) -> FloatArray:
        """(T, P) estimation errors x_tilde, or g_tilde."""
        with np.errstate(invalid="ignore"):  # inf - inf, of states that ran away, is nan
            return self.estimate - self.truth_per_estimate

    @property
    def rho(self) -> FloatArray:
        """(T, P) funnels on the disagreements: rho, or omega."""
        return self._evaluate(self.funnels.rho)

    @property
    def delta(self) -> FloatArray:
        """(T, P) bounds on the errors that the observers were designed for: delta, or theta."""
        return self._evaluate(self.funnels.delta)

    @property
    def bound(self) -> FloatArray:
        """(T, P) each observer's own guaranteed bound on the error; at most delta, or theta."""
        out = np.empty((self.funnels.layout.size, len(self.time)))
        return self.funnels.error_bounds(self._rows(self.funnels.delta), out).T

    def _evaluate(self, bank: FunnelBank) -> FloatArray:
        return self._rows(bank).T[:, self.funnels.layout.column_row]

    def _rows(self, bank: FunnelBank) -> FloatArray:
        return bank.evaluate(self.time, np.empty((len(bank), len(self.time))))


@dataclass(frozen=True, eq=False)
class Recording:
    """Samples of one episode in one environment, and what was seen at every step between them.

    Attributes:
        design: fleet, graph and observers.
        x: (T, n) states.
        u: (T, m) inputs.
        states: what the state observers did.
        inputs: what the input observers did; of width 0 where there are none.
        extremes: the largest ratios over ALL steps, sampled or not; arrays of shape (1,).
        steps: number of steps taken.
        wall_time: seconds spent stepping and sampling; not in compiling.
        error: why the episode ended early, or None. Everything up to then is here.
        task_error: (T,) the team's mean task error, where an environment's task was played; otherwise None.
    """

    design: ObserverDesign
    x: FloatArray
    u: FloatArray
    states: ObserverRecord
    inputs: ObserverRecord
    extremes: Extremes
    steps: int
    wall_time: float
    error: FunnelError | SolveError | None = None
    task_error: FloatArray | None = None

    @property
    def fleet(self) -> Fleet:
        """The agents."""
        return self.design.fleet

    @property
    def time(self) -> FloatArray:
        """(T,) time of each sample in s: 0, then at most so many a second as were asked for, then the end."""
        return self.states.time

    @property
    def completed(self) -> bool:
        """Whether the episode ran to its end."""
        return self.error is None


def record(
    simulator: Simulator,
    duration: float,
    dt: float,
    *,
    samples_per_second: float = 100.0,
    task_error: Callable[[], float] | None = None,
    progress: Progress | None = None,
) -> Recording:
    """Run the simulator from where it stands to `duration`, and keep samples of everything.

    Step k ends at k dt, however many went before it (no drift), and the last one is shortened to end at `duration`.

    Args:
        simulator: of one environment, just reset, and with a law.
        duration: s.
        dt: step in s.
        samples_per_second: at most this many; fewer where the steps are longer, or the fleet is so large that more
            than `MOST_ROWS` numbers would be kept in an array.
        task_error: sampled, too, if given: the error of the task that is played.
        progress: told now and then how far it is.

    Returns:
        The recording. Where the integrator gave up midway, `Recording.error` says why, and all samples before stand.

    Raises:
        ValueError: for more than one environment, or a duration or step that isn't positive and finite, or too short
            or long for the other.
    """
    if simulator.num_envs != 1:
        raise ValueError(f"one environment is recorded at a time; the simulator has num_envs={simulator.num_envs}")
    steps = number_of_steps(duration, dt)
    if not 0.0 < samples_per_second < math.inf:
        raise ValueError(f"samples_per_second must be positive and finite; got {samples_per_second!r}")
    design = simulator.design
    width = max(1, design.states.layout.size, design.inputs.layout.size)
    most_samples = max(2, MOST_ROWS // width)
    stride = max(1, math.ceil(1.0 / (dt * samples_per_second) - 1e-9), math.ceil(steps / (most_samples - 1)))
    samples = _Samples(simulator, 1 + math.ceil(steps / stride), task_error)
    error: FunnelError | SolveError | None = None
    with np.errstate(all="ignore"):  # NumPy's warnings name no agent; SolveError does, and a summary says what ran away
        simulator.warm_up()
        start = shown = clock.perf_counter()
        samples.take()
        done = 0
        try:
            for k in range(1, steps + 1):
                until = duration if k == steps else round(k * dt, _TIME_DECIMALS)
                simulator.step(until - float(simulator.t[0]))
                done = k
                if k % stride == 0 or k == steps:
                    samples.take()
                if progress is not None and (now := clock.perf_counter()) - shown > 0.1:
                    shown = now
                    progress(k / steps)
        except (FunnelError, SolveError) as stopped:  # the state is the one before the step: worth keeping
            error = stopped
            if done % stride:
                samples.take()
    wall_time = clock.perf_counter() - start
    if progress is not None and error is None:
        progress(1.0)
    return samples.recording(done, wall_time, error)


class _Samples:
    """Arrays for all samples of an episode, filled one by one."""

    def __init__(self, simulator: Simulator, count: int, task_error: Callable[[], float] | None) -> None:
        self._simulator = simulator
        self._sources: dict[str, Callable[[], FloatArray]] = {
            "time": lambda: simulator.t,
            "x": lambda: simulator.x[0],
            "u": lambda: simulator.u[0],
            "g": lambda: simulator.g[0],
            "estimate": lambda: simulator.estimates[0],
            "disagreement": lambda: simulator.disagreements()[0],
            "input_estimate": lambda: simulator.input_estimates[0],
            "input_disagreement": lambda: simulator.input_disagreements()[0],
        }
        if task_error is not None:
            self._sources["task_error"] = lambda: np.array([task_error()])
        self._arrays = {name: np.empty((count, len(read()))) for name, read in self._sources.items()}
        self._taken = 0

    def take(self) -> None:
        for name, read in self._sources.items():
            self._arrays[name][self._taken] = read()
        self._taken += 1

    def recording(self, steps: int, wall_time: float, error: FunnelError | SolveError | None) -> Recording:
        design = self._simulator.design
        kept = {name: values[: self._taken] for name, values in self._arrays.items()}
        time = kept["time"][:, 0]
        return Recording(
            design=design,
            x=kept["x"],
            u=kept["u"],
            states=ObserverRecord(design.states, time, kept["x"], kept["estimate"], kept["disagreement"]),
            inputs=ObserverRecord(design.inputs, time, kept["g"], kept["input_estimate"], kept["input_disagreement"]),
            extremes=self._simulator.extremes,
            steps=steps,
            wall_time=wall_time,
            error=error,
            task_error=kept["task_error"][:, 0] if "task_error" in kept else None,
        )
