"""Recording of an episode in steps of controlled size."""

from __future__ import annotations

import time as clock

import numpy as np

from khop_env.observers import SolveError
from khop_env.results.recording import TIME_DECIMALS, Failure, Progress, Recording, Samples, most_samples_of
from khop_env.scenarios.scenario import number_of_steps
from khop_env.simulation import DenseOutput, Simulator, StepControl

_ROUNDING = 1e-12  # s


def record_controlled(
    simulator: Simulator,
    duration: float,
    tolerance: float,
    *,
    samples_per_second: float = 100.0,
    progress: Progress | None = None,
) -> Recording:
    """Run the simulator from its current time to `duration` in steps of controlled size, and record samples.

    Samples are at fixed times, within steps; they keep the guarantee as the steps do.

    Args:
        simulator: simulator of one environment, just reset, with a law, and with the proximal step of order 2 or 3.
        duration: final time in s.
        tolerance: largest estimated error of a step, as in `Simulator.advance`.
        samples_per_second: there are fewer if an array would hold more than `MOST_ROWS` numbers.
        progress: called repeatedly with the completed fraction.

    Returns:
        The recording. If a step fails, `Recording.error` holds the exception, and earlier samples are kept.

    Raises:
        ValueError: if the simulator has several environments or other observers, the tolerance isn't from 1e-9 to 1, or
            the duration isn't positive and finite, or too long for the samples.
    """
    most_samples = most_samples_of(simulator, samples_per_second)
    start_time = float(simulator.t[0])
    interval = max(1.0 / samples_per_second, duration / (most_samples - 1))
    count = number_of_steps(duration, interval)
    grid = np.append(np.round(interval * np.arange(1, count), TIME_DECIMALS), duration)
    grid = grid[grid > start_time]
    simulator.warm_up()
    control = StepControl(simulator, tolerance)
    control.require(duration)
    samples = Samples(simulator, len(grid) + 1, None, None)
    error: Failure | None = None
    with np.errstate(all="ignore"):
        control.warm_up()
        dense = DenseOutput(control, samples.take)
        start = reported = clock.perf_counter()
        samples.take(simulator)
        sampled = 0
        try:
            while sampled < len(grid):
                control.step(duration)
                stop = int(np.searchsorted(grid, simulator.t[0] + _ROUNDING, "right"))
                dense.take(grid[sampled:stop])
                sampled = stop
                if progress is not None and (now := clock.perf_counter()) - reported > 0.1:
                    reported = now
                    progress(float(simulator.t[0]) / duration)
            dense.flush()
        except SolveError as stopped:
            error = stopped
            dense.flush()
            if samples.newest < simulator.t[0]:
                samples.take(simulator)
    wall_time = clock.perf_counter() - start
    if progress is not None and error is None:
        progress(1.0)
    return samples.recording(control.accepted, wall_time, error, control.rejected)
