"""The settings of a training run as a TOML file: `khop train` writes one into each run's folder, and reads it."""

from __future__ import annotations

import dataclasses
import inspect
import textwrap
import tomllib
from collections.abc import Mapping
from pathlib import Path
from typing import Any, get_type_hints

import tomlkit

from agents.learning.config import TrainingConfig
from khop_env.scenarios import Scenario
from khop_env.tasks import Task
from khop_env.typed import fitting_values

_TABLE = "arguments"  # the one table


def write_config(config: TrainingConfig, versions: Mapping[str, str]) -> str:
    """Every setting with its meaning, as the text of a TOML file that `read_config` takes.

    Args:
        config: the settings. A scenario or task that is a Python object stands there by its name.
        versions: of what it was trained with, for a comment.
    """
    document, meanings = tomlkit.document(), _meanings()
    document.add(tomlkit.comment("Settings of a training run. Once more: khop train --config config.toml --out FOLDER"))
    document.add(tomlkit.comment(", ".join(f"{name} {version}" for name, version in versions.items())))
    values = config.as_dict()
    for name, value in values.items():
        if name == _TABLE:
            continue
        document.add(tomlkit.nl())
        for line in textwrap.wrap(meanings[name], 100):
            document.add(tomlkit.comment(line))
        by_name = value is None or not isinstance(getattr(config, name), Scenario | Task | type)
        if not by_name:
            document.add(tomlkit.comment("(It was a Python object of this name: write here where it is found.)"))
        if value is None:
            document.add(tomlkit.comment(f'{name} = "..."'))
        else:
            document.add(name, value)
    document.add(tomlkit.nl())
    table = tomlkit.table()
    for line in textwrap.wrap(meanings[_TABLE], 100):
        table.add(tomlkit.comment(line))
    for name, value in values[_TABLE].items():
        if value is not None:
            table.add(name, value)
    document.add(_TABLE, table)
    return tomlkit.dumps(document)


def read_config(path: str | Path) -> dict[str, Any]:
    """The settings that a file has, by name; those that it leaves out are left out.

    Raises:
        ValueError: naming the file, the setting, its value and what is expected.
        OSError: if it can't be read.
    """
    return fitting_values(read_toml(path), str(path), setting_types())


def read_toml(path: str | Path) -> dict[str, Any]:
    """All that a TOML file holds.

    Raises:
        ValueError: if it isn't one.
        OSError: if it can't be read.
    """
    try:
        return tomllib.loads(Path(path).read_text(encoding="utf-8"))
    except (tomllib.TOMLDecodeError, UnicodeDecodeError, RecursionError) as error:
        raise ValueError(f"{path} isn't a TOML file: {error}") from error


def setting_types() -> dict[str, Any]:
    """The type of every setting as text can give it: environment and scenario are names there."""
    return {**get_type_hints(TrainingConfig), "environment": str, "scenario": str}


def _meanings() -> dict[str, str]:
    """What the docstring of `TrainingConfig` says of each setting."""
    section = (inspect.getdoc(TrainingConfig) or "").partition("Attributes:\n")[2].partition("\n\n")[0]
    found = dict.fromkeys((each.name for each in dataclasses.fields(TrainingConfig)), "")
    name = ""
    for line in section.splitlines():
        if not line.startswith("     "):
            name, _, line = line.strip().partition(": ")
        found[name] = f"{found[name]} {line.strip()}".strip()
    return found
