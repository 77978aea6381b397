"""Changing graphs: which of the links of a communication graph are up, and when.

The communication graph has all links that may ever be up. A schedule is a pure function of an environment's key, of
time and of the agents' positions, so that nothing but the key is to be saved; `&` joins schedules, and a link is up
where it is up in all of them.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import MISSING, dataclass, fields
from typing import Any

import networkx as nx
import numpy as np

from khop_env.network.activity import Activity, Drawn, Masked, Near, Off, Part, Switched
from khop_env.network.checks import bounds_of, graph_of, is_index, mask_of, positive, require_bools, require_graph
from khop_env.network.reading import Span, number, number_or_range
from khop_env.physics import IndexArray, Links, did_you_mean


@dataclass(frozen=True)
class Schedule:
    """Base of all schedules."""

    def __and__(self, other: Schedule) -> Schedule:
        if not isinstance(other, Schedule):
            return NotImplemented
        return Both((*self.parts, *other.parts))

    @property
    def parts(self) -> tuple[Schedule, ...]:
        """The schedules that this one joins; itself alone."""
        return (self,)

    def bind(self, links: Links, positions: IndexArray) -> Activity:
        """The schedule on the links of a communication graph.

        Args:
            links: all that may ever be up.
            positions: (N, d) rows of the agents' positions in the states, `Fleet.position_index`.

        Raises:
            ValueError: for a link or an agent that isn't in the communication graph, or connected graphs to be drawn
                out of links that go one way.
        """
        return Activity([part.part(links, positions, number) for number, part in enumerate(self.parts)])

    def part(self, links: Links, positions: IndexArray, number: int) -> Part:
        """This schedule alone, bound to links; a schedule of your own writes this method.

        Args:
            links: all that may ever be up; `links.sender` and `links.receiver` (L,) are agents' indices.
            positions: (N, d) rows of the agents' positions in the states.
            number: tells its random numbers from those of other schedules.

        Returns:
            A function of (key (B,), t (B,), x (n, B), out (L, B)) that clears in `out` the links that are down, from
            these arguments alone; one that can be pickled, as `functools.partial` of a module's function can.
        """
        raise NotImplementedError(f"{type(self).__name__} has no part(links, positions, number)")

    @staticmethod
    def of(schedule: Schedule | Mapping[str, object] | Sequence[Mapping[str, object]] | None) -> Schedule | None:
        """A schedule as users write it.

            Schedule.of({"kind": "outage", "start": 2.0, "duration": 1.0, "agent": 0})    # a table of a scenario file
            Schedule.of([{"kind": "random", "probability": 0.7}, {"kind": "range", "radius": 5.0}])     # both of them

        Args:
            schedule: a mapping with a "kind" of `SCHEDULES` and the schedule's values, several of them, a schedule, or
                None. Graphs are lists of edges [i, j]; with "directed" = True an edge [b, a] is a link over which
                agent a hears agent b.

        Raises:
            ValueError: for an unknown kind or key, or a value that isn't right.
        """
        if schedule is None or isinstance(schedule, Schedule):
            return schedule
        if isinstance(schedule, Mapping):
            return from_table(schedule)
        if isinstance(schedule, str) or not isinstance(schedule, Sequence) or not schedule:
            raise ValueError(
                f"a schedule is a Schedule, a mapping with its 'kind', several of these, or None; got {schedule!r}"
            )
        found: list[Schedule] = []
        for entry in schedule:
            made = Schedule.of(entry)
            if made is None:
                raise ValueError(f"a list of schedules must not hold None; got {schedule!r}")
            found.extend(made.parts)
        return found[0] if len(found) == 1 else Both(tuple(found))


@dataclass(frozen=True)
class Both(Schedule):
    """Several schedules: a link is up where it is up in all of them.

    Attributes:
        schedules: at least one; `a & b` makes them.
    """

    schedules: tuple[Schedule, ...]

    @property
    def parts(self) -> tuple[Schedule, ...]:
        """The schedules."""
        return self.schedules


@dataclass(frozen=True)
class Fixed(Schedule):
    """The links of one graph, always.

    Attributes:
        graph: with some of the communication graph's links; None for all of them.

    Raises:
        ValueError: if it isn't a graph.
    """

    graph: nx.Graph | None = None

    def __post_init__(self) -> None:
        if self.graph is not None:
            require_graph(self.graph, "Fixed.graph")

    def part(self, links: Links, positions: IndexArray, number: int) -> Part:
        """See `Schedule.part`."""
        return Masked(
            np.ones(len(links), np.bool_) if self.graph is None else mask_of(links, self.graph, "Fixed.graph")
        )


@dataclass(frozen=True)
class Switching(Schedule):
    """One graph after the other.

    Attributes:
        graphs: at least one.
        period: length of a cycle in s, after which the first graph follows the last; None if the last one stays.
        times: when each graph's links come up, in s since reset (since the beginning of the cycle), ascending from 0;
            by default equal parts of the period.

    Raises:
        ValueError: for times that don't match the graphs or the period, or neither.
    """

    graphs: tuple[nx.Graph, ...]
    period: float | None = None
    times: tuple[float, ...] | None = None

    def __post_init__(self) -> None:
        graphs = tuple(self.graphs) if isinstance(self.graphs, Sequence) else ()
        if not graphs:
            raise ValueError(f"Switching.graphs must be graphs, at least one; got {self.graphs!r}")
        for i, graph in enumerate(graphs):
            require_graph(graph, f"Switching.graphs[{i}]")
        object.__setattr__(self, "graphs", graphs)
        period = self.period
        if period is not None:
            period = positive(period, "Switching.period", "s")
            object.__setattr__(self, "period", period)
        if self.times is None and period is None:
            raise ValueError("Switching: give the period of a cycle, or the times at which each graph begins")
        given = [period * i / len(graphs) for i in range(len(graphs))] if self.times is None and period else self.times
        if not isinstance(given, Sequence) or isinstance(given, str) or len(given) != len(graphs):
            raise ValueError(
                f"Switching.times must be {len(graphs)} numbers, one for each graph, the first 0; got {self.times!r}"
            )
        times = tuple(number(value, f"Switching.times[{i}]") for i, value in enumerate(given))
        end = math.inf if period is None else period
        if times[0] != 0.0 or not all(a < b for a, b in zip(times, (*times[1:], end), strict=True)):
            below = "" if period is None else f", below the period of {period:g} s"
            raise ValueError(f"Switching.times must ascend from 0{below}; got {list(times)}")
        object.__setattr__(self, "times", times)

    def part(self, links: Links, positions: IndexArray, number: int) -> Part:
        """See `Schedule.part`."""
        masks = [mask_of(links, graph, f"Switching.graphs[{i}]") for i, graph in enumerate(self.graphs)]
        return Switched(np.array(self.times, float), self.period or 0.0, np.array(masks))


@dataclass(frozen=True)
class RandomLinks(Schedule):
    """Each episode draws its own graph out of the communication graph: one batch holds many graphs.

    Attributes:
        probability: that a link is up; or a range (low, high), from which each episode draws one for all its links.
        both_ways: whether the two links of an edge share their draw.
        connected: whether links that were drawn down come up again, by a spanning tree of lowest draws, until the graph
            is connected. It then reaches all agents, but maybe in more than k hops: `khop check` counts the pairs.

    Raises:
        ValueError: for a probability that isn't from 0 to 1, or connected graphs without `both_ways`.
    """

    probability: Span
    both_ways: bool = True
    connected: bool = False

    def __post_init__(self) -> None:
        require_bools(self, "both_ways", "connected")
        value = number_or_range(self.probability, "RandomLinks.probability")
        low, high = bounds_of(value)
        if not 0.0 <= low <= high <= 1.0:
            raise ValueError(f"RandomLinks.probability must be from 0 to 1; got {self.probability!r}")
        object.__setattr__(self, "probability", value)
        if self.connected and not self.both_ways:
            raise ValueError("RandomLinks: connected graphs are drawn edge by edge; set both_ways = True")

    def part(self, links: Links, positions: IndexArray, number: int) -> Part:
        """See `Schedule.part`."""
        if self.connected and not links.symmetric:
            raise ValueError(
                "RandomLinks.connected: the communication graph has links that go one way, out of which no connected "
                "graph can be drawn edge by edge; set connected = False"
            )
        low, high = bounds_of(self.probability)
        return Drawn(links, number, low, high - low, self.both_ways, self.connected)


@dataclass(frozen=True)
class Range(Schedule):
    """Links within a range: a link is up while its agents are at most `radius` metres apart.

    Attributes:
        radius: in m, positive.

    Raises:
        ValueError: if it isn't.
    """

    radius: float

    def __post_init__(self) -> None:
        object.__setattr__(self, "radius", positive(self.radius, "Range.radius", "m"))

    def part(self, links: Links, positions: IndexArray, number: int) -> Part:
        """See `Schedule.part`."""
        return Near(links, positions, self.radius)


@dataclass(frozen=True)
class Outage(Schedule):
    """An agent, with all its links, or a single link is off for a while.

    Attributes:
        start: in s since reset; or a range (low, high), from which each episode draws.
        duration: in s; or a range.
        agent: its index; without agent and link each episode draws an agent.
        link: (sender, receiver) of one link; the link back stays up.

    Raises:
        ValueError: for times that are negative or not finite, or an agent and a link.
    """

    start: Span
    duration: Span
    agent: int | None = None
    link: tuple[int, int] | None = None

    def __post_init__(self) -> None:
        for name in ("start", "duration"):
            value = number_or_range(getattr(self, name), f"Outage.{name}")
            if not (bounds_of(value)[0] >= 0.0 and math.isfinite(bounds_of(value)[1])):
                raise ValueError(f"Outage.{name} must be finite and not negative, in s; got {getattr(self, name)!r}")
            object.__setattr__(self, name, value)
        if self.agent is not None and self.link is not None:
            raise ValueError("Outage: give an agent or a link, not both; `&` joins two outages")
        if self.agent is not None and not is_index(self.agent):
            raise ValueError(f"Outage.agent must be an agent's index{_no_ids(self.agent)}; got {self.agent!r}")
        if self.link is not None:
            if not isinstance(self.link, Sequence) or len(self.link) != 2 or not all(map(is_index, self.link)):
                ids = _no_ids(*self.link) if isinstance(self.link, tuple | list) else ""
                raise ValueError(
                    f"Outage.link must be the indices of two agents (sender, receiver){ids}; got {self.link!r}"
                )
            object.__setattr__(self, "link", (int(self.link[0]), int(self.link[1])))

    def part(self, links: Links, positions: IndexArray, number: int) -> Part:
        """See `Schedule.part`."""
        if self.agent is not None and self.agent >= links.agents:
            raise ValueError(f"Outage.agent must be from 0 to {links.agents - 1}; got {self.agent}")
        if self.link is not None and self.link not in links.index:
            sender, receiver = self.link
            raise ValueError(f"Outage.link: the communication graph has no link from {sender} to {receiver}")
        (early, late), (short, long) = bounds_of(self.start), bounds_of(self.duration)
        link = -1 if self.link is None else links.index[self.link]
        agent = -1 if self.agent is None else self.agent
        return Off(links, number, (early, late - early), (short, long - short), agent, link)


def _no_ids(*values: object) -> str:
    """A hint where agents were named."""
    names = [value for value in values if isinstance(value, str)]
    return f" (a schedule doesn't know ids: scenario.fleet.agent({names[0]!r}) is the index)" if names else ""


SCHEDULES: dict[str, type[Schedule]] = {
    "fixed": Fixed,
    "switching": Switching,
    "random": RandomLinks,
    "range": Range,
    "outage": Outage,
}
"""Kinds of schedules in scenario files."""


def from_table(table: Mapping[str, object]) -> Schedule:
    """The schedule in one mapping, as `Schedule.of` reads it."""
    values: dict[str, Any] = dict(table)
    kind = values.pop("kind", None)
    if not isinstance(kind, str) or kind not in SCHEDULES:
        raise ValueError(f"no kind of schedule {kind!r}; {did_you_mean(kind, SCHEDULES)}")
    make = SCHEDULES[kind]
    known = [field.name for field in fields(make)]
    directed = values.pop("directed", False) if {"graph", "graphs"} & set(known) else False
    if not isinstance(directed, bool):
        raise ValueError(f"{make.__name__}: directed must be true or false; got {directed!r}")
    for key in values:
        if key not in known:
            raise ValueError(f"{make.__name__}: unknown key {key!r}; {did_you_mean(key, known)}")
    if "graph" in values:
        values["graph"] = graph_of(values["graph"], directed, f"{make.__name__}.graph")
    if "graphs" in values:
        listed = values["graphs"]
        if not isinstance(listed, Sequence) or isinstance(listed, str):
            raise ValueError(f"{make.__name__}.graphs must be a list of lists of edges; got {listed!r}")
        name = f"{make.__name__}.graphs"
        values["graphs"] = tuple(graph_of(edges, directed, f"{name}[{i}]") for i, edges in enumerate(listed))
    try:
        return make(**values)
    except TypeError:
        missing = [field.name for field in fields(make) if field.name not in values and field.default is MISSING]
        raise ValueError(f"{make.__name__}: {missing[0]} is missing") from None
