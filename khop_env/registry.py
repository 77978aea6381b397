"""Scenarios and environments by name."""

from __future__ import annotations

import dataclasses
import inspect
import math
import re
from collections.abc import Callable
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias, TypeVar, get_type_hints

import numpy as np
from gymnasium.vector import AutoresetMode

from khop_env.catalog import ENVIRONMENTS, describe
from khop_env.collection import collection_paused
from khop_env.env import BatchedEnv, JointEnv, KHopEnv, KHopVectorEnv, Settings
from khop_env.extras import how_to_install
from khop_env.network import Network
from khop_env.objects import is_object_name, load_object
from khop_env.observers import Networked, Observers, Proximal
from khop_env.physics import did_you_mean
from khop_env.scenarios.named import SCENARIOS, parameters_from_text, scenario, scenarios
from khop_env.scenarios.scenario import Scenario
from khop_env.tasks import Task

if TYPE_CHECKING:
    from pettingzoo import AECEnv

    from khop_env.env.sb3 import KHopSB3VecEnv

__all__ = [
    "SCENARIOS",
    "Environment",
    "describe",
    "environments",
    "find_task",
    "make",
    "make_aec",
    "make_batched",
    "make_joint",
    "make_sb3_vec",
    "make_vec",
    "parameters_from_text",
    "scenario",
    "scenarios",
    "spelled_out",
]


Environment: TypeAlias = str | Task | type[Task]
"""An environment's name, or a task: an object, or a class that is constructed with the task's arguments; or the
place of such an object or class, "my_module:MyTask" or "my_file.py:MyTask"."""


Function = TypeVar("Function", bound=Callable[..., Any])


def environments() -> tuple[str, ...]:
    """The names of all environments."""
    return tuple(ENVIRONMENTS)


def find_task(environment: Environment) -> Task | type[Task]:
    """The task of an environment: an object, or a class to be constructed with arguments.

    Args:
        environment: one of `environments()`, a task of your own, or its place, "my_file.py:MyTask".

    Raises:
        TypeError: if `environment` is neither a name nor a task.
        ValueError: for an unknown environment, with the closest name, or a name under which something else is found.
    """
    found: Any = environment
    if isinstance(environment, str):
        if environment in ENVIRONMENTS:
            found = load_object(ENVIRONMENTS[environment])
        elif is_object_name(environment):
            found = load_object(environment)
        else:
            raise ValueError(f"no environment {environment!r}; {did_you_mean(environment, ENVIRONMENTS)}")
    if not (isinstance(found, Task) or (isinstance(found, type) and issubclass(found, Task))):
        if isinstance(environment, str):
            raise ValueError(f"{environment} should be a Task, a class or an object; got {type(found).__name__}")
        raise TypeError(f"expected an environment's name or a Task; got {found!r} ({type(found).__name__})")
    return found


def make_batched(
    environment: Environment, scenario: Scenario | str | Path | None = None, *, num_envs: int = 1, **arguments: Any
) -> BatchedEnv:
    """A batch of environments as arrays (num_envs, agents, ...).

    Args:
        environment: one of `environments()`, or a task of your own.
        scenario: a scenario, or an argument of `scenario`; the task's default if left out.
        num_envs: number of environments B.
        arguments: of `Settings`, and of the task unless it is an object, by name.

    Raises:
        TypeError: for an unknown argument; the message suggests the closest one.
        ValueError: for an unknown environment or scenario, or a wrong argument.
    """
    task = find_task(environment)
    if "render_mode" in arguments:
        raise TypeError(
            "got an unexpected keyword argument 'render_mode': batches aren't rendered; give it to the environment's "
            "parallel_env, which is one environment"
        )
    of_settings = [field.name for field in dataclasses.fields(Settings)]
    of_task = list(_task_parameters(task)) if isinstance(task, type) else []
    for name in arguments:
        if name not in (*of_settings, *of_task):
            known = ["scenario", *of_task, *of_settings, "num_envs", "render_mode"]
            raise TypeError(f"got an unexpected keyword argument {name!r}; {did_you_mean(name, known)}")
    chosen_settings = {**task.defaults, **{name: value for name, value in arguments.items() if name in of_settings}}
    settings = Settings(**chosen_settings)
    if isinstance(num_envs, bool) or not isinstance(num_envs, int | np.integer) or num_envs < 1:
        raise ValueError(f"num_envs must be a positive integer; got {num_envs!r}")
    chosen = _chosen_scenario(task.default_scenario if scenario is None else scenario)
    if isinstance(task, type):
        task = task(**{name: value for name, value in arguments.items() if name in of_task})
    settings, observers = _observers_of(settings, chosen, int(num_envs))
    if settings.max_cycles is None:
        cycles = max(1, math.ceil(chosen.duration / settings.control_period - 1e-9))
        settings = dataclasses.replace(settings, max_cycles=cycles)
    with collection_paused():
        return BatchedEnv(chosen.build(observers=observers, num_envs=int(num_envs)), task, settings, chosen.name)


def make(
    environment: Environment,
    scenario: Scenario | str | Path | None = None,
    *,
    render_mode: str | None = None,
    **arguments: Any,
) -> KHopEnv:
    """The PettingZoo ParallelEnv of an environment, or of a task of your own.

    Args:
        environment: one of `environments()`, or a task of your own.
        scenario: a scenario, or an argument of `scenario`; the task's default if left out.
        render_mode: None, "human" or "rgb_array".
        arguments: as for `make_batched`.

    Raises:
        TypeError: as `make_batched`.
        ValueError: as `make_batched`, or for an unknown render mode.
    """
    batched = make_batched(environment, scenario, **arguments)
    return KHopEnv(batched, name=batched.task.environment, render_mode=render_mode)


def make_aec(
    environment: Environment,
    scenario: Scenario | str | Path | None = None,
    *,
    render_mode: str | None = None,
    **arguments: Any,
) -> AECEnv:
    """The same as a PettingZoo AECEnv, by PettingZoo's own conversion.

    Args:
        environment: as for `make`.
        scenario: as for `make`.
        render_mode: as for `make`.
        arguments: as for `make`.

    Raises:
        TypeError: as `make`.
        ValueError: as `make`.
    """
    from pettingzoo.utils import parallel_to_aec

    return parallel_to_aec(make(environment, scenario, render_mode=render_mode, **arguments))


def make_vec(
    environment: Environment, num_envs: int = 1, *, autoreset_mode: str | AutoresetMode | None = None, **arguments: Any
) -> KHopVectorEnv:
    """A Gymnasium vector environment over the batched simulator.

    Args:
        environment: one of `environments()`, or a task of your own.
        num_envs: number of environments B; with N agents the vector environment has B * N rows.
        autoreset_mode: "same_step" (default), "next_step" or "disabled", as `KHopVectorEnv` describes them.
        arguments: those of `make`, without render_mode.

    Raises:
        TypeError: as `make`.
        ValueError: as `make`.
    """
    batched = make_batched(environment, num_envs=num_envs, **arguments)
    return KHopVectorEnv(batched, name=batched.task.environment, autoreset_mode=autoreset_mode)


def make_sb3_vec(environment: Environment, num_envs: int = 1, **arguments: Any) -> KHopSB3VecEnv:
    """A Stable-Baselines3 VecEnv over the batched simulator, one row per agent and environment.

    Args:
        environment: one of `environments()`, or a task of your own.
        num_envs: number of environments B.
        arguments: as for `make_vec`.

    Raises:
        ImportError: without Stable-Baselines3.
        TypeError: as `make_vec`.
        ValueError: as `make_vec`.
    """
    try:
        from khop_env.env.sb3 import KHopSB3VecEnv
    except ImportError as error:
        raise ImportError(f"make_sb3_vec needs Stable-Baselines3: {how_to_install('rl')}") from error
    return KHopSB3VecEnv(make_batched(environment, num_envs=num_envs, **arguments))


def make_joint(environment: Environment, render_mode: str | None = None, **arguments: Any) -> JointEnv:
    """The centralised single-agent environment, which `gymnasium.make("khop/Consensus-v0")` returns.

    Args:
        environment: one of `environments()`, or a task of your own.
        render_mode: None, "human" or "rgb_array".
        arguments: as for `make`.

    Raises:
        TypeError: as `make`.
        ValueError: as `make`.
    """
    return JointEnv(make(environment, render_mode=render_mode, **arguments))


make_joint.metadata = JointEnv.metadata  # type: ignore[attr-defined]  # where gymnasium.make looks for render modes


def spelled_out(task: type[Task]) -> Callable[[Function], Function]:
    """Show the arguments of settings and task in signature and docstring of a function that takes them as keywords.

    Args:
        task: the environment's.
    """

    def decorate(function: Function) -> Function:
        signature, own = inspect.signature(function), get_type_hints(function)
        fixed = [
            each.replace(annotation=own[each.name])
            for each in signature.parameters.values()
            if each.kind is not inspect.Parameter.VAR_KEYWORD
        ]
        hints = get_type_hints(Settings) | get_type_hints(task)
        keywords = [
            inspect.Parameter(name, inspect.Parameter.KEYWORD_ONLY, default=default, annotation=hints[name])
            for name, default in {**_task_parameters(task), **_defaults(Settings), **task.defaults}.items()
        ]
        shown = signature.replace(parameters=[*fixed, *keywords], return_annotation=own["return"])
        function.__signature__ = shown  # type: ignore[attr-defined]
        if function.__doc__:  # there are none under python -OO
            texts = _SHARED_ARGUMENTS | _attributes(Settings) | _attributes(task)
            lines = [f"    {each}\n        {texts[each.name]}" for each in shown.parameters.values()]
            function.__doc__ = inspect.cleandoc(function.__doc__) + "\n\nArgs:\n" + "\n".join(lines)
        return function

    return decorate


_SHARED_ARGUMENTS = {
    "scenario": "a name, a name with parameters, a path that ends in .toml, or a `Scenario`.",
    "num_envs": "copies B.",
    "render_mode": 'None, "human" or "rgb_array".',
}


def _attributes(cls: type) -> dict[str, str]:
    """What the docstrings of a dataclass and its bases say of each attribute, with the line breaks of theirs."""
    found: dict[str, str] = {}
    for base in reversed(cls.__mro__):
        section = inspect.cleandoc(vars(base).get("__doc__") or "").partition("\nAttributes:\n")[2].partition("\n\n")[0]
        for text in re.split(r"^    (?=\w)", section, flags=re.MULTILINE)[1:]:
            name, _, words = text.partition(": ")
            found[name] = words.strip()
    return found


def _task_parameters(task: type[Task]) -> dict[str, Any]:
    """Names and defaults of a task's arguments."""
    parameters = inspect.signature(task).parameters.values()
    kinds = inspect.Parameter.KEYWORD_ONLY, inspect.Parameter.POSITIONAL_OR_KEYWORD
    return {each.name: each.default for each in parameters if each.kind in kinds}


def _defaults(settings: type[Settings]) -> dict[str, Any]:
    return {field.name: field.default for field in dataclasses.fields(settings)}


def _observers_of(settings: Settings, scenario: Scenario, num_envs: int) -> tuple[Settings, Observers]:
    """The observers, and the settings with the scenario's network and estimator where none are chosen."""
    network = Network.of(scenario.network if settings.network is None else settings.network)
    if network is None:
        if settings.estimator is not None:
            name = settings.estimator if isinstance(settings.estimator, str) else settings.estimator.name
            raise ValueError(
                f"estimator: {name!r} makes estimates from messages, and there is no network: choose one, e.g. "
                "network='wifi'"
            )
        if settings.message_size:
            raise ValueError(
                f"message_size={settings.message_size}: without a network there are no messages: choose one, e.g. "
                "network='wifi'"
            )
        return dataclasses.replace(settings, network=None), Proximal(settings.order, settings.threads_for(num_envs))
    if settings.order != 1:
        raise ValueError(
            f"order={settings.order} is of simulators without a network; under one steps are of order 1: leave it out, "
            "and choose a shorter dt for more accuracy"
        )
    estimator = settings.estimator or scenario.estimator
    chosen = dataclasses.replace(settings, network=network, estimator=estimator)
    return chosen, Networked(network, estimator, settings.message_size, settings.threads_for(num_envs))


def _chosen_scenario(scenario_or_name: Scenario | str | Path) -> Scenario:
    return scenario_or_name if isinstance(scenario_or_name, Scenario) else scenario(scenario_or_name)
