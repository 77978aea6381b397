"""Recording of a simulated episode: samples for tables, metrics and figures."""

from __future__ import annotations

import math
import time as clock
from collections.abc import Callable
from dataclasses import dataclass

import numpy as np

from khop_env.observers import Extremes, FloatArray, FunnelError, Networked, ObserverDesign, SolveError
from khop_env.observers.networked import missed_rounds
from khop_env.physics import Fleet
from khop_env.results.records import MessageRecord, ObserverRecord
from khop_env.scenarios.scenario import number_of_steps
from khop_env.simulation import Simulator
from khop_env.tasks import MapCanvas

Drawing = Callable[[MapCanvas], None]
"""Draws on a frame."""

Progress = Callable[[float], None]
"""Called repeatedly with the completed fraction, from 0 to 1."""

MOST_ROWS = 5_000_000
"""Limit on samples times estimates of a recording (40 MB per array); larger fleets are sampled less often."""

TIME_DECIMALS = 12  # grid times are rounded to picoseconds: 0.07, not 0.07000000000000001


class StoppedError(RuntimeError):
    """The recorded run can't go on, for a reason that isn't the observers' or the plant's."""


Failure = FunnelError | SolveError | StoppedError


@dataclass(frozen=True, eq=False)
class Recording:
    """Samples of one episode in one environment, with extremes over all steps.

    Attributes:
        design: design of the observers, with fleet and graph.
        x: (T, n) states.
        u: (T, m) inputs.
        states: samples of the state observers; of estimates over messages, if the run had a network.
        inputs: samples of the input observers; P = 0 if there are none, and None under a network.
        extremes: largest ratios over all steps, also those between samples; arrays of shape (1,).
        steps: number of steps taken.
        rejected: number of steps of controlled size that were taken back; None for steps of a given size.
        wall_time: seconds of stepping and sampling, without compilation.
        error: the exception that ended the episode early, or None; samples until then are kept.
        task_error: (T,) mean task error of the team; None without an environment's task.
        drawings: (T,) what an environment's task adds to a frame of each sample; None if that wasn't recorded.
    """

    design: ObserverDesign
    x: FloatArray
    u: FloatArray
    states: ObserverRecord | MessageRecord
    inputs: ObserverRecord | None
    extremes: Extremes
    steps: int
    wall_time: float
    error: Failure | None = None
    task_error: FloatArray | None = None
    drawings: tuple[Drawing, ...] | None = None
    rejected: int | None = None

    def __repr__(self) -> str:
        samples = f"{len(self.time)} samples of {self.steps} steps to t = {self.time[-1]:g} s"
        return f"Recording({self.design}; {samples}{'' if self.error is None else ', ended early'})"

    @property
    def fleet(self) -> Fleet:
        """The agents."""
        return self.design.fleet

    @property
    def time(self) -> FloatArray:
        """(T,) sample times in s: 0, at most `samples_per_second` per second, and the final time."""
        return self.states.time

    @property
    def completed(self) -> bool:
        """True if the episode reached its end."""
        return self.error is None


def record(
    simulator: Simulator,
    duration: float,
    dt: float,
    *,
    samples_per_second: float = 100.0,
    task_error: Callable[[], float] | None = None,
    ended: Callable[[], bool] | None = None,
    drawing: Callable[[], Drawing] | None = None,
    progress: Progress | None = None,
) -> Recording:
    """Run the simulator from its current time to `duration`, and record samples.

    Step k ends at exactly k dt (no accumulated rounding), and the last step is shortened to end at `duration`.

    Args:
        simulator: simulator of one environment, just reset, with a law.
        duration: final time in s.
        dt: step in s.
        samples_per_second: upper limit; there are fewer if steps are longer, or if an array would hold more than
            `MOST_ROWS` numbers.
        task_error: returns the current error of the environment's task, to be sampled; or None.
        ended: returns whether the episode is over before its time; called after every step.
        drawing: returns what the environment's task adds to a frame at present, for films; or None.
        progress: called repeatedly with the completed fraction.

    Returns:
        The recording. If a step fails, `Recording.error` holds the exception, and earlier samples are kept.

    Raises:
        ValueError: if the simulator has several environments, or duration or step isn't positive and finite, or there
            would be too many steps.
    """
    steps = number_of_steps(duration, dt)
    most_samples = most_samples_of(simulator, samples_per_second)
    stride = max(1, math.ceil(1.0 / (dt * samples_per_second) - 1e-9), math.ceil(steps / (most_samples - 1)))
    samples = Samples(simulator, 1 + math.ceil(steps / stride), task_error, drawing)
    error: Failure | None = None
    with np.errstate(all="ignore"):  # NumPy's warnings name no agent; SolveError and the summary do
        simulator.warm_up()
        start = reported = clock.perf_counter()
        samples.take(simulator)
        done = 0
        try:
            for k in range(1, steps + 1):
                until = duration if k == steps else round(k * dt, TIME_DECIMALS)
                simulator.step(until - float(simulator.t[0]))
                done = k
                over = ended is not None and ended()
                if k % stride == 0 or k == steps or over:
                    samples.take(simulator)
                if over:
                    break
                if progress is not None and (now := clock.perf_counter()) - reported > 0.1:
                    reported = now
                    progress(k / steps)
        except (FunnelError, SolveError, StoppedError) as stopped:  # the state before the failed step is kept
            error = stopped
            if done % stride:
                samples.take(simulator)
    wall_time = clock.perf_counter() - start
    if progress is not None and error is None:
        progress(1.0)
    return samples.recording(done, wall_time, error)


def most_samples_of(simulator: Simulator, samples_per_second: float) -> int:
    """The largest number of samples of a run.

    Raises:
        ValueError: for a simulator of several environments, or samples per second that aren't positive and finite.
    """
    if simulator.num_envs != 1:
        raise ValueError(f"expected a simulator of one environment; got num_envs={simulator.num_envs}")
    if not 0.0 < samples_per_second < math.inf:
        raise ValueError(f"samples_per_second must be positive and finite; got {samples_per_second!r}")
    return max(2, MOST_ROWS // max(1, simulator.observers.layout.size, simulator.design.inputs.layout.size))


class Samples:
    """Arrays for all samples of an episode.

    Args:
        simulator: of which, or of whose closed loop, samples are taken.
        count: number of samples, at most.
        task_error: as in `record`.
        drawing: as in `record`.
    """

    def __init__(
        self,
        simulator: Simulator,
        count: int,
        task_error: Callable[[], float] | None,
        drawing: Callable[[], Drawing] | None,
    ) -> None:
        self._simulator, self._drawing = simulator, drawing
        self._drawings: list[Drawing] = []
        self._sources: dict[str, Callable[[Simulator], FloatArray]] = {  # (B, columns), environment by environment
            "time": lambda sim: sim.t[:, None],
            "x": lambda sim: sim.x,
            "u": lambda sim: sim.u,
            "g": lambda sim: sim.g,
            "estimate": lambda sim: sim.estimates,
        }
        observers = simulator.observers
        if observers.links_up(simulator.state) is not None:
            self._sources["up"] = lambda sim: np.asarray(sim.observers.links_up(sim.state), float).T
        if observers.by_messages:
            self._sources |= {
                "bound": lambda sim: sim.error_bounds().bound.T,
                "age": lambda sim: sim.observers.information(sim.state).age.T,
                "missed": lambda sim: missed_rounds(sim.observers, sim.state).T,
            }
        else:
            self._sources |= {
                "disagreement": lambda sim: sim.disagreements(),
                "input_estimate": lambda sim: sim.input_estimates,
                "input_disagreement": lambda sim: sim.input_disagreements(),
            }
        if task_error is not None:
            self._sources["task_error"] = lambda sim: np.array([[task_error()]])
        self._arrays = {name: np.empty((count, read(simulator).shape[1])) for name, read in self._sources.items()}
        self._taken = 0

    @property
    def newest(self) -> float:
        """Time of the newest sample."""
        return float(self._arrays["time"][self._taken - 1, 0])

    def take(self, simulator: Simulator, count: int = 1) -> None:
        """Add a sample from each of a simulator's first environments."""
        rows = slice(self._taken, self._taken + count)
        for name, read in self._sources.items():
            self._arrays[name][rows] = read(simulator)[:count]
        if self._drawing is not None:
            self._drawings.append(self._drawing())
        self._taken += count

    def recording(self, steps: int, wall_time: float, error: Failure | None, rejected: int | None = None) -> Recording:
        """The recording of the samples so far."""
        design = self._simulator.design
        kept = {name: values[: self._taken] for name, values in self._arrays.items()}
        time = kept["time"][:, 0]
        up = kept["up"].astype(bool) if "up" in kept else None
        states: ObserverRecord | MessageRecord
        if "age" in kept:
            observers = self._simulator.observers
            network, estimator = None, observers.name
            if isinstance(observers, Networked):
                network, estimator = observers.drawn(self._simulator.state)[0], observers.estimator.name
            states = MessageRecord(
                layout=observers.layout,
                time=time,
                truth=kept["x"],
                estimate=kept["estimate"],
                bound=kept["bound"],
                age=kept["age"],
                missed=kept["missed"],
                network=network,
                estimator=estimator,
                up=up,
            )
            inputs = None
        else:
            states = ObserverRecord(design.states, time, kept["x"], kept["estimate"], kept["disagreement"], up)
            estimates = kept["input_estimate"], kept["input_disagreement"]
            inputs = ObserverRecord(design.inputs, time, kept["g"], *estimates, up)
        return Recording(
            design=design,
            x=kept["x"],
            u=kept["u"],
            states=states,
            inputs=inputs,
            extremes=self._simulator.extremes,
            steps=steps,
            wall_time=wall_time,
            error=error,
            task_error=kept["task_error"][:, 0] if "task_error" in kept else None,
            drawings=None if self._drawing is None else tuple(self._drawings),
            rejected=rejected,
        )
