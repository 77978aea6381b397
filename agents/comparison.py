"""A table of policies and observation modes over the same episodes, on one core, several, or a Ray cluster."""

from __future__ import annotations

import concurrent.futures
import math
import multiprocessing
import statistics
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import dataclass, field
from functools import lru_cache
from typing import TYPE_CHECKING, Any

import numpy as np

from agents.evaluation import Episodes, play
from agents.learning.learned import LearnedPolicy
from agents.policies import make_policy
from agents.policy import EnvDescription, describe
from khop_env.env import BatchedEnv
from khop_env.observers import FloatArray
from khop_env.registry import make_batched, task_class
from khop_env.results.metrics import finite
from khop_env.results.recording import Progress
from khop_env.simulation import Observe

if TYPE_CHECKING:
    import polars as pl

CHUNK = 25  # episodes played at once; fixed, so that no number depends on who plays how many

_Arguments = tuple[tuple[str, Any], ...]
_Task = tuple[str, str, Observe, tuple[int, ...], _Arguments, str]


@dataclass(frozen=True, eq=False)
class Row:
    """One policy under one observation mode.

    Attributes:
        policy: as it was asked for.
        env: where it played.
        episodes: what was measured.
    """

    policy: str
    env: EnvDescription
    episodes: Episodes

    @property
    def observe(self) -> Observe:
        """The mode."""
        return self.env.observe

    @property
    def label(self) -> str:
        """E.g. "tanh on estimate"."""
        return f"{self.policy} on {self.observe}"

    def summary(self) -> dict[str, Any]:
        """The row in a few numbers; a settling time that isn't finite is None."""
        seen = self.episodes
        return {
            "policy": self.policy,
            "observe": self.observe,
            "mean_return": float(seen.returns.mean()),
            "ci95": interval95(seen.returns),
            "final_task_error": float(seen.final_task_error.mean()),
            "settling_time": finite(float(np.median(seen.settling_time))),
            "effort": float(seen.effort.mean()),
            "max_normalized_disagreement": float(seen.max_normalized_disagreement.max()),
            "max_error_to_bound": float(seen.max_error_to_bound.max()),
        }


@dataclass(frozen=True, eq=False)
class Comparison:
    """Rows over the same episodes.

    Attributes:
        environment: its name.
        scenario: its name.
        rows: in the order asked for.
    """

    environment: str
    scenario: str
    rows: list[Row] = field(default_factory=list)

    def summary(self) -> dict[str, Any]:
        """Everything that `khop evaluate --json` prints."""
        count = len(self.rows[0].episodes.returns) if self.rows else 0
        rows = [row.summary() for row in self.rows]
        return {"environment": self.environment, "scenario": self.scenario, "episodes": count, "rows": rows}

    def difference(self, row: Row) -> tuple[float, float | None]:
        """How much more a row returns than the first, paired by episode, and the half width of the 95 % interval."""
        more = row.episodes.returns - self.rows[0].episodes.returns
        return float(more.mean()), interval95(more)

    def frame(self) -> pl.DataFrame:
        """A tidy data frame, one row per policy, mode and episode."""
        import polars as pl

        return pl.concat(row.episodes.frame(row.policy, row.env) for row in self.rows)


def compare(
    environment: str,
    policies: Sequence[str],
    observe: Sequence[Observe] = ("estimate",),
    *,
    scenario: str | None = None,
    seeds: Sequence[int] = range(100),
    workers: int = 1,
    ray: bool = False,
    arguments: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> Comparison:
    """Play every policy under every observation mode over the same episodes.

    Args:
        environment: one of `khop_env.environments()`.
        policies: names that `make_policy` knows.
        observe: observation modes.
        scenario: name or path; the environment's default if left out.
        seeds: one per episode.
        workers: processes; the numbers don't depend on how many.
        ray: play on a Ray cluster instead (the one that is running, or a local one).
        arguments: others of the environment's, e.g. {"max_cycles": 100}. A learned policy that was trained with bounds
            in its observations gets them anyhow.
        progress: told how far it is.

    Raises:
        ValueError: for anything unknown, before a policy plays.
        ModuleNotFoundError: for `ray` without Ray.
    """
    if not len(seeds):
        raise ValueError("there is nothing to play without seeds; give one per episode, e.g. range(100)")
    name = task_class(environment).default_scenario if scenario is None else scenario
    if not policies or not observe or len(set(observe)) < len(observe):
        raise ValueError(f"name at least one policy and one observation mode, each once; got {list(observe)}")
    asked: dict[str, _Arguments] = {}
    pairs: list[tuple[str, EnvDescription]] = []
    for spec in policies:  # refuses what there isn't, or doesn't fit, before anything is played
        policy = make_policy(spec)
        with_bounds = {"bounds": True} if isinstance(policy, LearnedPolicy) and policy.about.get("bounds") else {}
        asked[spec] = tuple(sorted({**with_bounds, **(arguments or {})}.items()))
        for mode in observe:
            env = describe(_environment(environment, name, mode, asked[spec]))
            pairs.append((spec, env))
            try:
                policy.reset(env, [0])
            except ValueError as error:
                raise ValueError(f"policy {spec!r}: {error}") from error
    chunks = [tuple(int(seed) for seed in seeds[first : first + CHUNK]) for first in range(0, len(seeds), CHUNK)]
    tasks: list[_Task] = [
        (environment, name, mode, chunk, asked[spec], spec) for spec in policies for mode in observe for chunk in chunks
    ]
    results: list[Any] = [None] * len(tasks)
    for done, (number, result) in enumerate(_run(tasks, workers, ray), 1):
        results[number] = result
        if progress is not None:
            progress(done / len(tasks))
    parts = [results[first : first + len(chunks)] for first in range(0, len(tasks), len(chunks))]
    rows = [Row(spec, where, Episodes.joined(mine)) for (spec, where), mine in zip(pairs, parts, strict=True)]
    return Comparison(environment, env.scenario, rows)


def interval95(values: FloatArray) -> float | None:
    """Half width of the 95 % confidence interval of the mean (Student's t); None for a single value.

    The quantile is Cornish and Fisher's expansion (Abramowitz and Stegun, 26.7.5), within 1 % from 4 values on; exact
    for 2 and 3.
    """
    if len(values) < 2:
        return None
    z, n = statistics.NormalDist().inv_cdf(0.975), len(values) - 1
    if n < 3:
        t = (12.7062, 4.3027)[n - 1]
    else:
        t = z + (z**3 + z) / (4 * n) + (5 * z**5 + 16 * z**3 + 3 * z) / (96 * n**2)
        t += (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / (384 * n**3)
    return t * float(np.std(values, ddof=1)) / math.sqrt(len(values))


def _run(tasks: Sequence[_Task], workers: int, ray: bool) -> Iterator[tuple[int, Episodes]]:
    """Number and result of each task, as they come."""
    if ray:
        from agents.cluster import run_on_ray

        yield from run_on_ray(_play_task, tasks)
    elif workers <= 1:
        for number, task in enumerate(tasks):
            yield number, _play_task(task)
    else:
        spawned = multiprocessing.get_context("spawn")
        with concurrent.futures.ProcessPoolExecutor(min(workers, len(tasks)), mp_context=spawned) as pool:
            futures = {pool.submit(_play_task, task): number for number, task in enumerate(tasks)}
            try:
                for future in concurrent.futures.as_completed(futures):
                    yield futures[future], future.result()
            finally:
                pool.shutdown(wait=False, cancel_futures=True)


def _play_task(task: _Task) -> Episodes:
    environment, scenario, observe, seeds, arguments, spec = task
    env = _environment(environment, scenario, observe, arguments)
    return play(env, make_policy(spec), seeds, name=spec)


@lru_cache(maxsize=6)  # three modes, with and without bounds
def _environment(environment: str, scenario: str, observe: Observe, arguments: _Arguments) -> BatchedEnv:
    return make_batched(environment, scenario, num_envs=CHUNK, observe=observe, **dict(arguments))
