"""Schedules bound to links, in compiled loops: which links are up in each of many environments."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np
from numpy.typing import NDArray

from khop_env.compiled import compiled, inlined
from khop_env.network.randomness import SCHEDULE_ROUND, round_key, uniform
from khop_env.physics import FloatArray, IndexArray, Links

BoolArray = NDArray[np.bool_]
KeyArray = NDArray[np.uint64]

SLACK = 1e-9  # s: grid times are sums of steps, and a change at 1 s must not wait for the step after 0.9999999


class Part(Protocol):
    """A schedule bound to links.

    One whose links change at known times may also have `next_change(key, t)`, as in `Activity`: steps of controlled
    size then end there.
    """

    def __call__(self, key: KeyArray, t: FloatArray, x: FloatArray, out: BoolArray) -> None:
        """Clear in `out` (L, B) the links that are down; arguments as in `Activity.up`."""
        ...


class Activity:
    """The links that are up, of many environments at once.

    Args:
        parts: a link is up where all of them leave it up.
    """

    def __init__(self, parts: Sequence[Part]) -> None:
        self._parts = tuple(parts)

    def up(self, key: KeyArray, t: FloatArray, x: FloatArray, out: BoolArray) -> BoolArray:
        """The links that are up: a function of these arguments alone.

        Args:
            key: (B,) of each environment's randomness.
            t: (B,) time since reset in s.
            x: (n, B) true states.
            out: (L, B), written and returned.
        """
        out.fill(True)
        for part in self._parts:
            part(key, t, x, out)
        return out

    def next_change(self, key: KeyArray, t: FloatArray) -> FloatArray:
        """(B,) the next times in s at which links may change, as far as time alone decides it; inf where none is known.

        Args:
            key: (B,) of each environment's randomness.
            t: (B,) time since reset in s; changes that `up` already shows are past.
        """
        out = np.full(len(t), np.inf)
        for part in self._parts:
            if (known := getattr(part, "next_change", None)) is not None:
                np.minimum(out, known(key, t), out=out)
        return out


class Masked:
    """A fixed choice of links, `mask` (L,)."""

    def __init__(self, mask: BoolArray) -> None:
        self._mask = mask[:, None]

    def __call__(self, key: KeyArray, t: FloatArray, x: FloatArray, out: BoolArray) -> None:
        """See `Part`."""
        out &= self._mask


class Switched:
    """Graphs `masks` (G, L) from the times `starts` (G,) of a cycle on; without a cycle its `period` is 0."""

    def __init__(self, starts: FloatArray, period: float, masks: BoolArray) -> None:
        self._starts, self._period, self._masks = starts, period, masks

    def __call__(self, key: KeyArray, t: FloatArray, x: FloatArray, out: BoolArray) -> None:
        """See `Part`."""
        now = t + SLACK
        if self._period:
            now %= self._period
        _clear_others(np.searchsorted(self._starts, now, "right") - 1, self._masks, out)

    def next_change(self, key: KeyArray, t: FloatArray) -> FloatArray:
        """See `Activity.next_change`."""
        now = t + SLACK
        place = now % self._period if self._period else now
        starts = np.append(self._starts, self._period or np.inf)
        return now + (starts[np.searchsorted(self._starts, place, "right")] - place)


class Drawn:
    """A graph for each episode, drawn from its key; kept until the key changes.

    Args:
        links: of the communication graph.
        number: of the schedule among those that are joined.
        low: least probability of a link.
        span: largest minus least.
        both_ways: whether the two links of an edge share their draw.
        connected: whether the drawn graph is completed to a connected one.
    """

    def __init__(self, links: Links, number: int, low: float, span: float, both_ways: bool, connected: bool) -> None:
        self._first, self._low, self._span, self._connected = _first(links, number), low, span, connected
        self._agents, self._ends = links.agents, (links.sender, links.receiver)
        edges = {
            edge: i for i, edge in enumerate(sorted({_edge(*link) if both_ways else link for link in links.index}))
        }
        self._edge = np.array([edges[_edge(*link) if both_ways else link] for link in links.index], np.int64)
        self._key, self._up = np.zeros(0, np.uint64), np.zeros((0, 0), np.bool_)

    def __call__(self, key: KeyArray, t: FloatArray, x: FloatArray, out: BoolArray) -> None:
        """See `Part`."""
        fresh = self._key != key if self._up.shape == out.shape else np.ones(len(key), np.bool_)
        if fresh.any():
            if self._up.shape != out.shape:
                self._up = np.empty(out.shape, np.bool_)
            self._key = key.copy()
            _draw(
                key,
                fresh,
                self._first,
                self._low,
                self._span,
                self._edge,
                *self._ends,
                self._agents,
                self._connected,
                self._up,
            )
        out &= self._up


class Near:
    """Links between agents at most `radius` m apart; positions are the rows `positions` (N, d) of the states."""

    def __init__(self, links: Links, positions: IndexArray, radius: float) -> None:
        self._rows = np.ascontiguousarray(positions[links.sender]), np.ascontiguousarray(positions[links.receiver])
        self._radius = radius

    def __call__(self, key: KeyArray, t: FloatArray, x: FloatArray, out: BoolArray) -> None:
        """See `Part`."""
        _clear_far(*self._rows, self._radius, x, out)


class Off:
    """An agent, a link or (both -1) an agent that each episode draws, off from start for a duration.

    Args:
        links: of the communication graph.
        number: of the schedule among those that are joined.
        start: least value, and largest minus least, in s.
        duration: likewise.
        agent: -1 for none.
        link: -1 for none.
    """

    def __init__(
        self,
        links: Links,
        number: int,
        start: tuple[float, float],
        duration: tuple[float, float],
        agent: int,
        link: int,
    ) -> None:
        self._first, self._start, self._duration = _first(links, number), start, duration
        self._agent, self._link, self._agents = agent, link, links.agents
        self._ends = links.sender, links.receiver

    def __call__(self, key: KeyArray, t: FloatArray, x: FloatArray, out: BoolArray) -> None:
        """See `Part`."""
        _clear_off(
            key, t, self._first, self._start, self._duration, self._agent, self._link, self._agents, *self._ends, out
        )

    def next_change(self, key: KeyArray, t: FloatArray) -> FloatArray:
        """See `Activity.next_change`."""
        out = np.empty(len(t))
        _next_of_outage(key, t, self._first, self._start, self._duration, out)
        return out


def _first(links: Links, number: int) -> int:
    """First random number of a schedule: one for each link and three more are its own."""
    return number * (len(links) + 3)


def _edge(sender: int, receiver: int) -> tuple[int, int]:
    return min(sender, receiver), max(sender, receiver)


@compiled
def _clear_others(graph: IndexArray, masks: BoolArray, out: BoolArray) -> None:
    for link in range(out.shape[0]):
        for b in range(out.shape[1]):
            out[link, b] &= masks[graph[b], link]


@compiled
def _clear_far(sender: IndexArray, receiver: IndexArray, radius: float, x: FloatArray, out: BoolArray) -> None:
    for link in range(out.shape[0]):
        for b in range(out.shape[1]):
            square = 0.0
            for c in range(sender.shape[1]):
                apart = x[sender[link, c], b] - x[receiver[link, c], b]
                square += apart * apart
            out[link, b] &= square <= radius * radius


@inlined
def _outage(
    base: np.uint64, first: int, start: tuple[float, float], duration: tuple[float, float]
) -> tuple[float, float]:
    begin = start[0] + start[1] * uniform(base, first, 0)
    return begin, begin + duration[0] + duration[1] * uniform(base, first + 1, 0)


@compiled
def _next_of_outage(
    key: KeyArray, t: FloatArray, first: int, start: tuple[float, float], duration: tuple[float, float], out: FloatArray
) -> None:
    for b in range(t.size):
        begin, end = _outage(round_key(key[b], SCHEDULE_ROUND), first, start, duration)
        now = t[b] + SLACK
        out[b] = begin if now < begin else end if now < end else math.inf


@compiled
def _clear_off(
    key: KeyArray,
    t: FloatArray,
    first: int,
    start: tuple[float, float],
    duration: tuple[float, float],
    agent: int,
    link: int,
    agents: int,
    sender: IndexArray,
    receiver: IndexArray,
    out: BoolArray,
) -> None:
    for b in range(out.shape[1]):
        base = round_key(key[b], SCHEDULE_ROUND)
        begin, end = _outage(base, first, start, duration)
        now = t[b] + SLACK
        if now < begin or now >= end:
            continue
        if link >= 0:
            out[link, b] = False
            continue
        off = agent if agent >= 0 else math.floor(agents * uniform(base, first + 2, 0))
        for other in range(out.shape[0]):
            if sender[other] == off or receiver[other] == off:
                out[other, b] = False


@compiled
def _draw(
    key: KeyArray,
    fresh: BoolArray,
    first: int,
    low: float,
    span: float,
    edge: IndexArray,
    sender: IndexArray,
    receiver: IndexArray,
    agents: int,
    connected: bool,
    out: BoolArray,
) -> None:
    """Draw graphs in the environments that are `fresh`; J. B. Kruskal's algorithm (1956) where they are connected."""
    links = out.shape[0]
    draws = np.empty(links)
    leader = np.empty(agents, np.int64)
    kept = np.empty(links, np.bool_)  # by edge
    for b in range(out.shape[1]):
        if not fresh[b]:
            continue
        base = round_key(key[b], SCHEDULE_ROUND)
        probability = low + span * uniform(base, first, 0)
        for link in range(links):
            draws[link] = uniform(base, first + 1 + edge[link], 0)
            kept[edge[link]] = draws[link] < probability
        if connected:
            for agent in range(agents):
                leader[agent] = agent
            for link in np.argsort(draws):
                i, j = sender[link], receiver[link]
                while leader[i] != i:
                    i = leader[i]
                while leader[j] != j:
                    j = leader[j]
                if i != j:
                    leader[i] = j
                    kept[edge[link]] = True
        for link in range(links):
            out[link, b] = kept[edge[link]]
