"""Scenarios and environments by name."""

from __future__ import annotations

import importlib
import inspect
from collections.abc import Callable, Mapping, Sequence
from pathlib import Path
from types import ModuleType
from typing import TYPE_CHECKING, Any, get_type_hints

import numpy as np
from gymnasium.vector import AutoresetMode

from khop_env.env import BatchedEnv, JointEnv, KHopVectorEnv, Settings, Task
from khop_env.physics import did_you_mean
from khop_env.scenarios.convoy import convoy
from khop_env.scenarios.mixed_fleet import mixed_fleet
from khop_env.scenarios.paper import paper
from khop_env.scenarios.random_geometric import random_geometric
from khop_env.scenarios.scenario import Scenario
from khop_env.simulation import Proximal

if TYPE_CHECKING:
    from khop_env.env.sb3 import KHopSB3VecEnv

ScenarioFactory = Callable[..., Scenario]
"""A function that makes a scenario; the parameters of a family are int, float, bool or str, with defaults."""

SCENARIOS: dict[str, ScenarioFactory] = {
    factory.__name__: factory for factory in (paper, convoy, mixed_fleet, random_geometric)
}
"""Every scenario of the library: the module `khop_env/scenarios/<name>.py` and its function of the same name."""

ENVIRONMENTS = ("consensus_v0", "formation_v0", "leader_following_v0")
"""Every environment of the library: the modules `khop_env/<name>.py`."""

_TRUTH = {"true": True, "false": False}


def scenarios() -> tuple[str, ...]:
    """The names of all scenarios."""
    return tuple(SCENARIOS)


def environments() -> tuple[str, ...]:
    """The names of all environments."""
    return ENVIRONMENTS


def make_vec(
    environment: str, num_envs: int = 1, *, autoreset_mode: str | AutoresetMode | None = None, **arguments: Any
) -> KHopVectorEnv:
    """A Gymnasium vector environment over the batched simulator.

    Args:
        environment: one of `environments()`.
        num_envs: copies B; with N agents the vector environment has B * N rows.
        autoreset_mode: "same_step" (default), "next_step" or "disabled", as `KHopVectorEnv` describes them.
        arguments: those of the environment's `parallel_env`, without render_mode.

    Raises:
        ValueError: for an unknown environment or scenario, naming the nearest, or a wrong argument.
    """
    batched = environment_module(environment).batched_env(num_envs=num_envs, **arguments)
    return KHopVectorEnv(batched, name=environment, autoreset_mode=autoreset_mode)


def make_sb3_vec(environment: str, num_envs: int = 1, **arguments: Any) -> KHopSB3VecEnv:
    """A Stable-Baselines3 VecEnv over the batched simulator, one sub-environment per agent and copy.

    Args:
        environment: one of `environments()`.
        num_envs: copies B.
        arguments: as for `make_vec`.

    Raises:
        ImportError: without Stable-Baselines3.
        ValueError: as `make_vec`.
    """
    module = environment_module(environment)
    try:
        from khop_env.env.sb3 import KHopSB3VecEnv
    except ImportError as error:
        raise ImportError("make_sb3_vec needs Stable-Baselines3: pip install 'khop_env[rl]'") from error
    return KHopSB3VecEnv(module.batched_env(num_envs=num_envs, **arguments))


def make_joint(environment: str, render_mode: str | None = None, **arguments: Any) -> JointEnv:
    """The centralised single-agent view, which `gymnasium.make("khop/Consensus-v0")` gives.

    Args:
        environment: one of `environments()`.
        render_mode: None, "human" or "rgb_array".
        arguments: those of the environment's `parallel_env`.

    Raises:
        ValueError: as `make_vec`.
    """
    return JointEnv(environment_module(environment).parallel_env(render_mode=render_mode, **arguments))


make_joint.metadata = JointEnv.metadata  # type: ignore[attr-defined]  # where gymnasium.make looks for render modes


def assemble(
    scenario_or_name: Scenario | str | Path,
    task: Callable[[Scenario], Task],
    num_envs: int,
    arguments: dict[str, Any],
    others: Sequence[str] = (),
) -> BatchedEnv:
    """The environment of a scenario and a task: what the `*_v0` modules call.

    Args:
        scenario_or_name: a scenario, or what `scenario` takes.
        task: makes the task of the scenario's fleet and graphs.
        num_envs: copies B.
        arguments: of `Settings`, by name.
        others: the arguments of the environment's own.

    Raises:
        TypeError: for an argument that there isn't, naming the nearest.
        ValueError: for a wrong one.
    """
    if "render_mode" in arguments:
        raise TypeError(
            "got an unexpected keyword argument 'render_mode': batches aren't rendered; give it to the environment's "
            "parallel_env, which is one copy"
        )
    settings = Settings.of(arguments, ("scenario", "num_envs", "render_mode", *others))
    if isinstance(num_envs, bool) or not isinstance(num_envs, int | np.integer) or num_envs < 1:
        raise ValueError(f"num_envs must be a positive integer; got {num_envs!r}")
    chosen = scenario_or_name if isinstance(scenario_or_name, Scenario) else scenario(scenario_or_name)
    simulator = chosen.build(integrator=Proximal(settings.order, settings.threads), batch=int(num_envs))
    return BatchedEnv(simulator, task(chosen), settings, chosen.name)


def environment_module(environment: str) -> ModuleType:
    """The module of an environment, which has `parallel_env`, `batched_env` and `env`.

    Raises:
        ValueError: for an unknown environment, naming the nearest.
    """
    if environment not in ENVIRONMENTS:
        raise ValueError(f"no environment {environment!r}; {did_you_mean(environment, ENVIRONMENTS)}")
    return importlib.import_module(f"khop_env.{environment}")


def describe() -> list[dict[str, Any]]:
    """Name, one line, and parameters with their defaults of every scenario."""
    return [
        {
            "name": name,
            "description": (inspect.getdoc(factory) or "").partition("\n")[0],
            "parameters": {key: one.default for key, one in inspect.signature(factory).parameters.items()},
        }
        for name, factory in SCENARIOS.items()
    ]


def scenario(name_or_path: str | Path, **parameters: Any) -> Scenario:
    """A scenario by name, with parameters, or from a file.

        scenario("paper")
        scenario("random_geometric", agents=100, k=2)
        scenario("random_geometric:agents=100,k=2")
        scenario("mine.toml")

    Args:
        name_or_path: a registered name, parameters of a family after a colon, or a path that ends in .toml.
        parameters: parameters of a family; they win over those after the colon.

    Raises:
        ScenarioFileError: if the file is wrong.
        ValueError: for an unknown name or parameter, naming the nearest.
    """
    text = str(name_or_path)
    if text.endswith(".toml"):
        from khop_env.scenarios.files import read_scenario

        if parameters:
            raise ValueError(f"a scenario file takes no parameters; got {', '.join(parameters)} with {text}")
        return read_scenario(text)
    name, _, given = text.partition(":")
    if name not in SCENARIOS:
        if text.lower().endswith(".toml") or Path(text).is_file():
            raise ValueError(f"no scenario {text!r}; if it is a scenario file, rename it: such a name ends in .toml")
        raise ValueError(f"no scenario {name!r}; {did_you_mean(name, SCENARIOS)} (A file's name ends in .toml.)")
    factory = SCENARIOS[name]
    known = inspect.signature(factory).parameters
    parameters = parameters_from_text(given, get_type_hints(factory), f"scenario {text!r}") | parameters
    for key in parameters:
        if key not in known:
            what = did_you_mean(key, known) if known else "it has none"
            raise ValueError(f"scenario {name!r} has no parameter {key!r}; {what}")
    return factory(**parameters)


def parameters_from_text(text: str, types: Mapping[str, Any], what: str) -> dict[str, Any]:
    """Parameters of "agents=100,k=2": numbers, true or false, or text, as their types ask.

    Args:
        text: what stands after the colon of a name; may be empty.
        types: of the known parameters; others stay text, to be refused by name.
        what: they are parameters of, for the error.

    Raises:
        ValueError: for what isn't parameter=value, or isn't of its type.
    """
    found = {}
    for part in filter(None, text.split(",")):
        key, equals, value = (piece.strip() for piece in part.partition("="))
        if not equals:
            raise ValueError(f"{what}: expected parameter=value after the colon; got {part!r}")
        kind = types.get(key, str)
        try:
            found[key] = _TRUTH[value] if kind is bool else kind(value)
        except (ValueError, KeyError):
            expected = "true or false" if kind is bool else f"of type {kind.__name__}"
            raise ValueError(f"{what}: {key} must be {expected}; got {value!r}") from None
    return found
