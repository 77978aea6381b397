"""Scenarios as TOML files that people write and edit. `write_scenario` shows the format, with comments."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from dataclasses import MISSING, fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar, get_type_hints

import networkx as nx
import numpy as np

from khop_env.observers import Bound, Exponential, FloatArray, TargetObservers
from khop_env.physics import (
    DISTURBANCES,
    MODELS,
    AgentModel,
    Disturbance,
    Fleet,
    Sum,
    check_task_graph,
    did_you_mean,
    validate_graph,
)
from khop_env.scenarios.checked import REQUIRED, CheckedTable, ScenarioFileError, fits
from khop_env.scenarios.export import write_scenario
from khop_env.scenarios.scenario import Bounds, LawChoice, Scenario

__all__ = ["ScenarioFileError", "read_scenario", "write_scenario"]

_ABSENT: Any = object()
_Made = TypeVar("_Made")
_Edge = tuple[int, int]
_Numbers = float | tuple[float, ...]
_PerAgent = _Numbers | tuple[tuple[float, ...], ...]


def read_scenario(path: str | Path, *, laws: Iterable[str] | None = None) -> Scenario:
    """The scenario in a TOML file.

    Args:
        path: of the file.
        laws: names of the feedback laws there are, to refuse others; not checked if left out.

    Raises:
        ScenarioFileError: if it can't be read or describes no scenario: the message names the file and the key, what
            was got, what was expected, and the nearest valid name.
    """
    path = Path(path)
    try:
        root = CheckedTable(path, "", tomllib.loads(path.read_text(encoding="utf-8")))
    except OSError as error:
        raise ScenarioFileError(f"{path}: can't be read: {error.strerror}") from error
    except (tomllib.TOMLDecodeError, UnicodeDecodeError) as error:
        raise ScenarioFileError(f"{path}: not a TOML file: {error}") from error

    defaults = {field.name: field.default for field in fields(Scenario)}
    values: dict[str, Any] = {
        "name": root.take("name", str),
        "description": root.take("description", str, ""),
        "k": root.take("k", int),
        **{key: root.take(key, type(defaults[key]), defaults[key]) for key in ("relay", "duration", "dt", "order")},
    }
    if values["k"] < (2 if values["relay"] else 1):
        root.refuse("k", f"got {values['k']}, expected at least {'2' if values['relay'] else '1 (without relay)'}")
    if values["order"] not in (1, 2):
        root.refuse("order", f"got {values['order']}, expected 1 or 2")
    values |= _agents(root.tables("agents"))
    models = values["models"]
    types = {model.type: model.n for model in models}
    communication = _graph(root.table("communication"), len(models), lambda graph: validate_graph(graph, len(models)))
    values["communication"] = communication
    values["task"] = _graph(
        root.table("task"), len(models), lambda graph: check_task_graph(graph, communication, values["k"])
    )
    values["delta"] = _bounds(root.table("delta"), types, True)
    # types without an input observer need no theta
    values["theta"] = _bounds(root.table("theta"), types, False) if "theta" in root.names() else None
    with _refused_by(root, "agents"):
        fleet = Fleet(models)
    values["disturbance"] = _disturbance(root.tables("disturbance", []), fleet)
    values["law"] = _law(root.table("law", {"name": "tanh"}), laws)
    root.finish()
    with _refused_by(root, ""):
        return Scenario(**values)


@contextmanager
def _refused_by(table: CheckedTable, key: str) -> Iterator[None]:
    """Say where in the file the values stand that a constructor refuses."""
    try:
        yield
    except ScenarioFileError:
        raise
    except (ValueError, TypeError) as error:
        name = table.dotted(key) if key else table.key
        raise ScenarioFileError(f"{table.file}: {name + ': ' if name else ''}{error}") from error


def _agents(tables: list[CheckedTable]) -> dict[str, Any]:
    """Models, observers' options, centre and radius of the initial set, from the [[agents]] tables."""
    models: list[AgentModel] = []
    options: list[TargetObservers] = []
    some_options = False
    boxes: dict[str, list[FloatArray]] = {"center": [], "radius": []}
    for table in tables:
        make = MODELS[table.choice("model", MODELS)]
        count = table.take("count", int, 1)
        if count < 1:
            table.refuse("count", f"got {count}, expected at least 1")
        own = {"drift_known": table.take("drift_known", bool, None), "input": table.take("input_observer", bool, None)}
        for name, default in (("center", 0.0), ("radius", 1.0)):
            boxes[name].append(table.take(f"initial_{name}", _PerAgent, default))
        model = _build(table, make)
        for name in boxes:
            boxes[name][-1] = _per_state(table, f"initial_{name}", boxes[name][-1], count, model)
        some_options |= any(value is not None for value in own.values())
        option = TargetObservers(
            drift=True if own["drift_known"] is None else own["drift_known"],
            input_observer=not model.input_map_uses_state if own["input"] is None else own["input"],
        )
        models += [model] * count
        options += [option] * count
    return {
        "models": tuple(models),
        "observers": tuple(options) if some_options else None,
        **{name: np.concatenate(parts) for name, parts in boxes.items()},
    }


def _per_state(table: CheckedTable, key: str, value: Any, count: int, model: AgentModel) -> FloatArray:
    """(count * n,) from a number, one per state, or one list per agent."""
    try:
        values = np.asarray(value, dtype=float)
    except ValueError:  # rows of different lengths
        values = np.full((0, 0, 0), np.nan)
    if values.shape not in ((), (model.n,), (count, model.n)):
        table.refuse(
            key,
            f"got {_shape(values.shape)}, expected a number, {model.n} numbers (one for each of "
            f"{', '.join(model.states)}), or {count} lists of {model.n}, one for each agent",
        )
    if not np.all(np.isfinite(values)) or (key == "initial_radius" and np.any(values < 0.0)):
        table.refuse(
            key, f"got {value!r}, expected finite numbers{', none negative' if key == 'initial_radius' else ''}"
        )
    return np.broadcast_to(values, (count, model.n)).ravel()


def _shape(shape: tuple[int, ...]) -> str:
    return {1: "{} numbers", 2: "{} lists of {}"}.get(len(shape), "lists of different lengths").format(*shape)


def _graph(table: CheckedTable, agents: int, check: Callable[[nx.Graph], nx.Graph]) -> nx.Graph:
    edges = table.take("edges", tuple[Any, ...])
    table.finish()
    for i, edge in enumerate(edges):
        if not fits(edge, _Edge) or not all(0 <= agent < agents for agent in edge):
            got = list(edge) if isinstance(edge, tuple) else edge
            table.refuse(f"edges[{i}]", f"got {got!r}, expected two numbers of agents, integers from 0 to {agents - 1}")
        if edge[0] == edge[1]:
            table.refuse(f"edges[{i}]", f"got {list(edge)}, but an agent can't be its own neighbour; remove it")
    graph = nx.Graph()
    graph.add_nodes_from(range(agents))
    graph.add_edges_from(edges)
    with _refused_by(table, "edges"):
        return check(graph)


def _bounds(table: CheckedTable, types: dict[str, int], complete: bool) -> Bounds:
    """One exponential for all agents, or a bound for each type of agent."""
    if not any(key in types for key in table.names()):
        if not set(table.names()) & {"initial", "final", "rate"}:
            for key in table.names():
                table.refuse(key, f"unknown key; {did_you_mean(key, ['initial', 'final', 'rate', *types])}")
        return _exponentials(table, None)  # type: ignore[return-value]
    for kind in types:
        if complete and kind not in table.names():
            table.refuse(kind, f"missing; there are agents of type {kind!r}, and others have a bound")
    found = {kind: _exponentials(table.table(kind), n) for kind, n in types.items() if kind in table.names()}
    table.finish()
    return found


def _exponentials(table: CheckedTable, components: int | None) -> Bound:
    """One exponential, or one per state component where a value is a list."""
    expected = float if components is None else _Numbers
    values = {name: table.take(name, expected) for name in ("initial", "final", "rate")}
    table.finish()
    for name, value in values.items():
        if isinstance(value, tuple) and len(value) != components:
            table.refuse(name, f"got {len(value)} numbers, expected one, or {components}: one per state component")
    with _refused_by(table, ""):
        if not any(isinstance(value, tuple) for value in values.values()):
            return Exponential(**{name: float(value) for name, value in values.items()})
        rows = np.broadcast_arrays(*(np.asarray(value, dtype=float) for value in values.values()))
        return tuple(Exponential(*row) for row in np.stack(rows, axis=-1).tolist())


def _disturbance(tables: list[CheckedTable], fleet: Fleet) -> Disturbance | None:
    terms = []
    for table in tables:
        term = _build(table, DISTURBANCES[table.choice("kind", DISTURBANCES)])
        with _refused_by(table, ""):
            term.attach(fleet)
        terms.append(term)
    return terms[0] if len(terms) == 1 else Sum(tuple(terms)) if terms else None


def _law(table: CheckedTable, laws: Iterable[str] | None) -> LawChoice:
    name = table.take("name", str) if laws is None else table.choice("name", laws)
    return LawChoice(name, table.rest())


def _build(table: CheckedTable, make: type[_Made]) -> _Made:
    """An object of a dataclass from the table's remaining keys, which must be its fields."""
    known: Any = make
    if not is_dataclass(known):
        table.refuse("", f"{make!r} isn't a dataclass, so that its parameters can't be read from a file")
    hints = get_type_hints(make) | {"input_limit": _Numbers}
    values = {}
    for field in fields(known):
        if not field.init:
            continue
        value = table.take(field.name, hints[field.name], REQUIRED if field.default is MISSING else _ABSENT)
        if value is not _ABSENT:
            values[field.name] = value
    table.finish()
    with _refused_by(table, ""):
        return make(**values)
