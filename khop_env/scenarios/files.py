"""Scenarios as TOML files. `write_scenario` writes the format, with comments."""

from __future__ import annotations

import tomllib
from collections.abc import Callable, Iterable, Mapping
from dataclasses import MISSING, dataclass, fields, is_dataclass
from pathlib import Path
from typing import Any, Literal, TypeVar, get_type_hints

import networkx as nx
import numpy as np

from khop_env.observers import Bound, DesignError, DesignRule, Exponential, FloatArray, TargetObservers
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
from khop_env.scenarios.arena_table import read_arena
from khop_env.scenarios.checked import REQUIRED, CheckedTable, NotedError, ScenarioFileError, abbreviated, fits
from khop_env.scenarios.export import write_scenario
from khop_env.scenarios.network_table import read_network
from khop_env.scenarios.scenario import MOST_AGENTS, Bounds, LawChoice, Scenario
from khop_env.scenarios.schedules import read_schedule

__all__ = ["ScenarioFileError", "read_scenario", "write_scenario"]

AUTO = "auto"
"""Value of `initial` for a bound that is sized from the initial set, by `Scenario.sized`."""

_LARGEST_FILE = 2**26  # bytes
_EXPONENTIAL = {"initial", "final", "rate"}
_ABSENT: Any = object()
_Made = TypeVar("_Made")
_Edge = tuple[int, int]
_Auto = Literal["auto"]
_Numbers = float | tuple[float, ...]
_PerAgent = _Numbers | tuple[tuple[float, ...], ...]


def read_scenario(path: str | Path, *, laws: Iterable[str] | None = None) -> Scenario:
    """The scenario in a TOML file.

    Args:
        path: of the file.
        laws: names of the known feedback laws; not checked if left out.

    Raises:
        ScenarioFileError: if it can't be read or describes no scenario: the message has file and key, the
            value, the expected value, and the closest valid name.
    """
    path = Path(path)
    try:
        if path.stat().st_size > _LARGEST_FILE:
            raise ScenarioFileError(f"{path}: has {path.stat().st_size} bytes; {_LARGEST_FILE} at most")
        root = CheckedTable(path, "", tomllib.loads(path.read_text(encoding="utf-8")))
        return _scenario(root, laws)
    except OSError as error:
        raise ScenarioFileError(f"{path}: can't be read: {error.strerror}") from error
    except ScenarioFileError:
        raise
    except RecursionError:
        raise ScenarioFileError(f"{path}: lists or tables are nested too deeply") from None
    except ValueError as error:  # of tomllib, or of Python for an integer of thousands of digits
        raise ScenarioFileError(f"{path}: not a TOML file: {error}") from error


def _scenario(root: CheckedTable, laws: Iterable[str] | None) -> Scenario:
    defaults = {field.name: field.default for field in fields(Scenario)}
    values: dict[str, Any] = {
        "name": root.take("name", str),
        "description": root.take("description", str, ""),
        "k": root.take("k", int),
        "design_rule": root.take("design_rule", DesignRule, None),
        **{key: root.take(key, type(defaults[key]), defaults[key]) for key in ("relay", "duration", "dt", "order")},
        "figure_agent": root.take("figure_agent", int, None),
    }
    k = values["k"]
    if k is not REQUIRED and k < (2 if values["relay"] else 1):
        root.note("k", f"got {k}, expected at least {'2' if values['relay'] else '1 (without relay)'}")
        k = REQUIRED
    if values["order"] not in (1, 2):
        root.note("order", f"got {values['order']}, expected 1, 2 or 3")
    with root.gathering():
        values |= _agents(root.tables("agents"))
    tables = {name: root.table(name) for name in ("communication", "task", "delta")}
    theta = root.table("theta") if "theta" in root.names() else None
    with root.gathering():
        disturbances = root.tables("disturbance", [])
    with root.gathering():
        values["schedule"] = read_schedule(root.tables("schedule", []))
    with root.gathering():
        values["law"] = _law(root.table("law", {"name": "tanh"}), laws)
    if "network" in root.names():
        with root.gathering():
            values |= read_network(root.table("network"))
    if "arena" in root.names():
        with root.gathering():
            values["arena"] = read_arena(root.table("arena"))
    if "models" not in values:  # most of what is below can't be read without models
        for table in (tables["delta"], theta):
            if table is not None and set(table.names()) & _EXPONENTIAL:  # one for all agents
                with root.gathering():
                    _exponentials(table, None, set())
        with root.gathering():
            root.finish()
        root.raise_mistakes()

    models, auto = values["models"], set[tuple[str, str | None]]()
    types = {model.type: model.n for model in models}
    with root.gathering():
        values["communication"] = _graph(
            tables["communication"],
            len(models),
            lambda graph, agents: validate_graph(graph, agents, directed=True),
            may_be_directed=True,
        )
    with root.gathering():
        communication = values.get("communication")
        known = communication is not None and k is not REQUIRED  # otherwise hop distances can't be checked
        values["task"] = _graph(
            tables["task"], len(models), lambda graph, _: check_task_graph(graph, communication, k) if known else graph
        )
    for name, table in (("delta", tables["delta"]), ("theta", theta)):
        with root.gathering():  # types without an input observer need no theta
            values[name] = None if table is None else _bounds(table, types, name == "delta", auto)
    with root.gathering():
        with root.built("agents"):
            fleet = Fleet(models)
        values["disturbance"] = _disturbance(disturbances, fleet)
        for name, kind in sorted(auto, key=str):
            _require_known_start(root, fleet, name, kind)
    with root.gathering():
        root.finish()
    root.raise_mistakes()
    with root.gathering(), root.built():
        scenario = Scenario(**values)
        return _sized(scenario, auto)
    root.raise_mistakes()
    raise AssertionError  # `built` notes a mistake before it stops


def _sized(scenario: Scenario, auto: set[tuple[str, str | None]]) -> Scenario:
    """The scenario with the bounds in `auto`, (name, agent type or None), sized from the initial set."""
    if not auto:
        return scenario
    try:
        sized = scenario.sized()
    except DesignError:  # raised again when it is built or checked, as for any other design
        return scenario
    changes: dict[str, Any] = {}
    for name in {name for name, _ in auto}:
        bounds, wide = getattr(scenario, name), getattr(sized, name)
        changes[name] = (
            {kind: wide[kind] if (name, kind) in auto else bound for kind, bound in bounds.items()}
            if isinstance(bounds, Mapping)
            else wide
        )
    return scenario.replace(**changes)


def _require_known_start(root: CheckedTable, fleet: Fleet, name: str, kind: str | None) -> None:
    """Refuse to size theta(0) where g is unbounded."""
    for i, model in enumerate(fleet.models):
        if name == "theta" and kind in (None, model.type) and not model.input_map_bounded:
            root.note(
                f"{name}.{kind}.initial" if kind else f"{name}.initial",
                f'got "{AUTO}", but the inputs of {fleet.ids[i]!r} have no limit that would bound g; give a number',
            )
            return


@dataclass(frozen=True)
class _Group:
    """One [[agents]] table."""

    model: AgentModel
    count: int
    observers: TargetObservers | None
    center: FloatArray
    radius: FloatArray


def _agents(tables: list[CheckedTable]) -> dict[str, Any]:
    """Models, observers' options, centre and radius of the initial set, from the [[agents]] tables."""
    groups: list[_Group] = []
    for table in tables:
        with table.gathering():
            groups.append(_group(table, MOST_AGENTS - sum(group.count for group in groups)))
    if len(groups) < len(tables):
        raise NotedError
    some_options = any(group.observers is not None for group in groups)
    return {
        "models": tuple(group.model for group in groups for _ in range(group.count)),
        "observers": tuple(
            group.observers or TargetObservers(input_observer=not group.model.input_map_uses_state)
            for group in groups
            for _ in range(group.count)
        )
        if some_options
        else None,
        "center": np.concatenate([group.center for group in groups]),
        "radius": np.concatenate([group.radius for group in groups]),
    }


def _group(table: CheckedTable, room: int) -> _Group:
    make = MODELS[table.choice("model", MODELS)]
    count = table.take("count", int, 1)
    if not 1 <= count <= room:
        table.note("count", f"got {count}, expected at least 1" + f", and at most {room}" * (count > 0))
    drift, observer = (table.take(key, bool, None) for key in ("drift_known", "input_observer"))
    boxes = [
        (key, table.take(key, _PerAgent, default))
        for key, default in (("initial_center", 0.0), ("initial_radius", 1.0))
    ]
    model = _build(table, make)
    center, radius = (_per_state(table, key, value, count, model) for key, value in boxes)
    observers = None
    if drift is not None or observer is not None:
        observers = TargetObservers(
            drift=drift is not False,
            input_observer=not model.input_map_uses_state if observer is None else observer,
        )
    return _Group(model, count, observers, center, radius)


def _per_state(table: CheckedTable, key: str, value: Any, count: int, model: AgentModel) -> FloatArray:
    """(count * n,) from a number, one per state, or one list per agent."""
    try:
        values = np.asarray(value, dtype=float)
    except (ValueError, TypeError):  # rows of different lengths
        values = np.full((0, 0, 0), np.nan)
    if values.shape not in ((), (model.n,), (count, model.n)):
        table.refuse(
            key,
            f"got {_shape(values.shape)}, expected a number, {model.n} numbers (one for each of "
            f"{', '.join(model.states)}), or {count} lists of {model.n}, one for each agent",
        )
    if not np.all(np.isfinite(values)) or (key == "initial_radius" and np.any(values < 0.0)):
        table.refuse(
            key,
            f"got {abbreviated(value)}, expected finite numbers{', none negative' if key == 'initial_radius' else ''}",
        )
    return np.broadcast_to(values, (count, model.n)).ravel()


def _shape(shape: tuple[int, ...]) -> str:
    return {1: "{} numbers", 2: "{} lists of {}"}.get(len(shape), "lists of different lengths").format(*shape)


def _graph(
    table: CheckedTable, agents: int, check: Callable[[nx.Graph, int], nx.Graph], may_be_directed: bool = False
) -> nx.Graph:
    edges = table.take("edges", tuple[Any, ...])
    edges = () if edges is REQUIRED else edges
    for i, edge in enumerate(edges):
        if not fits(edge, _Edge) or not all(0 <= agent < agents for agent in edge):
            table.note(
                f"edges[{i}]",
                f"got {abbreviated(edge)}, expected two numbers of agents, integers from 0 to {agents - 1}",
            )
        elif edge[0] == edge[1]:
            table.note(f"edges[{i}]", f"got {list(edge)}, but an agent can't be its own neighbour; remove it")
    directed = may_be_directed and table.take("directed", bool, False)
    table.finish()
    graph = nx.DiGraph() if directed else nx.Graph()
    graph.add_nodes_from(range(agents))
    graph.add_edges_from(edges)
    with table.built("edges"):
        return check(graph, agents)
    raise AssertionError


def _bounds(table: CheckedTable, types: dict[str, int], complete: bool, auto: set[tuple[str, str | None]]) -> Bounds:
    """One exponential for all agents, or a bound for each type of agent; `auto` gets those to be sized."""
    if not any(key in types for key in table.names()):
        if not set(table.names()) & _EXPONENTIAL:
            for key in table.names():
                table.refuse(key, f"unknown key; {did_you_mean(key, ['initial', 'final', 'rate', *types])}")
        return _exponentials(table, None, auto)  # type: ignore[return-value]
    found: dict[str, Bound] = {}
    for kind, n in types.items():
        if kind in table.names():
            with table.gathering():
                found[kind] = _exponentials(table.table(kind), n, auto)
        elif complete:
            table.note(kind, f"missing; there are agents of type {kind!r}, and others have a bound")
    table.finish()
    return found


def _exponentials(table: CheckedTable, components: int | None, auto: set[tuple[str, str | None]]) -> Bound:
    """One exponential, or one per state component where a value is a list."""
    expected: Any = float if components is None else _Numbers
    values = {name: table.take(name, expected) for name in ("final", "rate")}
    values["initial"] = table.take("initial", expected | _Auto)
    table.finish()
    if values["initial"] == AUTO:
        auto.add((table.key.partition(".")[0], table.key.partition(".")[2] or None))
        values["initial"] = values["final"]
    for name, value in values.items():
        if isinstance(value, tuple) and len(value) != components:
            table.refuse(name, f"got {len(value)} numbers, expected one, or {components}: one per state component")
    with table.built():
        if not any(isinstance(value, tuple) for value in values.values()):
            return Exponential(**{name: float(value) for name, value in values.items()})
        names = ("initial", "final", "rate")
        rows = np.broadcast_arrays(*(np.asarray(values[name], dtype=float) for name in names))
        return tuple(Exponential(*row) for row in np.stack(rows, axis=-1).tolist())
    raise AssertionError


def _disturbance(tables: list[CheckedTable], fleet: Fleet) -> Disturbance | None:
    terms = []
    for table in tables:
        with table.gathering():
            term = _build(table, DISTURBANCES[table.choice("kind", DISTURBANCES)])
            with table.built():
                term.attach(fleet)
            terms.append(term)
    return terms[0] if len(terms) == 1 else Sum(tuple(terms)) if terms else None


def _law(table: CheckedTable, laws: Iterable[str] | None) -> LawChoice:
    name = table.take("name", str) if laws is None else table.choice("name", laws)
    parameters = table.rest()
    table.finish()
    return LawChoice(name, parameters)


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
    with table.built():
        return make(**values)
    raise AssertionError
