"""What the live table shows: the last rows of all records, compared with the true states of the same step."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from khop_env.deploy.record import Columns, path_of
from khop_env.observers import FloatArray
from khop_env.scenarios import Scenario

_ROWS, _COMPARED = 64, 8


@dataclass(frozen=True)
class Now:
    """How one agent does now.

    Attributes:
        period_kept: share of its last rounds that ended within their period; nan for none.
        ratio: largest error over its certified bound, in the last step in which it can be compared with the most true
            states; nan for none.
        age: of the oldest state that it knows, in s; inf where nothing has arrived of some agent.
    """

    period_kept: float
    ratio: float
    age: float


class Live:
    """Reads the ends of the records.

    Args:
        scenario: that is run.
        folder: of the records.
        period: of rounds, in s.
    """

    def __init__(self, scenario: Scenario, folder: Path, period: float) -> None:
        self._fleet, self._folder, self._period = scenario.fleet, folder, period
        self._columns = [Columns.of(scenario.design, agent) for agent in range(len(scenario.fleet))]

    def read(self, starts: list[int]) -> list[Now]:
        """All agents now; `starts` are the numbers of processes that each has had before."""
        states: list[dict[int, FloatArray]] = []
        for agent, start in enumerate(starts):
            rows = self._last(agent, start, "states", self._columns[agent].state_width)
            states.append({int(row[0]): row[1 : 1 + self._columns[agent].n] for row in rows})
        return [self._of(agent, start, states) for agent, start in enumerate(starts)]

    def _of(self, agent: int, start: int, states: list[dict[int, FloatArray]]) -> Now:
        columns = self._columns[agent]
        rows = self._last(agent, start, "known", columns.knowledge_width)
        if not len(rows):
            return Now(math.nan, math.nan, math.inf)
        ended = rows[rows[:, 2] > 0.0, 2]
        kept = float((ended <= self._period).mean()) if len(ended) else math.nan
        first = 4 + columns.m + len(columns.senders)
        most, ratio = 0, math.nan
        for row in rows[::-1][:_COMPARED]:  # others may be a few rounds behind, or away
            at, found = first, []
            for target, n in columns.targets.items():
                if (true := states[target].get(int(row[0]))) is not None:
                    error, bound = np.abs(row[at + 1 : at + 1 + n] - true), row[at + 1 + n : at + 1 + 2 * n]
                    found.append(float(np.divide(error, bound, out=np.zeros(n), where=error > 0.0).max()))
                at += 1 + 2 * n
            if len(found) > most:
                most, ratio = len(found), max(found)
        places = first + np.cumsum([0, *(1 + 2 * n for n in columns.targets.values())])[:-1]
        return Now(kept, ratio, float(rows[-1, places].max(initial=0.0)))

    def _last(self, agent: int, start: int, kind: str, width: int) -> FloatArray:
        path = path_of(self._folder, self._fleet, agent, start, kind)
        try:
            complete = path.stat().st_size // (8 * width)
            first = max(0, complete - _ROWS)
            values = np.fromfile(path, count=(complete - first) * width, offset=8 * first * width)
        except OSError:
            values = np.zeros(0)
        return values.reshape(-1, width)
