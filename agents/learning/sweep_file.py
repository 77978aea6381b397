"""A sweep: trainings with all combinations of some settings' values, as a TOML file describes them."""

from __future__ import annotations

import hashlib
import itertools
import json
import re
from collections import Counter
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from agents.learning.config import TrainingConfig
from agents.learning.config_file import read_toml, setting_types
from khop_env.registry import find_task
from khop_env.typed import MismatchError, environment_types, fitting, fitting_values

ARGUMENTS = "arguments"
_LONGEST = 150  # characters of a folder's name


@dataclass(frozen=True)
class SweepRun:
    """One training of a sweep.

    Attributes:
        name: of its folder, after its values and seed.
        values: of the settings in the grid.
        config: all its settings.
    """

    name: str
    values: Mapping[str, Any]
    config: TrainingConfig


@dataclass(frozen=True)
class Sweep:
    """Trainings with all combinations of some settings' values, each with several seeds.

    Attributes:
        settings: of all trainings, by name, as `TrainingConfig` takes them; "environment" at least.
        grid: by setting the values to try; under "arguments" by argument of the environment.
        seeds: of every combination.

    Raises:
        ValueError: if a setting is unknown, or a value wrong, missing or there twice; the message names it.
    """

    settings: Mapping[str, Any]
    grid: Mapping[str, Any]
    seeds: Sequence[int] = (0,)
    values: Mapping[str, list[Any]] = field(init=False, repr=False)  # the grid's, of the settings' types, flat

    def __post_init__(self) -> None:
        if "seed" in self.settings or "seed" in self.grid:
            raise ValueError("seed: a sweep takes all its seeds in one list, seeds = [0, 1, 2]")
        if "environment" not in self.settings:
            where = "; one sweep is for one, as returns can't be compared" if "environment" in self.grid else ""
            raise ValueError(f"environment: name one for all trainings of the sweep{where}")
        object.__setattr__(self, "seeds", tuple(_values("seeds", self.seeds, int)))
        of_task = environment_types(find_task(self.settings["environment"]))
        fixed = self.settings.get(ARGUMENTS, {})
        known = {name: kind for name, kind in setting_types().items() if name != ARGUMENTS}
        found: dict[str, list[Any]] = {}
        for name, values in self.grid.items():
            if name == ARGUMENTS and isinstance(values, Mapping):
                found |= _fitted(f"grid.{ARGUMENTS}", values, of_task, fixed, f"{ARGUMENTS}.")
            else:
                found |= _fitted("grid", {name: values}, known, self.settings)
        if not found:
            raise ValueError("grid: name at least one setting with a list of values, [grid] learning_rate = [1e-3]")
        object.__setattr__(self, "values", found)

    def runs(self) -> list[SweepRun]:
        """All trainings: every combination with the first seed, then with the next one.

        Raises:
            ValueError: if values don't go together; the message names them.
        """
        combinations = [dict(zip(self.values, each, strict=True)) for each in itertools.product(*self.values.values())]
        chosen = [(values, seed) for seed in self.seeds for values in combinations]
        names = [_name(values, seed) for values, seed in chosen]
        taken = Counter(names)
        found = []
        for name, (values, seed) in zip(names, chosen, strict=True):
            if taken[name] > 1 or len(name) > _LONGEST:
                digest = hashlib.sha256(repr((values, seed)).encode()).hexdigest()[:8]
                name = f"{name[:_LONGEST]}-{digest}"
            found.append(SweepRun(name, values, self._config(values, seed)))
        return found

    def _config(self, values: Mapping[str, Any], seed: int) -> TrainingConfig:
        settings, arguments = {**self.settings, "seed": seed}, dict(self.settings.get(ARGUMENTS, {}))
        for name, value in values.items():
            table, dot, argument = name.partition(".")
            if dot:
                arguments[argument] = value
            else:
                settings[table] = value
        try:
            return TrainingConfig.suited(**{**settings, ARGUMENTS: arguments})
        except ValueError as error:
            raise ValueError(f"grid: {in_words(values)}: {error}") from error


def read_sweep(path: str | Path) -> tuple[dict[str, Any], dict[str, Any], tuple[int, ...]]:
    """The settings of all trainings, the grid and the seeds of a file, for `Sweep`.

    Raises:
        ValueError: if it isn't such a file; the message names the place in it.
        OSError: if it can't be read.
    """
    known = {**setting_types(), "seeds": Sequence[int], "grid": Mapping[str, Any]}
    settings = fitting_values(read_toml(path), str(path), known)
    return settings, settings.pop("grid", {}), settings.pop("seeds", (0,))


def in_words(values: Mapping[str, Any]) -> str:
    """Values by name: "learning_rate = 0.001, network = wifi"."""
    return ", ".join(f"{short(name)} = {as_text(value)}" for name, value in values.items())


def short(name: str) -> str:
    """A setting's name, without the table that an argument of the environment is in."""
    return name.removeprefix(f"{ARGUMENTS}.")


def as_text(value: Any) -> str:
    """A value as `--set` and `--env` take it."""
    if isinstance(value, list | tuple) and not any(isinstance(each, list | tuple | dict) for each in value):
        return "+".join(as_text(each) for each in value)
    return value if isinstance(value, str) else json.dumps(value)


def _fitted(
    where: str, grid: Mapping[str, Any], known: Mapping[str, Any], fixed: Mapping[str, Any], prefix: str = ""
) -> dict[str, list[Any]]:
    found = {}
    for name, values in grid.items():
        fitting_values({name: None}, where, dict.fromkeys(known, type(None)))  # refuses unknown names
        if name in fixed:
            raise ValueError(f"{where}: {name}: it is set for all trainings, too, {name} = {fixed[name]!r}; choose one")
        found[f"{prefix}{name}"] = _values(f"{where}: {name}", values, known[name])
    return found


def _values(where: str, values: Any, kind: Any) -> list[Any]:
    """A list of values of one type."""
    if not isinstance(values, list | tuple):
        raise ValueError(f"{where}: expected a list of values to try, [{values!r}, ...]; got {values!r}")
    if not values:
        raise ValueError(f"{where}: the list is empty; name at least one value")
    found: list[Any] = []
    for value in values:
        try:
            fitted = fitting(value, kind)
        except MismatchError as error:
            raise ValueError(f"{where}: {error}; got {value!r} in the list") from error
        if fitted in found:
            raise ValueError(f"{where}: {value!r} is there twice")
        found.append(fitted)
    return found


def _name(values: Mapping[str, Any], seed: int) -> str:
    parts = [f"{short(name)}_{as_text(value)}" for name, value in values.items()]
    return "-".join(re.sub(r"[^\w.+-]+", "_", part).strip("._-") for part in [*parts, f"seed_{seed}"])
