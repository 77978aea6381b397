"""Compare policies and observation modes over the same episodes, in one process, several, or on a Ray cluster."""

from __future__ import annotations

import contextlib
import itertools
import math
from collections.abc import Generator, Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from agents.evaluation import Episodes, chosen_scenario, play, require_seeds
from agents.learning.pretrained import resolved
from agents.outcomes import interval95, summary
from agents.policies import Needs, make_policy, needs
from agents.policy import EnvDescription, Policy, describe, in_words
from agents.workers import Interrupted, UnfinishedError, run_in_processes
from khop_env.brief import brief
from khop_env.env import BatchedEnv
from khop_env.observers import Networked
from khop_env.registry import Environment, find_task, make_batched
from khop_env.results.data_columns import DataColumn
from khop_env.results.dataset import EpisodeDataset
from khop_env.results.episodes import EpisodeRecorder, Part
from khop_env.results.metrics import finite
from khop_env.results.recording import Progress
from khop_env.scenarios import Scenario
from khop_env.simulation import Observe

if TYPE_CHECKING:
    import polars as pl

CHUNK = 25  # episodes per batch; fixed, so that results don't depend on the number of workers

_Task = tuple[str, Observe, Needs, str | None, tuple[int, ...]]  # policy, observation mode, its needs, network, seeds
_Played = tuple[Episodes, list[Part]]


@dataclass(frozen=True, eq=False)
class Row:
    """Results of one policy under one observation mode.

    Attributes:
        policy: the policy's name as requested.
        env: description of the environment it acted in.
        episodes: measurements of its episodes.
        network: in which it acted: its name as requested, otherwise in words; None for continuous exchange.
        compared: whether several networks are compared, so that labels name them.
    """

    policy: str
    env: EnvDescription
    episodes: Episodes
    network: str | None = None
    compared: bool = False

    __repr__ = brief

    @property
    def observe(self) -> Observe:
        """The observation mode."""
        return self.env.observe

    @property
    def label(self) -> str:
        """Policy, observation mode, and network if several are compared, e.g. "tanh on estimate over wifi"."""
        return f"{self.policy} on {self.observe}" + (f" over {self.network}" if self.compared else "")

    def summary(self) -> dict[str, Any]:
        """Means, medians and extremes over the episodes; a settling time that isn't finite is None."""
        episodes = self.episodes
        return {
            "policy": self.policy,
            "observe": self.observe,
            "mean_return": float(episodes.returns.mean()),
            "ci95": interval95(episodes.returns),
            "final_task_error": float(episodes.final_task_error.mean()),
            "settling_time": finite(float(np.median(episodes.settling_time))),
            "effort": float(episodes.effort.mean()),
            "max_normalized_disagreement": float(episodes.max_normalized_disagreement.max()),
            "max_error_to_bound": float(episodes.max_error_to_bound.max()),
            **summary(episodes.outcomes),
            **({"network": self.network} if self.network is not None or episodes.outcomes else {}),
        }


@dataclass(frozen=True, eq=False)
class Comparison:
    """Results of several policies and observation modes over the same episodes.

    Attributes:
        environment: name of the environment.
        scenario: name of the scenario.
        planned: number of episodes requested per row; after an interrupt rows may have fewer, or be missing. With
            several workers the missing episodes needn't be the last ones.
        network: over which agents know of each other, in words; None for continuous exchange.
        estimator: its name; None for continuous exchange.
        rows: in the requested order.
    """

    environment: str
    scenario: str
    planned: int
    network: str | None = None
    estimator: str | None = None
    rows: list[Row] = field(default_factory=list)

    __repr__ = brief

    def summary(self) -> dict[str, Any]:
        """The output of `khop evaluate --json`; a row with fewer episodes than planned has the key `episodes`."""
        summaries = [row.summary() for row in self.rows]
        for row, found in zip(self.rows, summaries, strict=True):
            if len(row.episodes.seed) < self.planned:
                found["episodes"] = len(row.episodes.seed)
            if self.network is not None and not found["max_normalized_disagreement"]:
                found["max_normalized_disagreement"] = None  # an estimator without funnels
        where: dict[str, Any] = {"environment": self.environment, "scenario": self.scenario, "episodes": self.planned}
        where |= {"network": self.network, "estimator": self.estimator}
        unit = self.rows[0].env.error_unit if self.rows else None
        return {**where, "task_error_unit": unit, "rows": summaries}

    def difference(self, row: Row) -> tuple[float, float | None]:
        """Mean difference in return from the first row, paired by seed, and half width of its 95 % interval.

        After an interrupt only episodes that both rows have count; the difference is nan if there are none.
        """
        first = dict(zip(self.rows[0].episodes.seed.tolist(), self.rows[0].episodes.returns, strict=True))
        played = zip(row.episodes.seed.tolist(), row.episodes.returns, strict=True)
        differences = np.array([value - first[seed] for seed, value in played if seed in first])
        return (float(differences.mean()), interval95(differences)) if len(differences) else (math.nan, None)

    def frame(self) -> pl.DataFrame:
        """A tidy data frame with one row per policy, observation mode, network and episode."""
        import polars as pl

        frames = [row.episodes.frame(row.policy, row.env) for row in self.rows]
        if any(row.compared for row in self.rows):
            networks = [pl.lit(row.network).alias("network") for row in self.rows]
            frames = [frame.with_columns(network) for frame, network in zip(frames, networks, strict=True)]
        return pl.concat(frames, how="diagonal")  # networks with ranges have columns of their own


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
    networks: Sequence[str] | None = None,
    record: str | Path | EpisodeDataset | None = None,
    progress: Progress | None = None,
) -> Comparison:
    """Run every policy under every observation mode over the same episodes.

    Args:
        environment: one of `khop_env.environments()`, or a task of your own.
        policies: names understood by `make_policy`.
        observe: observation modes.
        scenario: a scenario, its name or path; by default the environment's own. A file is read once.
        seeds: one seed per episode.
        workers: number of processes; results don't depend on it.
        ray: run on a Ray cluster instead (an existing one, or a local one).
        arguments: further arguments of the environment, e.g. {"max_cycles": 100}. A learned policy that was trained
            with bounds in its observations, or is in a certified filter, always gets them.
        networks: names of networks, e.g. ["ideal", "lossy:loss=0.3"], in each of which everything is played; None for
            the one of `arguments` or the scenario.
        record: a new folder, into which every step and every estimate is written, the same files for any number of
            workers (docs/guides/datasets.md).
        progress: called with the completed fraction.

    Raises:
        ValueError: if an argument is unknown or invalid, or `record` is a folder with something in it, before the first
            episode.
        ModuleNotFoundError: if `ray` is set and Ray isn't installed.
        UnfinishedError: if a policy or a worker fails; its `partial` holds the results until then.
        Interrupted: on Ctrl-C, with the same `partial`; the workers have ended.
    """
    require_seeds(seeds)
    for name, names in (("policies", policies), ("observe", observe)):
        if isinstance(names, str):
            raise ValueError(f"{name} must be a list of names, e.g. [{names!r}]; got {names!r}")
        for each in names:
            if not isinstance(each, str):
                raise ValueError(
                    f"{name} must be names, which each process can look up; got {each!r}. For objects: "
                    "evaluate(env, {'mine': policy}, seeds), or a file's, 'my_file.py:MyPolicy'"
                )
    if not policies or not observe or len(set(observe)) < len(observe):
        raise ValueError(
            f"expected at least one policy and one observation mode, no mode twice; got policies={list(policies)} and "
            f"observe={list(observe)}"
        )
    if networks is not None and (not networks or "network" in (arguments or {})):
        raise ValueError(f"networks must be names, and arguments without a network then; got networks={networks!r}")
    dataset = EpisodeDataset(record) if isinstance(record, str | Path) else record
    player = _Player(environment, chosen_scenario(environment, scenario), arguments or {})
    rows: list[tuple[str, EnvDescription, Needs, str | None]] = []
    # check that each policy fits before the first episode
    for spec, network in itertools.product(policies, networks or (None,)):
        policy, needed = player.policy(spec, network)
        for mode in observe:
            env = describe(player.environment(mode, needed, network))
            rows.append((spec, env, needed, network))
            try:
                policy.reset(env, [0])
            except Exception as error:
                raise ValueError(in_words(error, spec)) from error
    observers = player.environment(observe[0], *rows[0][2:]).simulator.observers
    over: tuple[str, str] | tuple[()] = ()
    if isinstance(observers, Networked):
        several = ", ".join(networks) if networks is not None and len(networks) > 1 else ""
        over = (several or observers.network.described(), observers.estimator.name)
    chunks = [tuple(int(seed) for seed in seeds[first : first + CHUNK]) for first in range(0, len(seeds), CHUNK)]
    tasks: list[_Task] = [
        (spec, env.observe, needed, network, chunk) for spec, env, needed, network in rows for chunk in chunks
    ]
    results: list[Episodes | None] = [None] * len(tasks)

    def comparison() -> Comparison:
        result = Comparison(rows[0][1].environment, rows[0][1].scenario, len(seeds), *over)
        for number, (spec, env, needed, network) in enumerate(rows):
            played = results[number * len(chunks) : (number + 1) * len(chunks)]
            parts = [part for part in played if part is not None]  # workers may finish a later chunk first
            if parts:
                over_network = network or player.network(env.observe, needed)
                result.rows.append(Row(spec, env, Episodes.joined(parts), over_network, networks is not None))
        return result

    if dataset is not None:
        named = environment if isinstance(environment, str) else rows[0][1].environment
        every = [
            (spec, network or player.network(env.observe, needed), player.environment(env.observe, needed, network))
            for spec, env, needed, network in rows
        ]
        dataset.begin(named, every, seeds)
        player.columns = dataset.columns
    try:
        with contextlib.closing(_run(player, tasks, workers, ray)) as played:
            for done, (number, (result, parts)) in enumerate(played, 1):
                if dataset is not None:
                    dataset.write(number, parts)
                results[number] = result
                if progress is not None:
                    progress(done / len(tasks))
        if dataset is not None:
            dataset.finish()
    except KeyboardInterrupt:
        raise Interrupted(comparison()) from None
    except ModuleNotFoundError:
        raise
    except Exception as error:
        raise UnfinishedError(in_words(error, *getattr(error, "__notes__", [])[:1]), comparison()) from error
    return comparison()


class _Player:
    """Runs tasks; builds one environment per observation mode and arguments, never shared with another object."""

    def __init__(self, environment: Environment, scenario: Scenario, arguments: Mapping[str, Any]) -> None:
        self._environment, self._scenario, self._arguments = environment, scenario, dict(arguments)
        self._made: dict[tuple[Observe, Needs, str | None], BatchedEnv] = {}
        self.columns: Mapping[str, DataColumn] | None = None  # of recorded steps; None: nothing is recorded

    def policy(self, spec: str, network: str | None) -> tuple[Policy, Needs]:
        """A policy by name, and what it needs of the environment.

        Raises:
            ValueError: if there is no such policy, or none is shipped for the environment.
        """
        task = find_task(self._environment)
        arguments = self._arguments if network is None else {**self._arguments, "network": network}
        policy = resolved(make_policy(spec), f"{task.name}_v{task.version}", self._scenario, arguments)
        return policy, needs(policy)

    def environment(self, observe: Observe, needed: Needs, network: str | None) -> BatchedEnv:
        """The environment, with num_envs = CHUNK, and what a policy needs unless the arguments say otherwise."""
        if (observe, needed, network) not in self._made:
            arguments = self._arguments if network is None else {**self._arguments, "network": network}
            arguments = needed.among(arguments, self._scenario)
            env = make_batched(self._environment, self._scenario, num_envs=CHUNK, observe=observe, **arguments)
            self._made[observe, needed, network] = env
        return self._made[observe, needed, network]

    def network(self, observe: Observe, needed: Needs) -> str | None:
        """The network's name where the arguments have one, otherwise in words; None for continuous exchange."""
        observers = self.environment(observe, needed, None).simulator.observers
        if not isinstance(observers, Networked):
            return None
        name = self._arguments.get("network")
        return name if isinstance(name, str) else observers.network.described()

    def __call__(self, task: _Task) -> _Played:
        spec, observe, needed, network, seeds = task
        env, (policy, _) = self.environment(observe, needed, network), self.policy(spec, network)
        parts: list[Part] = []
        try:
            if self.columns is None:
                return play(env, policy, seeds, name=spec), []
            recorder = EpisodeRecorder(env, spec, network or self.network(observe, needed), self.columns)
            return play(env, policy, seeds, name=spec, recorder=recorder, recorded=parts.extend), parts
        except Exception as error:
            error.add_note(spec)  # a worker's exception comes with it
            raise

    def __getstate__(self) -> dict[str, Any]:
        return {**vars(self), "_made": {}}


def _run(
    player: _Player, tasks: Sequence[_Task], workers: int, ray: bool
) -> Generator[tuple[int, _Played], None, None]:
    """Yield the index and result of each task in order of completion."""
    if ray:
        from agents.cluster import run_on_ray

        yield from run_on_ray(player, tasks)
    elif workers > 1:
        yield from run_in_processes(player, tasks, workers)
    else:
        yield from enumerate(map(player, tasks))
