"""Shared by `khop train` and its sweeps: settings from options and files, folders, and how to play what was trained."""

from __future__ import annotations

import json
import shlex
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from khop_env.commands.common import load, shielded_name, with_network
from khop_env.commands.folders import folder_name

if TYPE_CHECKING:
    from agents.learning import TrainingConfig
    from agents.learning.sweep_file import Sweep

Given = tuple[list[str], Mapping[str, Any], list[str], tuple[str | None, str | None]]  # as for `settings_of`


def sweep_of(file: Path, config: Path | None, given: Given) -> Sweep:
    """The sweep of a file, with the options' settings for all its trainings.

    Raises:
        ValueError: naming the file, for a wrong setting or value in it, or an option that doesn't go with it.
    """
    from agents.learning.sweep_file import Sweep, read_sweep

    if config is not None:
        raise ValueError("--sweep and --config: choose one of them; a sweep's file has settings, too")
    settings, grid, seeds = read_sweep(file)
    settings = settings_of(settings, file, *given)
    try:
        return Sweep(settings, grid, seeds)
    except ValueError as error:
        raise ValueError(f"{file}: {error}") from error


def settings_of(
    found: dict[str, Any],
    file: Path | None,
    settings: list[str],
    options: Mapping[str, Any],
    env: list[str],
    over: tuple[str | None, str | None],
) -> dict[str, Any]:
    """The settings: those of the options, then of --set, then of the file.

    Args:
        found: the file's.
        file: for errors.
        settings: --set.
        options: of the command, by setting.
        env: --env.
        over: --network and --estimator.

    Raises:
        ValueError: for a wrong file, setting or argument, or no environment.
    """
    from agents.learning.config_file import setting_types
    from khop_env.observers import ESTIMATORS
    from khop_env.registry import find_task
    from khop_env.typed import environment_arguments, environment_types, fitting_values, typed_values

    known = {name: kind for name, kind in setting_types().items() if name != "arguments"}
    found |= {**typed_values(settings, "--set", known), **options}
    if "environment" not in found:
        raise ValueError("name an environment to train for, khop train ENV, or a --config file that names it")
    task = find_task(found["environment"])
    elsewhere = {"observe": "--observe", "bounds": "--bounds"}
    arguments = fitting_values(found.get("arguments", {}), f"{file}: arguments", environment_types(task))
    found["arguments"] = arguments | with_network(environment_arguments(env, task, elsewhere), *over)
    estimator = found["arguments"].get("estimator")
    if not isinstance(estimator, str | None):
        raise ValueError(
            f"estimator {estimator.name!r}: the configuration of a training is a file, which can't hold an estimator "
            f"of your own; choose one of {', '.join(ESTIMATORS)}"
        )
    if found.get("scenario") is not None:
        load(found["scenario"])  # refuses one with a law that there isn't, as every command does
    return found


def default_folder(config: TrainingConfig, environment: str) -> str:
    """The name of a training's folder, unless the user names one."""
    shield = "" if config.shield is None else f"shield-{config.shield}"
    residual = "" if config.residual is None else f"residual-{config.residual}"
    policy = "" if config.policy == "mlp" else config.policy
    network = "" if config.evaluate_network is None else f"evaluated-{config.evaluate_network}"
    critic = "state-critic" * (config.critic == "state")
    extras = network, "bounds" * config.bounds, shield, residual, policy, "per_type" * config.per_type, critic
    return folder_name(
        environment, str(config.scenario or ""), config.observe, *extras, f"{config.algorithm}-{config.seed}"
    )


def play_command(config: TrainingConfig, folder: Path) -> str:
    """The command that plays what was trained."""
    command = ["khop", "evaluate", str(config.environment)]
    command += ["--scenario", str(config.scenario)] if config.scenario else []
    arguments = config.as_dict()["arguments"]
    if config.evaluate_network is not None:
        arguments["network"] = config.evaluate_network
    for name, value in arguments.items():
        if name in ("network", "estimator") and isinstance(value, str):
            command += [f"--{name}", value]
            continue
        command += ["--env", f"{name}={value if isinstance(value, str) else json.dumps(value)}"]
    policy = f"{config.algorithm}:{folder}"
    if config.shield is not None:
        policy = shielded_name(policy, str(config.shield))
    return shlex.join([*command, "--policies", policy])
