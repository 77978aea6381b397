"""Threads that share the environments of a batch; compiled code doesn't hold the GIL."""

from __future__ import annotations

import itertools
import os
from collections.abc import Callable, Sequence
from concurrent.futures import Future, ThreadPoolExecutor
from typing import TypeAlias, TypeVar

import numpy as np

Range: TypeAlias = tuple[int, int]
"""First index and one past the last."""
T = TypeVar("T")
WORTH_A_START = 40_000
"""Numbers that a thread has to compute for its start and end, some 50 us, to pay; a sine counts as ten."""


def processors() -> int:
    """Number of processors that this process may use."""
    if hasattr(os, "sched_getaffinity"):
        return len(os.sched_getaffinity(0))
    return os.cpu_count() or 1  # where processes can't be bound to some


class Threads:
    """A number of threads, started when they are first needed; the calling thread is one of them.

    Args:
        count: number of threads.
    """

    def __init__(self, count: int) -> None:
        self.count = count
        self._pool: tuple[int, ThreadPoolExecutor] | None = None

    def __repr__(self) -> str:
        return f"Threads({self.count})"

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "_pool": None}  # threads don't survive pickling

    def ranges(self, size: int, least: int = 1) -> list[Range]:
        """As many equal parts of range(size) as there are threads; fewer where a part would be below `least`."""
        count = max(1, min(self.count, size // least))
        return list(itertools.pairwise(np.linspace(0, size, count + 1).astype(int).tolist()))

    def worthwhile(self, size: int, numbers: int) -> list[Range]:
        """`ranges`, of parts in which enough is computed to be worth a thread: `numbers` for each index."""
        return self.ranges(size, -(-WORTH_A_START // max(1, numbers)))

    def run(self, function: Callable[[Range], T], ranges: Sequence[Range]) -> list[T]:
        """`function` of every range, at once, and the results in their order.

        If some raise, all of them end first, and the first error is raised.
        """
        if len(ranges) == 1:
            return [function(ranges[0])]
        if self._pool is None or self._pool[0] != os.getpid():  # a forked child has the object but not the threads
            self._pool = os.getpid(), ThreadPoolExecutor(max(1, self.count - 1))
        others: list[Future[T]] = []
        try:
            for part in ranges[1:]:
                others.append(self._pool[1].submit(function, part))
            first = function(ranges[0])
        finally:
            _wait(others)
        return [first, *(other.result() for other in others)]


def _wait(others: Sequence[Future[T]]) -> None:
    """Wait until all have ended, also where Ctrl-C comes meanwhile: they write to arrays that its handler restores."""
    interrupt: BaseException | None = None
    for other in others:
        while not other.done():
            try:
                other.exception()
            except BaseException as raised:
                interrupt = raised
    if interrupt is not None:
        raise interrupt
