"""A table of policies and observation modes over the same episodes, on one core, several, or a Ray cluster."""

from __future__ import annotations

import contextlib
import itertools
import math
import statistics
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from agents.evaluation import Episodes, chosen_scenario, play
from agents.learning.learned import LearnedPolicy
from agents.policies import make_policy
from agents.policy import EnvDescription, describe
from agents.workers import Interrupted, UnfinishedError, run_in_processes
from khop_env.env import BatchedEnv
from khop_env.observers import FloatArray
from khop_env.registry import Environment, make_batched
from khop_env.results.metrics import finite
from khop_env.results.recording import Progress
from khop_env.scenarios import Scenario
from khop_env.simulation import Observe

if TYPE_CHECKING:
    import polars as pl

CHUNK = 25  # episodes played at once; fixed, so that no number depends on who plays how many

_Task = tuple[str, Observe, bool, tuple[int, ...]]  # policy, observation mode, with bounds, seeds


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
        planned: episodes of each row; rows that were interrupted have fewer, or are missing.
        rows: in the order asked for.
    """

    environment: str
    scenario: str
    planned: int
    rows: list[Row] = field(default_factory=list)

    def summary(self) -> dict[str, Any]:
        """Everything that `khop evaluate --json` prints; rows with fewer episodes than planned say how many."""
        rows = [row.summary() for row in self.rows]
        for row, seen in zip(self.rows, rows, strict=True):
            if len(row.episodes.seed) < self.planned:
                seen["episodes"] = len(row.episodes.seed)
        where = {"environment": self.environment, "scenario": self.scenario, "episodes": self.planned}
        unit = self.rows[0].env.error_unit if self.rows else None
        return {**where, "task_error_unit": unit, "rows": rows}

    def difference(self, row: Row) -> tuple[float, float | None]:
        """How much more a row returns than the first, paired by episode, and the half width of the 95 % interval."""
        first = self.rows[0].episodes.returns
        both = min(len(row.episodes.returns), len(first))
        more = row.episodes.returns[:both] - first[:both]
        return float(more.mean()), interval95(more)

    def frame(self) -> pl.DataFrame:
        """A tidy data frame, one row per policy, mode and episode."""
        import polars as pl

        return pl.concat(row.episodes.frame(row.policy, row.env) for row in self.rows)


def compare(
    environment: Environment,
    policies: Sequence[str],
    observe: Sequence[Observe] = ("estimate",),
    *,
    scenario: Scenario | str | Path | None = None,
    seeds: Sequence[int] = range(100),
    workers: int = 1,
    ray: bool = False,
    arguments: Mapping[str, Any] | None = None,
    progress: Progress | None = None,
) -> Comparison:
    """Play every policy under every observation mode over the same episodes.

    Args:
        environment: one of `khop_env.environments()`, or a task of your own.
        policies: names that `make_policy` knows.
        observe: observation modes.
        scenario: a scenario, its name or path; the environment's default if left out. A file is read once.
        seeds: one per episode.
        workers: processes; the numbers don't depend on how many.
        ray: play on a Ray cluster instead (the one that is running, or a local one).
        arguments: others of the environment's, e.g. {"max_cycles": 100}. A learned policy that was trained with bounds
            in its observations gets them anyhow.
        progress: told how far it is.

    Raises:
        ValueError: for anything unknown, before a policy plays.
        ModuleNotFoundError: for `ray` without Ray.
        UnfinishedError: if a policy or a worker fails while it plays; it holds what was played until then.
        Interrupted: a KeyboardInterrupt that holds the same; workers have ended.
    """
    if not len(seeds):
        raise ValueError("there is nothing to play without seeds; give one per episode, e.g. range(100)")
    for name, several in (("policies", policies), ("observe", observe)):
        if isinstance(several, str):
            raise ValueError(f"{name} is a list of names, e.g. [{several!r}]; got {several!r}")
    if not policies or not observe or len(set(observe)) < len(observe):
        raise ValueError(f"name at least one policy and one observation mode, each once; got {list(observe)}")
    player = _Player(environment, chosen_scenario(environment, scenario), arguments or {})
    rows: list[tuple[str, EnvDescription, bool]] = []
    for spec in policies:  # refuses what doesn't fit before anything is played
        policy = make_policy(spec)
        bounds = isinstance(policy, LearnedPolicy) and bool(policy.about.get("bounds"))
        for mode in observe:
            env = describe(player.environment(mode, bounds))
            rows.append((spec, env, bounds))
            try:
                policy.reset(env, [0])
            except ValueError as error:
                raise ValueError(f"policy {spec!r}: {error}") from error
    chunks = [tuple(int(seed) for seed in seeds[first : first + CHUNK]) for first in range(0, len(seeds), CHUNK)]
    tasks: list[_Task] = [(spec, env.observe, bounds, chunk) for spec, env, bounds in rows for chunk in chunks]
    results: list[Episodes | None] = [None] * len(tasks)

    def comparison() -> Comparison:
        found = Comparison(rows[0][1].environment, rows[0][1].scenario, len(seeds))
        for number, (spec, env, _) in enumerate(rows):
            parts = list(itertools.takewhile(bool, results[number * len(chunks) : (number + 1) * len(chunks)]))
            if parts:
                found.rows.append(Row(spec, env, Episodes.joined(parts)))  # type: ignore[arg-type]
        return found

    try:
        with contextlib.closing(_run(player, tasks, workers, ray)) as played:
            for done, (number, result) in enumerate(played, 1):
                results[number] = result
                if progress is not None:
                    progress(done / len(tasks))
    except KeyboardInterrupt:
        raise Interrupted(comparison()) from None
    except ModuleNotFoundError:
        raise
    except Exception as error:
        raise UnfinishedError(str(error), comparison()) from error
    return comparison()


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


class _Player:
    """Plays tasks, in environments that are made once for each kind of observation, and belong to this object alone."""

    def __init__(self, environment: Environment, scenario: Scenario, arguments: Mapping[str, Any]) -> None:
        self._environment, self._scenario, self._arguments = environment, scenario, dict(arguments)
        self._made: dict[tuple[Observe, bool], BatchedEnv] = {}

    def environment(self, observe: Observe, bounds: bool) -> BatchedEnv:
        """The environment, of CHUNK copies; with bounds in its observations where the arguments don't say otherwise."""
        if (observe, bounds) not in self._made:
            arguments = {"bounds": True, **self._arguments} if bounds else self._arguments
            env = make_batched(self._environment, self._scenario, num_envs=CHUNK, observe=observe, **arguments)
            self._made[observe, bounds] = env
        return self._made[observe, bounds]

    def __call__(self, task: _Task) -> Episodes:
        spec, observe, bounds, seeds = task
        return play(self.environment(observe, bounds), make_policy(spec), seeds, name=spec)

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_made": {}}


def _run(
    player: _Player, tasks: Sequence[_Task], workers: int, ray: bool
) -> Generator[tuple[int, Episodes], None, None]:
    """Number and result of each task, as they come."""
    if ray:
        from agents.cluster import run_on_ray

        yield from run_on_ray(player, tasks)
    elif workers > 1:
        yield from run_in_processes(player, tasks, workers)
    else:
        yield from enumerate(map(player, tasks))
