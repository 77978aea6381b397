"""Episodes of an environment as two tidy tables: what each agent did at each step, and what it estimated."""

from __future__ import annotations

import io
from collections.abc import Mapping, Sequence
from typing import TYPE_CHECKING, Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from khop_env.env import BatchedEnv
from khop_env.env.layout import Float32Array
from khop_env.env.readout import AGE, HEARD, HOPS, VALID, summarize
from khop_env.env.state import SHARED_INFOS, Step
from khop_env.network import NO_NETWORK
from khop_env.observers import Networked
from khop_env.physics import hops_from_targets
from khop_env.results.data_columns import KEYS, DataColumn, quantities, step_columns
from khop_env.simulation.received import links_up

if TYPE_CHECKING:
    import polars as pl

MOST_NUMBERS = 20_000_000
"""Numbers that are held in memory before they become a part of the tables (160 MB)."""

Array = NDArray[Any]
_DTYPES = {"Float64": np.float64, "Float32": np.float32, "Boolean": np.bool_}


class Part(NamedTuple):
    """Rows of a table.

    Attributes:
        table: "steps" or "estimates".
        rows: their number.
        data: them as a Parquet file.
    """

    table: str
    rows: int
    data: bytes


def network_in_words(env: BatchedEnv) -> str:
    """The network over which an environment's agents exchange messages; "none" for continuous exchange."""
    observers = env.simulator.observers
    return observers.network.described() if isinstance(observers, Networked) else NO_NETWORK


class EpisodeRecorder:
    """Turns the episodes of a `BatchedEnv`, as they are played, into rows of the two tables.

        recorder = EpisodeRecorder(env, "my policy")
        observations, infos = env.reset(seeds)
        recorder.begin(seeds, observations)
        ...
        step = env.step(actions)
        recorder.add(actions, step)          # before environments that have ended are reset
        ...
        parts = recorder.end()               # Parquet files in memory

    Only reads; the first len(seeds) environments are recorded, each until its episode ends.

    Args:
        env: the environment.
        policy: name of what acts.
        network: name of the network; in words by default.
        columns: of the table of steps; those that the environment doesn't have are null. Its own by default.
    """

    def __init__(
        self, env: BatchedEnv, policy: str, network: str | None = None, columns: Mapping[str, DataColumn] | None = None
    ) -> None:
        self._env, observers = env, env.simulator.observers
        self._labels = (policy, env.settings.observe, network or network_in_words(env), env.scenario)
        self._columns = dict(columns or step_columns(env))
        self._places: dict[str, tuple[str, list[int], list[int]]] = {}
        for each in quantities(env):
            _, agents, places = self._places.setdefault(each.name, (each.source, [], []))
            agents.append(each.agent)
            places.append(each.column)
        layout, design = observers.layout, env.simulator.design
        pairs = list(zip(layout.pair_target.tolist(), layout.observer.tolist(), strict=True))
        hops = hops_from_targets(design.communication, design.k)
        self._hops = np.array([hops[a][i] for i, a in pairs], float)
        self._link = np.array([design.links.index.get(pair, -1) for pair in pairs], np.int64)
        self._rows: list[dict[str, Array]] = []
        self._results: list[dict[str, Array]] = []
        self._parts: list[Part] = []

    def begin(self, seeds: Sequence[int], observations: Float32Array) -> None:
        """Begin the episodes of the first len(seeds) environments, which have just been reset."""
        self._seeds, self._running = np.array(seeds, np.int64), np.ones(len(seeds), np.bool_)
        self._first, self._rows, self._results, self._parts = 0, [], [], []
        self._take(observations, self._running)

    def add(self, actions: Array, step: Step) -> None:
        """Add a control period.

        Args:
            actions: (B, N, m) or (B, A) of all agents, side by side, as the policy gave them.
            step: what the environment's `step` returned for them.
        """
        observations, reward, terminated, truncated, infos = step
        count, running = len(self._seeds), self._running
        values = {"reward": reward, "terminated": terminated[:, None], "truncated": truncated[:, None]}
        values |= {f"info.{name}": each for name, each in infos.items() if name not in SHARED_INFOS}
        values |= {"action": actions.reshape(len(actions), -1), "u": self._env.simulator.u}
        self._results.append({name: np.array(each[:count]) for name, each in values.items()})
        self._results[-1]["running"] = running
        self._last = self._results[-1]
        self._running = running & ~(terminated | truncated)[:count]
        self._take(observations, running)
        if len(self._rows) * sum(each.size for each in self._rows[-1].values()) > MOST_NUMBERS:
            self._write(len(self._results))

    def end(self) -> list[Part]:
        """The tables of these episodes, in parts; rows by seed, step, and agent or pair of the layout."""
        self._results.append({name: np.zeros_like(each) for name, each in self._last.items()})
        self._write(len(self._rows))
        return self._parts

    def _take(self, observations: Float32Array, exists: Array) -> None:
        """What there is before the next action; rows of environments whose episode is over don't exist."""
        env, count = self._env, len(self._seeds)
        simulator, observers = env.simulator, env.simulator.observers
        state, pairs = simulator.state, observers.layout.pairs
        known = np.zeros((4, pairs, env.num_envs))
        if observers.by_messages:
            information = observers.information(state)
            out = known.reshape(-1, env.num_envs)
            summarize(*information, state.t, out, env.settings.control_period, 0, env.num_envs)
            known[AGE] = information.age
        else:
            up = links_up(simulator.design, observers, state)
            known[HEARD] = np.where(self._link[:, None] < 0, 0.0, up[self._link] if len(up) else 0.0)
            known[VALID], known[HOPS] = 1.0, self._hops[:, None]
        values = {
            "time": state.t[:, None],
            "x": state.x.T,
            "obs": observations.reshape(len(observations), -1),
            "estimate": state.memory["estimate"].T,
            "bound": simulator.error_bounds().bound.T,
            **{name: known[row].T for name, row in (("age", AGE), ("hops", HOPS), ("heard", HEARD), ("valid", VALID))},
        }
        self._rows.append({name: np.array(each[:count]) for name, each in values.items()})
        self._rows[-1]["exists"] = exists

    def _write(self, count: int) -> None:
        """The next `count` steps become parts of the tables."""
        taken, results = self._rows[:count], self._results[:count]
        exists = np.array([each["exists"] for each in taken]).T  # (E, S)
        if exists.any():
            flat = {
                name: np.array([each[name] for each in steps]).swapaxes(0, 1)[exists]
                for steps in (taken, results)
                for name in steps[0]
            }
            steps = np.broadcast_to(np.arange(self._first, self._first + count), exists.shape)[exists]
            seeds = np.broadcast_to(self._seeds[:, None], exists.shape)[exists]
            for name, frame in (("steps", self._steps), ("estimates", self._estimates)):
                table, file = frame(flat, seeds, steps), io.BytesIO()
                table.write_parquet(file, compression="zstd", compression_level=9)
                self._parts.append(Part(name, table.height, file.getvalue()))
        self._rows, self._results, self._first = self._rows[count:], self._results[count:], self._first + count

    def _keys(self, flat: Mapping[str, Array], seeds: Array, steps: Array, width: int) -> dict[str, Any]:
        rows = len(seeds) * width
        keys = {name: _labels([label], np.zeros(rows)) for name, label in zip(KEYS, self._labels, strict=False)}
        times = {"seed": seeds, "step": steps.astype(np.int32), "time": flat["time"][:, 0]}
        return keys | {name: np.repeat(values, width) for name, values in times.items()}

    def _steps(self, flat: Mapping[str, Array], seeds: Array, steps: Array) -> pl.DataFrame:
        import polars as pl

        fleet, acted = self._env.fleet, flat["running"]
        shape = len(seeds), len(fleet)
        who = np.broadcast_to(np.arange(len(fleet)), shape).ravel()
        columns = self._keys(flat, seeds, steps, len(fleet))
        columns |= {"agent": _labels(fleet.ids, who), "type": _labels([model.type for model in fleet.models], who)}
        masks: dict[bytes, pl.Series] = {}
        for name, column in self._columns.items():
            if name in columns:
                continue
            dtype = getattr(pl, column.dtype)
            if name not in self._places:
                columns[name] = pl.Series(name, [None], dtype).new_from_index(0, shape[0] * shape[1])
                continue
            source, agents, places = self._places[name]
            values: Array = np.zeros(shape, _DTYPES[column.dtype])
            present = np.zeros(shape, np.bool_)
            values[:, agents] = flat[source][:, places]
            present[:, agents] = acted[:, None] if source not in ("x", "obs") else True
            series = pl.Series(name, values.ravel())
            if not present.all():
                mask = masks.setdefault(present.tobytes(), pl.Series(present.ravel()))
                series = series.zip_with(mask, pl.Series(name, [None], dtype).new_from_index(0, len(series)))
            columns[name] = series
        return pl.DataFrame(columns).select(list(self._columns))

    def _estimates(self, flat: Mapping[str, Array], seeds: Array, steps: Array) -> pl.DataFrame:
        import polars as pl

        fleet, layout, rows = self._env.fleet, self._env.simulator.observers.layout, len(seeds)
        components, source, pair = fleet.component_names(), layout.column_source, layout.column_pair
        columns = self._keys(flat, seeds, steps, layout.size)
        every = np.tile(np.arange(layout.size), rows)
        columns |= {
            "observer": _labels([fleet.ids[i] for i in layout.observer[pair]], every),
            "target": _labels([components[c][0] for c in source], every),
            "component": _labels([components[c][1] for c in source], every),
            "state": flat["x"][:, source].ravel(),
            "estimate": flat["estimate"].ravel(),
            "bound": flat["bound"].ravel(),
            **{name: flat[name][:, pair].ravel() for name in ("age", "hops", "heard", "valid")},
        }
        of_others = {"hops": pl.Int32, "heard": pl.Boolean, "valid": pl.Boolean}
        return pl.DataFrame(columns).with_columns(pl.col(name).cast(kind) for name, kind in of_others.items())


def _labels(values: Sequence[str], places: Array) -> pl.Series:
    """Of each place its value, as categories: a few bytes a row instead of a string."""
    import polars as pl

    return pl.Series(values, dtype=pl.Categorical).gather(places.astype(np.uint32))
