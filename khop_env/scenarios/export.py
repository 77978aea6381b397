"""A scenario as a TOML file with comments, to edit; `khop_env.scenarios.files` reads it back."""

from __future__ import annotations

import re
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import fields
from typing import Any

import networkx as nx
import numpy as np
import tomlkit
from tomlkit.items import Array, Table

from khop_env.network import PROFILES, SCHEDULES
from khop_env.observers import ESTIMATORS, Bound, Exponential
from khop_env.observers.design import design_rule_for
from khop_env.physics import DISTURBANCES, MODELS, AgentModel, Term
from khop_env.scenarios.arena_table import write_arena
from khop_env.scenarios.network_table import write_network
from khop_env.scenarios.scenario import Scenario
from khop_env.scenarios.schedules import schedule_table

_EDGES_A_LINE = 10


def write_scenario(scenario: Scenario) -> str:
    """The scenario as the text of a TOML file, with a comment on every section.

    Raises:
        ValueError: if it has an agent model, disturbance or performance function of the user's own, which a file
            can't represent.
    """
    document = tomlkit.document()
    for line in (
        f"A scenario for khop_env. Edit it, then: khop check {scenario.name}.toml, khop run {scenario.name}.toml",
        "Lengths in m, angles in rad, times in s. Agents are numbered from 0, in the order of the [[agents]] tables.",
    ):
        document.add(tomlkit.comment(line))
    for name, comment in (
        ("name", None),
        ("description", None),
        ("k", "agents up to k hops away are estimated"),
        ("relay", "whether agents relay their neighbours' states (Assumption 4)"),
        ("design_rule", "from delta to the funnels: paper, or sharp for the widest ones"),
        ("duration", "s"),
        ("dt", "s, step of the proximal integrator"),
        ("order", "its order, 1, 2 or 3"),
        ("figure_agent", "index of the agent whose estimates figures show"),
    ):
        content = getattr(scenario, name)
        if name == "design_rule":
            content = design_rule_for(scenario.communication, content)
        if content is not None:
            value = tomlkit.item(_plain(content))
            document.add(name, value.comment(comment) if comment else value)

    agents = tomlkit.aot()
    for first, stop in _runs(scenario):
        agents.append(_agents(scenario, first, stop))
    _section(
        document,
        "agents",
        agents,
        "The agents: each table adds `count` of one model, with its parameters. They start anywhere within",
        "initial_radius of initial_center: a number, one per state, or a list of these, one for each agent.",
        "drift_known = false: its observers don't use f (Theorem 2). input_observer = false: they don't estimate g.",
        f"Models: {', '.join(MODELS)}.",
    )
    _section(
        document,
        "communication",
        _edges(scenario.communication),
        "The communication graph, which must be connected: an edge joins two neighbours. With directed = true an edge",
        "[b, a] is a link that goes one way: agent a hears agent b.",
    )
    if scenario.schedule is not None:
        parts = tomlkit.aot()
        for part in scenario.schedule.parts:
            parts.append(schedule_table(part))
        _section(
            document,
            "schedule",
            parts,
            "Links that come and go: a link is up where it is up in all of these. The communication graph has all that",
            "may ever be up. A pair [low, high] is a range, from which each episode draws.",
            f"Kinds: {', '.join(SCHEDULES)}.",
        )
    _section(
        document,
        "task",
        _edges(scenario.task),
        "The task graph: pairs of agents that should agree, within k hops of each other.",
    )
    _section(
        document,
        "delta",
        _bounds(scenario, scenario.delta, "delta"),
        "Bounds on the state estimation errors: (initial - final) exp(-rate t) + final. For different bounds per type",
        "of agent write [delta.TYPE] tables; values there may be lists, one for each state.",
        'initial = "auto" starts 25 % above what the initial set needs (khop check shows the number).',
    )
    if scenario.theta is not None:
        bounds = _bounds(scenario, scenario.theta, "theta")
        _section(document, "theta", bounds, "Bounds on the input estimation errors, where there are input observers.")
    if scenario.disturbance is not None and scenario.disturbance.terms:
        terms = tomlkit.aot()
        for term in scenario.disturbance.terms:
            terms.append(_disturbance(term))
        _section(
            document,
            "disturbance",
            terms,
            f"Disturbances, which add up. Kinds: {', '.join(DISTURBANCES)}. amplitude bounds each component of |w|, in",
            'state units per s. agents = "TYPE", an id like "TYPE_0", or a list of these, picks those that it acts on.',
        )
    if (network := write_network(scenario)) is not None:
        _section(
            document,
            "network",
            network,
            "Messages: every agent sends one each period; each link loses it, or delivers it with a delay. Instead of",
            f"numbers, or beside them: profile = one of {', '.join(PROFILES)}.",
            f"Estimators: {', '.join(ESTIMATORS)}. Without this table exchange is continuous.",
        )
    if scenario.arena is not None:
        _section(
            document,
            "arena",
            write_arena(scenario.arena),
            "For navigation: discs, goals, and obstacles [x, y, radius] or [x, y, x, y, half thickness].",
        )
    law = tomlkit.table()
    law.update(_plain({"name": scenario.law.name, **scenario.law.parameters}))
    _section(document, "law", law, "The feedback law, and its parameters.")
    # tomlkit puts an empty line before each header, also between it and its comment
    return re.sub(r"(?m)^(#.*\n)\n(?=\[)", r"\1", tomlkit.dumps(document))


def _section(document: tomlkit.TOMLDocument, name: str, content: Any, *comments: str) -> None:
    document.add(tomlkit.nl())
    for comment in comments:
        document.add(tomlkit.comment(comment))
    document.add(name, content)


def _runs(scenario: Scenario) -> Iterable[tuple[int, int]]:
    """(first, one past the last) of consecutive agents with equal models and equal observers."""
    models, options = scenario.models, scenario.observers
    first = 0
    for i in range(1, len(models) + 1):
        if i == len(models) or models[i] != models[first] or (options is not None and options[i] != options[first]):
            yield first, i
            first = i


def _agents(scenario: Scenario, first: int, stop: int) -> Table:
    model, agent = scenario.models[first], scenario.fleet.ids[first]
    if MODELS.get(model.type) is not type(model):
        raise ValueError(
            f"agent {agent!r} can't be written to a file: its model {type(model).__name__} isn't one of the library's "
            f"({', '.join(MODELS)}), so that it couldn't be read back; keep this scenario in Python"
        )
    table = tomlkit.table()
    table.add("model", model.type)
    table.add("count", stop - first)
    for field in fields(model):  # type: ignore[arg-type]
        table.add(field.name, _model_value(model, field.name))
    if scenario.observers is not None:
        table.add("drift_known", scenario.observers[first].drift)
        table.add("input_observer", scenario.observers[first].input_observer)
    columns = slice(scenario.fleet.state_offset[first], scenario.fleet.state_offset[stop])
    for name in ("center", "radius"):
        values = np.asarray(getattr(scenario, name))[columns].reshape(stop - first, model.n)
        table.add(f"initial_{name}", _box(values))
    return table


def _model_value(model: AgentModel, name: str) -> Any:
    value = np.asarray(getattr(model, name))
    return _plain(value.flat[0] if name == "input_limit" and np.all(value == value.flat[0]) else value)


def _box(values: np.ndarray) -> Any:
    """The shortest form of (agents, states) numbers."""
    if np.all(values == values.flat[0]):
        return _plain(values.flat[0])
    if np.all(values == values[0]):
        return _plain(values[0])
    return _lines([_plain(row) for row in values], 1)


def _edges(graph: nx.Graph) -> Table:
    table = tomlkit.table()
    edges = [list(edge) for edge in graph.edges]
    if graph.is_directed():
        table.add("directed", True)
    else:
        edges = [sorted(edge) for edge in edges]
    table.add("edges", _lines(sorted(edges), _EDGES_A_LINE))
    return table


def _bounds(scenario: Scenario, bounds: Any, name: str) -> Table:
    table = tomlkit.table(is_super_table=isinstance(bounds, Mapping))
    if not isinstance(bounds, Mapping):
        table.update(_exponentials(bounds, name))
        return table
    for kind, bound in bounds.items():
        inner = tomlkit.table()
        inner.update(_exponentials(bound, f"{name} of {kind!r}"))
        table.add(kind, inner)
    return table


def _exponentials(bound: Bound, whose: str) -> dict[str, Any]:
    functions = list(bound) if isinstance(bound, Sequence) else [bound]
    for function in functions:
        if type(function) is not Exponential:
            raise ValueError(
                f"{whose} can't be written to a file: {function!r} isn't an Exponential; keep this scenario in Python"
            )
    values = {name: [float(getattr(function, name)) for function in functions] for name in ("initial", "final", "rate")}
    return {name: row[0] if len(set(row)) == 1 else row for name, row in values.items()}


def _disturbance(term: Term) -> Table:
    kinds = [kind for kind, known in DISTURBANCES.items() if known is type(term)]
    if not kinds:
        raise ValueError(
            f"the disturbance {term!r} can't be written to a file: it isn't one of the library's "
            f"({', '.join(DISTURBANCES)}); keep this scenario in Python"
        )
    table = tomlkit.table()
    table.add("kind", kinds[0])
    for field in fields(term):
        if getattr(term, field.name) is not None:
            table.add(field.name, _plain(getattr(term, field.name)))
    return table


def _lines(rows: Sequence[Any], per_line: int) -> Array:
    """An array over several lines."""
    lines = [", ".join(map(str, rows[i : i + per_line])) for i in range(0, len(rows), per_line)]
    text = "".join(f"\n    {line}," for line in lines)
    # written as text: building nested arrays item by item takes minutes for large graphs
    return tomlkit.array(f"[{text}\n]" if rows else "[]")


def _plain(value: Any) -> Any:
    """NumPy numbers and tuples as TOML types: numbers, lists, tables."""
    if isinstance(value, np.ndarray | np.generic):
        return value.tolist()
    if isinstance(value, Mapping):
        return {key: _plain(entry) for key, entry in value.items()}
    return [_plain(entry) for entry in value] if isinstance(value, list | tuple) else value
