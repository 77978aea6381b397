"""What a second thread brings: whole steps of a batch, beside a loop that needs no memory."""

from __future__ import annotations

import math
import statistics
import time
from collections.abc import Callable

from benchmarks.report import Report
from khop_env.compiled import compiled
from khop_env.threads import Range, Threads

Step = Callable[[int], None]
LEAST = 1.7  # of the ratios of rates
ROOTS = 500_000  # in the plain loop, some ms


def thread_rows(
    report: Report, cases: dict[str, Callable[[int], Step]], seconds: float, turns: int, say: Callable[[str], None]
) -> None:
    """Add the gain of the second thread in each case, and in a plain loop, medians over turns of both.

    Args:
        report: takes the rows.
        cases: by name of the row, a step in so many threads as are asked for.
        seconds: to measure a rate.
        turns: number of alternating measurements.
        say: called with a line before each row.
    """
    for name, step_of in cases.items():
        say(f"environments: {name}")
        one, two = step_of(1), step_of(2)
        gains: list[float] = []
        plain: list[float] = []
        for _ in range(turns):
            gains.append(_rate(two, seconds) / _rate(one, seconds))
            plain.append(_rate(_plain(2), seconds / 4) / _rate(_plain(1), seconds / 4))
        report.add(f"{name}_plain", statistics.median(plain), "x one thread")
        report.add(name, statistics.median(gains), "x one thread", least=LEAST)


def _rate(step: Step, seconds: float) -> float:
    """Calls of `step` per second; the first isn't counted."""
    step(0)
    number, start = 0, time.perf_counter()
    while (elapsed := time.perf_counter() - start) < seconds or number == 0:
        step(number)
        number += 1
    return number / elapsed


def _plain(threads: int) -> Step:
    pool = Threads(threads)
    ranges = pool.ranges(ROOTS)

    def step(number: int) -> None:
        pool.run(_roots_of, ranges)

    return step


def _roots_of(part: Range) -> float:
    return roots(part[1] - part[0])


@compiled
def roots(count: int) -> float:
    """A chain of so many square roots."""
    value = 0.0
    for _ in range(count):
        value = math.sqrt(value + 1.0)
    return value
