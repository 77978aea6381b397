"""Playing policies over seeded episodes, and what is measured of each episode."""

from __future__ import annotations

import reprlib
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, fields
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from agents.policies import make_policy
from agents.policy import EnvDescription, Policy, batched_of, by_agent, describe, policy_seeds
from khop_env.env import BatchedEnv
from khop_env.observers import FloatArray
from khop_env.registry import Environment, find_task
from khop_env.registry import scenario as load_scenario
from khop_env.results.recording import Progress
from khop_env.scenarios import Scenario

if TYPE_CHECKING:
    import polars as pl

SETTLED = 0.1  # of the initial task error


@dataclass(frozen=True, eq=False)
class Episodes:
    """What was measured of E episodes.

    Attributes:
        seed: (E,) each episode's seed.
        returns: (E,) mean over the agents of the sum of their rewards.
        final_task_error: (E,) mean over the agents of their task error at the end, in the task's unit.
        settling_time: (E,) time from which the team's mean task error stays at or below a tenth of the initial one, in
            s; infinite if it doesn't.
        effort: (E,) mean over agents and time of |u|^2, u in fractions of the input limits.
        max_normalized_disagreement: (E,) largest |xi| / rho of all observers.
        late_normalized_disagreement: (E,) the same after the first quarter of the episode: without the transient.
        max_error_to_bound: (E,) largest |error| / bound.
        task_error: (T + 1, E) mean over the agents, at every control period; constant after an early end.
        time: (T + 1,) in s.
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

    @staticmethod
    def joined(parts: Sequence[Episodes]) -> Episodes:
        """Several after each other."""
        values = {
            one.name: np.concatenate([getattr(part, one.name) for part in parts], axis=-1)
            for one in fields(Episodes)
            if one.name != "time"
        }
        return Episodes(**values, time=parts[0].time)

    def frame(self, policy: str, env: EnvDescription) -> pl.DataFrame:
        """A tidy data frame with a row per episode: where it was played, by whom, and one column per number.

        Args:
            policy: its name.
            env: where it played.
        """
        import polars as pl

        where = {"environment": env.environment, "scenario": env.scenario, "observe": env.observe, "policy": policy}
        rest = [one.name for one in fields(self) if one.name not in ("task_error", "time", "returns", "seed")]
        numbers = {"seed": self.seed, "return": self.returns, **{name: getattr(self, name) for name in rest}}
        return pl.DataFrame({**where, **numbers})


def chosen_scenario(environment: Environment, scenario: Scenario | str | Path | None) -> Scenario:
    """A scenario that may be given by name or path, or left out for the environment's own.

    Raises:
        ValueError: for an unknown environment or scenario, naming the nearest.
    """
    chosen = find_task(environment).default_scenario if scenario is None else scenario
    return chosen if isinstance(chosen, Scenario) else load_scenario(chosen)


def evaluate(
    env: object,
    policies: Mapping[str, Policy] | Sequence[str],
    seeds: Sequence[int],
    *,
    progress: Progress | None = None,
) -> pl.DataFrame:
    """Play every policy over the same episodes.

    Args:
        env: an environment of khop_env of any kind, wrapped or not; a batch of B plays B episodes at once. Wrappers
            have no part: policies get the environment's own observations. It is reset, and left at an end.
        policies: by name, or a list of names that `make_policy` knows.
        seeds: one per episode; episodes of different policies with the same seed have the same initial states,
            disturbances and leaders, so that differences can be paired.
        progress: told how far it is.

    Returns:
        A tidy data frame with one row per policy and episode: environment, scenario, observe, policy, seed, return, and
        the columns of `Episodes`.

    Raises:
        TypeError: for an environment or a policy that isn't one.
        ValueError: for an unknown policy, no seed, or actions that the environment refuses.
    """
    import polars as pl

    batched = batched_of(env)
    if isinstance(policies, str) or not isinstance(policies, Mapping | Sequence):
        raise TypeError(f"policies are a list of names or a mapping, e.g. {{'mine': policy}}; got {policies!r}")
    chosen = policies if isinstance(policies, Mapping) else {spec: make_policy(spec) for spec in policies}
    description = describe(batched)
    frames = []
    for number, (name, policy) in enumerate(chosen.items()):
        told = None if progress is None else lambda part, n=number: progress((n + part) / len(chosen))
        episodes = play(batched, policy, seeds, name=name, progress=told)
        frames.append(episodes.frame(name, description))
    return pl.concat(frames)


def play(
    env: object, policy: Policy, seeds: Sequence[int], *, name: str = "policy", progress: Progress | None = None
) -> Episodes:
    """Play one policy, as many episodes at once as the environment has copies.

    Args:
        env: as for `evaluate`.
        policy: who plays.
        seeds: one per episode.
        name: of the policy, for errors.
        progress: told how far it is.

    Raises:
        TypeError: for an environment or a policy that isn't one.
        ValueError: for no seed, or where policy and environment don't fit.
    """
    batched = batched_of(env)
    _require_policy(policy, name)
    if not len(seeds):
        raise ValueError("there is nothing to play without seeds; give one per episode, e.g. range(100)")
    parts = []
    for first in range(0, len(seeds), batched.num_envs):
        mine = [int(seed) for seed in seeds[first : first + batched.num_envs]]
        filled = mine + [mine[-1]] * (batched.num_envs - len(mine))
        try:
            parts.append(_play(batched, policy, filled, len(mine)))
        except ValueError as error:
            raise ValueError(f"policy {name!r} in {batched.task.environment}: {error}") from error
        if progress is not None:
            progress(min(1.0, (first + batched.num_envs) / len(seeds)))
    return Episodes.joined(parts)


def _play(env: BatchedEnv, policy: Policy, seeds: list[int], count: int) -> Episodes:
    """One batch of episodes, of which the first `count` are kept."""
    horizon, period = env.settings.max_cycles, env.settings.control_period
    error, returns, effort = np.zeros((horizon + 1, env.num_envs)), np.zeros(env.num_envs), np.zeros(env.num_envs)
    worst, late, bound = (np.zeros(env.num_envs) for _ in range(3))
    inputs = np.array([env.fleet.models[env.fleet.agent(agent)].m for agent in env.agents])
    policy.reset(describe(env), policy_seeds(seeds))
    observations, infos = env.reset(seeds)
    error[0] = infos["task_error"].mean(axis=1)
    running, length = np.ones(env.num_envs, bool), np.full(env.num_envs, horizon)
    for cycle in range(1, horizon + 1):
        actions = _by_agent(env, policy.act(by_agent(env, observations)))
        observations, reward, terminated, truncated, infos = env.step(np.concatenate(list(actions.values()), axis=1))
        returns += np.where(running, reward.mean(axis=1), 0.0)
        squared = [
            np.square(np.clip(actions[agent][:, :m], -1.0, 1.0, dtype=np.float64)).sum(axis=1)
            for agent, m in zip(env.agents, inputs, strict=True)
        ]
        effort += np.where(running, np.mean(squared, axis=0), 0.0)
        seen = np.where(running, infos["max_normalized_disagreement"].max(axis=1), 0.0)
        worst = np.maximum(worst, seen)
        if cycle > horizon // 4:
            late = np.maximum(late, seen)
        bound = np.maximum(bound, np.where(running, infos["max_error_to_bound"].max(axis=1), 0.0))
        error[cycle] = np.where(running, infos["task_error"].mean(axis=1), error[cycle - 1])
        over = terminated | truncated
        length[running & over] = cycle
        running &= ~over
        if not running.any():
            error[cycle + 1 :] = error[cycle]
            break
        if over.any():  # they can't be left standing; what they do from here on isn't counted
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
        **{key: values[..., :count] for key, values in whole.items()}, time=period * np.arange(horizon + 1.0)
    )


def _require_policy(policy: object, name: str) -> None:
    """Refuse what isn't a policy.

    Raises:
        TypeError: saying what one is.
    """
    if isinstance(policy, type):
        raise TypeError(f"policy {name!r} is the class {policy.__name__}: give an object of it")
    if not all(callable(getattr(policy, one, None)) for one in ("reset", "act")):
        how = "a policy has reset(env, seeds) and act(observations); agents.make_policy makes one of a name"
        if callable(getattr(policy, "predict", None)):
            how = "agents.sb3_policy makes a policy of a Stable-Baselines3 model"
        raise TypeError(f"policy {name!r} is of type {type(policy).__name__}: {how}")


def _by_agent(env: BatchedEnv, actions: object) -> dict[str, np.ndarray]:
    """A policy's actions (B, m_i) as arrays.

    Raises:
        ValueError: for actions that are missing or misshapen, or aren't numbers by agent.
    """
    sizes = (env.action_offset[1:] - env.action_offset[:-1]).tolist()
    if not isinstance(actions, Mapping):
        what = f"an array of shape {actions.shape}" if isinstance(actions, np.ndarray) else type(actions).__name__
        raise ValueError(
            f"act(observations) has to return actions by agent, {{{env.agents[0]!r}: array of shape "
            f"{(env.num_envs, sizes[0])}, ...}}; got {what}"
        )
    found = {}
    for agent, size in zip(env.agents, sizes, strict=True):
        if agent not in actions:
            raise ValueError(f"no action for {agent!r}; got some for {', '.join(list(actions)[:8]) or 'nobody'}")
        try:
            found[agent] = np.asarray(actions[agent])
        except ValueError:  # lists of different lengths
            found[agent] = np.asarray(None)
        if found[agent].dtype.kind not in "fiu":
            raise ValueError(f"actions of {agent!r} aren't numbers: {reprlib.repr(actions[agent])}")
        if found[agent].shape != (env.num_envs, size):
            raise ValueError(
                f"actions of {agent!r} must have shape {(env.num_envs, size)}, one row for each copy of the "
                f"environment; got {found[agent].shape}"
            )
    return found
