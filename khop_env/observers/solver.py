"""The proximal solve of one layout, split over threads."""

from __future__ import annotations

from khop_env.observers.layout import FloatArray, PairLayout
from khop_env.observers.solve import solve
from khop_env.observers.weights import Weights
from khop_env.threads import Range, Threads

FEWEST = 64  # environments of a thread; with fewer, threads share the targets


class Solver:
    """Solves for all observers of one layout, by environments or, in a small batch, by targets.

    Args:
        layout: the pairs (observer, target).
        num_envs: number of environments.
        threads: that share the work; results don't depend on them.
    """

    def __init__(self, layout: PairLayout, num_envs: int, threads: Threads) -> None:
        self._pairs, self._threads = layout.packed, threads
        self._all = ((0, num_envs), (0, len(layout.target)))
        self._by_environment = num_envs >= threads.count * FEWEST
        self._ranges = threads.ranges(self._all[0 if self._by_environment else 1][1])

    def __call__(
        self,
        tau: float,
        y: FloatArray,
        source: FloatArray,
        rho: FloatArray,
        eps: FloatArray,
        slope: FloatArray,
        weights: Weights | None = None,
    ) -> list[tuple[int, int, int]]:
        """`solve` from the predictor `y`, which the estimates overwrite; returns its results, range by range."""
        more = () if weights is None else (weights,)
        (environments, targets), by_environment = self._all, self._by_environment

        def part(range_: Range) -> tuple[int, int, int]:
            where = (range_, targets) if by_environment else (environments, range_)
            return solve(self._pairs, tau, y, source, rho, eps, y, slope, *where, *more)

        return self._threads.run(part, self._ranges)
