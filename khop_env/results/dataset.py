"""A folder of recorded episodes: Parquet files, and `dataset.json`, which says what they are."""

from __future__ import annotations

import dataclasses
import json
import math
import os
from collections.abc import Mapping, Sequence
from importlib.metadata import version
from pathlib import Path
from typing import Any

import khop_env
from khop_env.env import BatchedEnv, Settings
from khop_env.env.actuators import ACTUATORS
from khop_env.network import NO_NETWORK
from khop_env.observers import Networked
from khop_env.results.data_columns import ESTIMATE_COLUMNS, DataColumn, merged, step_columns
from khop_env.results.episodes import Part, network_in_words

DESCRIPTION = "dataset.json"
TABLES = ("steps", "estimates")
LICENCE = "MIT, as khop_env, unless its author chooses another"


class EpisodeDataset:
    """Writes a new folder of recorded episodes, a file for each table and batch of episodes.

    Args:
        folder: made if it doesn't exist.
        command: that makes it, for `dataset.json`.
        scenario: as `khop_env.make` takes it, where that isn't the scenario's name.

    Attributes:
        folder: as given.
        columns: of the table of steps, once begun.
        rows: number of rows written, by table.

    Raises:
        ValueError: if there is something in the folder.
    """

    def __init__(self, folder: str | Path, *, command: str = "", scenario: str | None = None) -> None:
        self.folder, self.columns, self.rows = Path(folder), dict[str, DataColumn](), dict.fromkeys(TABLES, 0)
        self._about: dict[str, Any] = {"command": command, "licence": LICENCE}
        self._scenario, self._seeds = scenario, list[int]()
        if self.folder.exists() and (not self.folder.is_dir() or any(self.folder.iterdir())):
            raise ValueError(
                f"{folder} isn't an empty folder, and a recording overwrites nothing: name a new folder, or delete it"
            )

    def __repr__(self) -> str:
        return f"EpisodeDataset({str(self.folder)!r}, {self.rows})"

    def begin(
        self, environment: str, played: Sequence[tuple[str, str | None, BatchedEnv]], seeds: Sequence[int]
    ) -> None:
        """Make the folder, and write `dataset.json`.

        Args:
            environment: as `khop_env.make` takes it.
            played: policy, name of the network or None, and environment of everything that will be played.
            seeds: one per episode, the same for all.

        Raises:
            OSError: if the folder can't be made.
        """
        every = [step_columns(env) for *_, env in {id(env): (env,) for *_, env in played}.values()]
        known = {name: column for columns in every for name, column in columns.items()}
        self.columns = {name: known[name] for name in merged(tuple(columns) for columns in every)}
        layouts: dict[tuple[str, ...], int] = {}
        evaluations = []
        for policy, network, env in played:
            observers = env.simulator.observers
            over = observers if isinstance(observers, Networked) else None
            evaluations.append(
                {
                    "policy": policy,
                    "observe": env.settings.observe,
                    "network": network or network_in_words(env),
                    "estimator": None if over is None else over.estimator.name,
                    "bound": env.simulator.error_bounds().basis,
                    "arguments": arguments(env),
                    "observations": {
                        layout.agent: layouts.setdefault(layout.names, len(layouts)) for layout in env.layouts
                    },
                }
            )
        env = played[0][2]
        self._about |= {
            "khop_env": khop_env.__version__,
            "libraries": {name: version(name) for name in ("numpy", "numba", "polars")},
            "environment": environment,
            "scenario": self._scenario or env.scenario,
            "control_period": env.settings.control_period,
            "seeds": [int(seed) for seed in seeds],
            "agents": agents(env),
            "evaluations": evaluations,
            "layouts": [list(names) for names in layouts],
            "columns": {
                name: {column: described._asdict() for column, described in columns.items()}
                for name, columns in zip(TABLES, (self.columns, ESTIMATE_COLUMNS), strict=True)
            },
        }
        for name in TABLES:
            (self.folder / name).mkdir(parents=True, exist_ok=True)
        self.finish(complete=False)

    def write(self, number: int, parts: Sequence[Part]) -> None:
        """Write a batch of episodes; each file appears when it is whole.

        Args:
            number: of the batch, by which files are named and sorted.
            parts: as `EpisodeRecorder.end` returns them.

        Raises:
            OSError: if a file can't be written.
        """
        for name in TABLES:
            own = [part for part in parts if part.table == name]
            for q, part in enumerate(own):
                suffix = f"-{q:03d}" if len(own) > 1 else ""
                _write(self.folder / name / f"{number:05d}{suffix}.parquet", part.data)
                self.rows[name] += part.rows
        self.finish(complete=False)

    def finish(self, complete: bool = True) -> None:
        """Write the numbers of rows into `dataset.json`, which has those of all batches until now in any case.

        Args:
            complete: whether everything that was planned is there.
        """
        about = {**self._about, "complete": complete, "rows": self.rows}
        text = json.dumps(about, indent=1, allow_nan=False, default=repr) + "\n"
        _write(self.folder / DESCRIPTION, text.encode())

    def size(self) -> int:
        """Bytes of all files."""
        return sum(path.stat().st_size for path in self.folder.rglob("*") if path.is_file())


def agents(env: BatchedEnv) -> dict[str, Any]:
    """Type, states and inputs of every agent, with their units and limits."""
    return {
        name: {
            "type": model.type,
            "acts": name in env.agents,
            "states": dict(model.states),
            "inputs": {
                entry: {"unit": unit, "limit": limit if math.isfinite(limit) else None}
                for (entry, unit), limit in zip(model.inputs.items(), model.input_limit.tolist(), strict=True)
            },
        }
        for name, model in zip(env.fleet.ids, env.fleet.models, strict=True)
    }


def arguments(env: BatchedEnv) -> dict[str, Any]:
    """The arguments of `khop_env.make` that aren't the defaults, objects in words."""
    found: dict[str, Any] = {}
    for values, defaults in ((env.settings, Settings()), (env.task, type(env.task))):
        for each in dataclasses.fields(values) if dataclasses.is_dataclass(values) else ():
            value = getattr(values, each.name)
            default = env.task.defaults.get(each.name, getattr(defaults, each.name, dataclasses.MISSING))
            if each.init and repr(value) != repr(default):  # of arrays, too
                found[each.name] = _plain(each.name, value)
    if not isinstance(env.simulator.observers, Networked):
        found["network"] = NO_NETWORK  # the scenario may have one
    return found


def _plain(name: str, value: Any) -> Any:
    """As JSON, and as the environment takes it where that is possible."""
    if name == "actuator":
        return next((known for known, kind in ACTUATORS.items() if kind() == value), repr(value))
    if name == "estimator":
        return getattr(value, "name", value)
    if name == "network" and dataclasses.is_dataclass(value) and not isinstance(value, type):
        return dataclasses.asdict(value)
    if isinstance(value, float) and not math.isfinite(value):
        return repr(value)
    return dict(value) if isinstance(value, Mapping) else list(value) if isinstance(value, tuple) else value


def _write(path: Path, data: bytes) -> None:
    """Replace a file as a whole."""
    temporary = path.with_name(f".{path.name}")
    try:
        temporary.write_bytes(data)
        os.replace(temporary, path)
    finally:
        temporary.unlink(missing_ok=True)
