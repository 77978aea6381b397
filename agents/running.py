"""A policy in its environment, with the interface of a simulator, for recordings."""

from __future__ import annotations

import copy
import dataclasses
import functools
import math
from collections.abc import Mapping
from typing import Any

import numpy as np

from agents.learning.learned import LearnedPolicy
from agents.learning.pretrained import PretrainedPolicy, environments_of, resolved
from agents.outcomes import Outcomes
from agents.policies import make_policy, needs
from agents.policy import Policy, describe, in_words, policy_seeds
from agents.safety import SafetyFilter
from agents.safety.environments import show_corrections
from khop_env.env import KHopEnv, Settings
from khop_env.observers import Extremes, FloatArray, FunnelError, SolveError
from khop_env.registry import Environment, environments, find_task, make
from khop_env.results.recording import Drawing, StoppedError
from khop_env.scenarios import Scenario
from khop_env.simulation import Observe, Simulator


class PolicyRun:
    """Stands in for a simulator in `results.record`: its steps are control periods of an environment with a policy.

    Args:
        env: the environment; it is reset.
        policy: chooses the actions.
        seed: of the episode.
        name: of the policy, for errors.

    Attributes:
        episode_return: mean over the agents of the rewards so far.
    """

    def __init__(self, env: KHopEnv, policy: Policy, seed: int, name: str = "policy") -> None:
        self.env, self.policy, self.name = env, policy, name
        self.simulator: Simulator = env.batched.simulator
        try:
            policy.reset(describe(env), policy_seeds([seed]))
        except ValueError:
            raise
        except Exception as error:
            raise ValueError(in_words(error, name)) from error
        self._observations, _ = env.reset(seed=seed)
        self._extremes = self.simulator.extremes
        self.episode_return = 0.0
        self._cycle, self._outcomes = 0, Outcomes(env.batched, self._infos())

    def __getattr__(self, name: str) -> Any:
        return getattr(self.simulator, name)

    @property
    def duration(self) -> float:
        """Length of the episode in s."""
        settings = self.env.batched.settings
        return settings.horizon * settings.control_period

    @property
    def extremes(self) -> Extremes:
        """The largest ratios since the reset, over all actions."""
        return self._extremes.copied()

    def task_error(self) -> float:
        """Current task error, mean over the agents."""
        return float(self.env.batched.task_errors().mean())

    @property
    def outcomes(self) -> dict[str, float]:
        """Of an environment in which agents may collide, as in `Episodes.outcomes`; nan where there is none."""
        return {name: float(values[0]) for name, values in self._outcomes.result().items()}

    def drawing(self) -> Drawing:
        """What the task adds to a frame of the present state, also after later steps."""
        task, world = copy.copy(self.env.batched.task), self.env.batched.world
        task.memory = copy.deepcopy(task.memory)
        return functools.partial(task.draw, world=dataclasses.replace(world, t=world.t.copy(), x=world.x.copy()))

    def ended(self) -> bool:
        """Whether the episode is over, at its horizon or because the task ended it."""
        return not self.env.agents

    def step(self, dt: float) -> None:
        """One control period, whose length `dt` has to be.

        Raises:
            StoppedError: if the policy fails, or its actions are refused.
        """
        actions: Mapping[str, Any] = self._guarded(self.policy.act, self._observations)
        show_corrections(self.env.batched.world, self.policy)
        self._observations, rewards, *_ = self._guarded(self.env.step, actions)
        self.episode_return += float(np.mean(list(rewards.values())))
        self._cycle += 1
        over = np.array([self.ended()])
        self._outcomes.add(self._cycle, np.ones(1, np.bool_), over, self._infos(), self.policy)
        for running, now in zip(self._extremes, self.simulator.extremes, strict=True):
            np.maximum(running, now, out=running)

    def _infos(self) -> Mapping[str, FloatArray]:
        """(1, N) each, at present."""
        return self.env.batched.task.evaluate(self.env.batched.world).infos

    def _guarded(self, function: Any, *arguments: Any) -> Any:
        """What a function returns; its exceptions don't lose what was recorded before."""
        try:
            return function(*arguments)
        except (FunnelError, SolveError):
            raise
        except Exception as error:
            raise StoppedError(in_words(error, self.name)) from error


def policy_run(
    spec: str,
    scenario: Scenario,
    observe: Observe,
    duration: float | None,
    seed: int,
    *,
    environment: Environment | None = None,
    arguments: Mapping[str, Any] | None = None,
) -> PolicyRun:
    """A policy in an environment, at the beginning of an episode: see `policy_and_environment`.

    Args:
        spec: as there.
        scenario: as there.
        observe: as there.
        duration: as there.
        seed: of the episode.
        environment: as there.
        arguments: as there.

    Raises:
        ValueError: as there, or for a policy that doesn't fit its observations.
    """
    policy, env = policy_and_environment(
        spec, scenario, observe, duration, environment=environment, arguments=arguments
    )
    return PolicyRun(env, policy, seed, spec)


def policy_and_environment(
    spec: str,
    scenario: Scenario,
    observe: Observe,
    duration: float | None,
    *,
    environment: Environment | None = None,
    arguments: Mapping[str, Any] | None = None,
) -> tuple[Policy, KHopEnv]:
    """A policy and an environment for it, none of them reset.

    A learned policy gets the bounds and arguments that it was trained with, unless `arguments` have others.

    Args:
        spec: what `make_policy` takes, e.g. "zero", "tanh" or "ppo:runs/mine".
        scenario: where it acts.
        observe: observation mode.
        duration: of the episode in s, rounded up to whole control periods; None for that of the environment.
        environment: name or task; `environment_for` chooses by default.
        arguments: of the environment.

    Raises:
        ValueError: for a policy that doesn't fit, an environment that isn't known, or both a duration and max_cycles.
    """
    policy, chosen = make_policy(spec), dict(arguments or {})
    environment = environment_for(spec, scenario) if environment is None else environment
    task = find_task(environment)
    named = f"{task.name}_v{task.version}"
    policy = resolved(policy, named, scenario, chosen)
    about = _training(policy)
    if about.get("environment") == named:
        chosen = {"bounds": about["bounds"], **about.get("arguments", {}), **chosen}
    chosen |= needs(policy).among(arguments or {}, scenario)
    if duration is not None:
        if "max_cycles" in (arguments or {}):
            raise ValueError("a duration and max_cycles: choose one of them for the length of the episode")
        period = chosen.get("control_period", Settings.control_period)
        chosen["max_cycles"] = max(1, math.ceil(duration / period - 1e-9))
    return policy, make(environment, scenario, observe=observe, **chosen)


def environment_for(spec: str, scenario: Scenario) -> str:
    """The environment in which a policy acts where none is named.

    Args:
        spec: of the policy, as for `policy_run`.
        scenario: where it acts.

    Returns:
        What a learned policy was trained for; for others the environment that it is the default policy of, that of the
        scenario's law, navigation where the scenario has an arena, or consensus. Where policies are shipped for several
        environments on the scenario, "ppo:pretrained" acts in the one in which others do.

    Raises:
        ValueError: if a learned policy was trained for a task that isn't of the library, or none is shipped for the
            scenario.
    """
    of_law = f"{scenario.law.name}_v0"
    of_policy = [name for name in environments() if find_task(name).default_policy == spec.partition(":")[0]]
    of_scenario = "consensus_v0" if scenario.arena is None else "navigation_v0"
    other = of_policy[0] if of_policy else of_law if of_law in environments() else of_scenario
    policy = make_policy(spec)
    if isinstance(_inside(policy), PretrainedPolicy):
        for_it = environments_of(scenario.name)
        if other not in for_it and len(for_it) > 1:
            raise ValueError(f"there are pretrained policies for {' and '.join(for_it)} on {scenario.name}: choose one")
        return other if other in for_it else for_it[0]
    found: str = _training(policy).get("environment", other)
    if found not in environments():
        raise ValueError(
            f"{spec} was trained for {found}, which isn't of the library: name its task, as in "
            f"khop run my_file.py:MyTask --controller {spec}"
        )
    return found


def _inside(policy: Policy) -> Policy:
    """A policy, or the one in its safety filter."""
    return _inside(policy.policy) if isinstance(policy, SafetyFilter) else policy


def _training(policy: Policy) -> Mapping[str, Any]:
    """How a learned policy was trained, in a safety filter or not; nothing of others."""
    inside = _inside(policy)
    return inside.about if isinstance(inside, LearnedPolicy) else {}
