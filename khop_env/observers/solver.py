"""The proximal solve of one layout, split over Python threads; the compiled code doesn't hold the GIL."""

from __future__ import annotations

import itertools
import os
from concurrent.futures import ThreadPoolExecutor

import numpy as np

from khop_env.observers.layout import FloatArray, PairLayout
from khop_env.observers.solve import LANES, solve
from khop_env.observers.weights import Weights


class Solver:
    """Solves for all observers of one layout, by environments or, in a small batch, by targets.

    Args:
        layout: the pairs (observer, target).
        num_envs: number of environments.
        threads: number of threads; results don't depend on it.
    """

    def __init__(self, layout: PairLayout, num_envs: int, threads: int) -> None:
        self._pairs = layout.packed
        targets = len(layout.target)
        by_environment = num_envs >= threads * LANES
        cuts = np.linspace(0, num_envs if by_environment else targets, threads + 1).astype(int).tolist()
        parts = list(itertools.pairwise(cuts))
        self._ranges = [(part, (0, targets)) if by_environment else ((0, num_envs), part) for part in parts]
        self._pool: tuple[int, ThreadPoolExecutor] | None = None

    def __getstate__(self) -> dict[str, object]:
        return {**self.__dict__, "_pool": None}  # threads don't survive pickling

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
        if len(self._ranges) == 1:
            return [solve(self._pairs, tau, y, source, rho, eps, y, slope, *self._ranges[0], *more)]
        if self._pool is None or self._pool[0] != os.getpid():  # a forked child has the object but not the threads
            self._pool = (os.getpid(), ThreadPoolExecutor(len(self._ranges)))
        return list(
            self._pool[1].map(
                lambda part: solve(self._pairs, tau, y, source, rho, eps, y, slope, *part, *more), self._ranges
            )
        )
