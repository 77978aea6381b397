"""Evaluate policies over seeded episodes."""

from __future__ import annotations

import itertools
import reprlib
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from agents.outcomes import Outcomes
from agents.policies import make_policy
from agents.policy import EnvDescription, Policy, batched_of, by_agent, describe, policy_seeds, require_policy
from khop_env.brief import brief
from khop_env.env import BatchedEnv
from khop_env.observers import FloatArray, Networked
from khop_env.registry import Environment, find_task
from khop_env.registry import scenario as load_scenario
from khop_env.results.dataset import EpisodeDataset
from khop_env.results.episodes import EpisodeRecorder, Part
from khop_env.results.recording import Progress
from khop_env.scenarios import Scenario

if TYPE_CHECKING:
    import polars as pl

SETTLED = 0.1  # of the initial task error


@dataclass(frozen=True, eq=False)
class Episodes:
    """Measurements of E episodes.

    Attributes:
        seed: (E,) seed of each episode.
        returns: (E,) mean over the agents of the sum of their rewards.
        final_task_error: (E,) mean over the agents of their task error at the end, in the task's unit.
        settling_time: (E,) time from which the team's mean task error stays at or below a tenth of the initial one, in
            s; infinite if it doesn't.
        effort: (E,) mean over agents and time of |u|^2, u in fractions of the input limits.
        max_normalized_disagreement: (E,) largest |xi| / rho of all observers.
        late_normalized_disagreement: (E,) the same without the first quarter of the episode, the transient.
        max_error_to_bound: (E,) largest |estimation error| / bound.
        task_error: (T + 1, E) mean over the agents, at every control period; constant after an early end.
        time: (T + 1,) in s.
        outcomes: (E,) each, where agents may collide: "collision" and "success" (all at their goals, and no collision),
            0 or 1; "arrival_time", mean over the agents in s, nan if not all are at their goals at the end;
            "min_distance" of two agents in m; "deadlock", 1 if not all are at their goals at the end and nobody has
            moved by 0.1 m in the last 2 s; "intervention", mean over agents and time of a filter's changes of
            their inputs in m/s, and "infeasible", share of agents and time in which its guarantee had to be begun anew,
            nan without a filter. Nothing in other environments.
        drawn: (E,) each, what the episodes drew from the ranges of their network, by name: "loss", "burst", ...
    """

    seed: np.ndarray
    returns: FloatArray
    final_task_error: FloatArray
    settling_time: FloatArray
    effort: FloatArray
    max_normalized_disagreement: FloatArray
    late_normalized_disagreement: FloatArray
    max_error_to_bound: FloatArray
    task_error: FloatArray
    time: FloatArray
    outcomes: Mapping[str, FloatArray] = field(default_factory=dict)
    drawn: Mapping[str, FloatArray] = field(default_factory=dict)

    __repr__ = brief

    @staticmethod
    def joined(parts: Sequence[Episodes]) -> Episodes:
        """Concatenate along the episode axis."""
        values = {
            each.name: np.concatenate([getattr(part, each.name) for part in parts], axis=-1)
            for each in fields(Episodes)
            if each.name not in ("time", "outcomes", "drawn")
        }
        outcomes = {name: np.concatenate([part.outcomes[name] for part in parts]) for name in parts[0].outcomes}
        drawn = {name: np.concatenate([part.drawn[name] for part in parts]) for name in parts[0].drawn}
        return Episodes(**values, time=parts[0].time, outcomes=outcomes, drawn=drawn)

    def frame(self, policy: str, env: EnvDescription) -> pl.DataFrame:
        """A tidy data frame with one row per episode: environment, scenario, mode, policy and measurements.

        Args:
            policy: name of the policy.
            env: description of the environment.
        """
        import polars as pl

        where = {"environment": env.environment, "scenario": env.scenario, "observe": env.observe, "policy": policy}
        excluded = ("task_error", "time", "returns", "seed", "outcomes", "drawn")
        rest = [each.name for each in fields(self) if each.name not in excluded]
        numbers = {"seed": self.seed, "return": self.returns, **{name: getattr(self, name) for name in rest}}
        drawn = {f"drawn_{name}": values for name, values in self.drawn.items()}
        return pl.DataFrame({**where, **numbers, **self.outcomes, **drawn})


def chosen_scenario(environment: Environment, scenario: Scenario | str | Path | None) -> Scenario:
    """The scenario itself, loaded if it is a name or path; the environment's default if it is None.

    Raises:
        ValueError: if the environment or scenario is unknown; the message suggests the closest match.
    """
    chosen = find_task(environment).default_scenario if scenario is None else scenario
    return chosen if isinstance(chosen, Scenario) else load_scenario(chosen)


def evaluate(
    env: object,
    policies: Mapping[str, Policy] | Sequence[str],
    seeds: Sequence[int],
    *,
    record: str | Path | EpisodeDataset | None = None,
    progress: Progress | None = None,
) -> pl.DataFrame:
    """Run every policy over the same episodes.

    Args:
        env: any environment of khop_env, wrapped or not; with num_envs = B, B episodes run at once. Wrappers are
            bypassed: policies get the environment's own observations. It is reset, and left at the end of an episode.
        policies: policies by name, or a list of names understood by `make_policy`.
        seeds: one seed per episode; episodes of different policies with the same seed have the same initial states,
            disturbances and leaders, so that differences can be paired.
        record: a new folder, into which every step and every estimate is written (docs/guides/datasets.md).
        progress: called with the completed fraction.

    Returns:
        A tidy data frame with one row per policy and episode: environment, scenario, observe, policy, seed, return, and
        the columns of `Episodes`; those of `drawn` with this word and an underscore before them.

    Raises:
        TypeError: if `env` is no environment of khop_env, or a policy lacks `reset` or `act`.
        ValueError: if a policy is unknown, `seeds` is empty, the environment rejects an action, or `record` is a folder
            with something in it.
    """
    import polars as pl

    batched = batched_of(env)
    if isinstance(policies, str) or not isinstance(policies, Mapping | Sequence):
        raise TypeError(
            f"policies must be a list of names or a mapping, e.g. {{'my_policy': policy}}; got {policies!r}"
        )
    chosen = policies if isinstance(policies, Mapping) else {spec: make_policy(spec) for spec in policies}
    description = describe(batched)
    dataset = EpisodeDataset(record) if isinstance(record, str | Path) else record
    if dataset is not None:
        dataset.begin(description.environment, [(name, None, batched) for name in chosen], seeds)
    frames, batches = [], itertools.count()
    for number, (name, policy) in enumerate(chosen.items()):
        partial = None if progress is None else lambda part, n=number: progress((n + part) / len(chosen))
        recorder = None if dataset is None else EpisodeRecorder(batched, name, columns=dataset.columns)
        written = None if dataset is None else lambda parts: dataset.write(next(batches), parts)
        episodes = play(batched, policy, seeds, name=name, progress=partial, recorder=recorder, recorded=written)
        frames.append(episodes.frame(name, description))
    if dataset is not None:
        dataset.finish()
    return pl.concat(frames)


def play(
    env: object,
    policy: Policy,
    seeds: Sequence[int],
    *,
    name: str = "policy",
    progress: Progress | None = None,
    recorder: EpisodeRecorder | None = None,
    recorded: Callable[[list[Part]], None] | None = None,
) -> Episodes:
    """Run one policy, num_envs episodes at a time.

    Args:
        env: as for `evaluate`.
        policy: the policy.
        seeds: one seed per episode.
        name: the policy's name in error messages.
        progress: called with the completed fraction.
        recorder: of this environment.
        recorded: called with the recorder's tables after every num_envs episodes.

    Raises:
        TypeError: if `env` is no environment of khop_env, or the policy lacks `reset` or `act`.
        ValueError: if `seeds` is empty, or the policy doesn't fit the environment.
    """
    batched = batched_of(env)
    require_policy(policy, name)
    require_seeds(seeds)
    parts = []
    for first in range(0, len(seeds), batched.num_envs):
        chunk = [int(seed) for seed in seeds[first : first + batched.num_envs]]
        filled = chunk + [chunk[-1]] * (batched.num_envs - len(chunk))
        try:
            parts.append(_play(batched, policy, filled, len(chunk), recorder))
        except ValueError as error:
            raise ValueError(f"policy {name!r} in {batched.task.environment}: {error}") from error
        if recorder is not None and recorded is not None:
            recorded(recorder.end())
        if progress is not None:
            progress(min(1.0, (first + batched.num_envs) / len(seeds)))
    return Episodes.joined(parts)


def _play(env: BatchedEnv, policy: Policy, seeds: list[int], count: int, recorder: EpisodeRecorder | None) -> Episodes:
    """Run one batch of episodes and keep the first `count`."""
    horizon, period = env.settings.horizon, env.settings.control_period
    error, returns, effort = np.zeros((horizon + 1, env.num_envs)), np.zeros(env.num_envs), np.zeros(env.num_envs)
    worst, late, bound = (np.zeros(env.num_envs) for _ in range(3))
    inputs = np.array([env.fleet.models[env.fleet.agent(agent)].m for agent in env.agents])
    policy.reset(describe(env), policy_seeds(seeds))
    observations, infos = env.reset(seeds)
    if recorder is not None:
        recorder.begin(seeds[:count], observations)
    error[0] = infos["task_error"].mean(axis=1)
    outcomes, drawn = Outcomes(env, infos), _drawn(env)
    running, length = np.ones(env.num_envs, bool), np.full(env.num_envs, horizon)
    for cycle in range(1, horizon + 1):
        actions = _by_agent(env, policy.act(by_agent(env, observations)))
        flat = np.concatenate(list(actions.values()), axis=1)
        observations, reward, terminated, truncated, infos = step = env.step(flat)
        if recorder is not None:
            recorder.add(flat, step)
        returns += np.where(running, reward.mean(axis=1), 0.0)
        squared = [
            np.square(np.clip(actions[agent][:, :m], -1.0, 1.0, dtype=np.float64)).sum(axis=1)
            for agent, m in zip(env.agents, inputs, strict=True)
        ]
        effort += np.where(running, np.mean(squared, axis=0), 0.0)
        ratio = np.where(running, infos["max_normalized_disagreement"].max(axis=1), 0.0)
        worst = np.maximum(worst, ratio)
        if cycle > horizon // 4:
            late = np.maximum(late, ratio)
        bound = np.maximum(bound, np.where(running, infos["max_error_to_bound"].max(axis=1), 0.0))
        error[cycle] = np.where(running, infos["task_error"].mean(axis=1), error[cycle - 1])
        over = terminated | truncated
        outcomes.add(cycle, running, over, infos, policy)
        length[running & over] = cycle
        running &= ~over
        if not running.any():
            error[cycle + 1 :] = error[cycle]
            break
        if over.any():  # environments that are over must be reset; they aren't counted any more
            observations, _ = env.reset(env_ids=np.flatnonzero(over))
    settled = error <= SETTLED * error[0]
    unsettled = np.where(settled.all(axis=0), 0, horizon + 1 - np.argmin(settled[::-1], axis=0))
    settling = np.where(unsettled > horizon, np.inf, unsettled * period)
    whole = {
        "seed": np.array(seeds),
        "returns": returns,
        "final_task_error": error[-1],
        "settling_time": settling,
        "effort": effort / length,
        "max_normalized_disagreement": worst,
        "late_normalized_disagreement": late,
        "max_error_to_bound": bound,
        "task_error": error,
    }
    return Episodes(
        **{key: values[..., :count] for key, values in whole.items()},
        time=period * np.arange(horizon + 1.0),
        outcomes={key: values[:count] for key, values in outcomes.result().items()},
        drawn={key: values[:count] for key, values in drawn.items()},
    )


def _drawn(env: BatchedEnv) -> dict[str, FloatArray]:
    """What the present episodes drew from the ranges of their network, (B,) each, by name."""
    observers = env.simulator.observers
    if not isinstance(observers, Networked):
        return {}
    networks = observers.drawn(env.simulator.state)
    return {name: np.array([getattr(each, name) for each in networks]) for name in observers.network.ranges}


def require_seeds(seeds: Sequence[int]) -> None:
    """Refuse seeds that aren't one per episode.

    Raises:
        ValueError: if there are none, or it isn't a sequence.
    """
    if not hasattr(seeds, "__len__"):
        raise ValueError(f"seeds must be one per episode, e.g. range(100); got {seeds!r}")
    if not len(seeds):
        raise ValueError("no seeds given; expected one per episode, e.g. range(100)")


def _by_agent(env: BatchedEnv, actions: object) -> dict[str, np.ndarray]:
    """A policy's actions by agent, as arrays (B, m_i).

    Raises:
        ValueError: if an agent's action is missing, has the wrong shape, or isn't numeric.
    """
    sizes = (env.action_offset[1:] - env.action_offset[:-1]).tolist()
    if not isinstance(actions, Mapping):
        got = f"an array of shape {actions.shape}" if isinstance(actions, np.ndarray) else type(actions).__name__
        raise ValueError(
            f"act(observations) must return actions by agent, {{{env.agents[0]!r}: array of shape "
            f"{(env.num_envs, sizes[0])}, ...}}; got {got}"
        )
    arrays = {}
    for agent, size in zip(env.agents, sizes, strict=True):
        if agent not in actions:
            raise ValueError(f"no action for {agent!r}; got actions for {', '.join(list(actions)[:8]) or 'no agent'}")
        try:
            arrays[agent] = np.asarray(actions[agent])
        except ValueError:  # lists of different lengths
            arrays[agent] = np.asarray(None)
        if arrays[agent].dtype.kind not in "fiu":
            raise ValueError(f"actions of {agent!r} aren't numbers: {reprlib.repr(actions[agent])}")
        if arrays[agent].shape != (env.num_envs, size):
            raise ValueError(
                f"actions of {agent!r} must have shape {(env.num_envs, size)}, one row per environment; "
                f"got {arrays[agent].shape}"
            )
    return arrays
