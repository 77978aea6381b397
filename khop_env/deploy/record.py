"""What an agent's process writes down while it runs, in files that outlive it however it ends.

Rows of float64, one write each, in two files per process: states before anything is sent about them, so that what a
killed process has said is always on record, and what the agent knew once its round is over.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from khop_env.observers import Estimate, FloatArray, ObserverDesign
from khop_env.physics import Fleet


@dataclass(frozen=True)
class Columns:
    """Where things are in an agent's rows.

    A row of states: step, x (n_i), the input u (m_i) that was in force until then.
    A row of knowledge: step; of the round that it ends, when that began and ended, in s after it was due, and its CPU
    time in s; u (m_i) from now on; by sender the round of its newest message, -1 for none; then by target age,
    estimate, bound.

    Attributes:
        n: number of states.
        m: number of inputs.
        senders: indices of the agents that are heard.
        targets: indices of the agents that are estimated, and their numbers of states.
    """

    n: int
    m: int
    senders: tuple[int, ...]
    targets: Mapping[int, int]

    @staticmethod
    def of(design: ObserverDesign, agent: int) -> Columns:
        """Those of an agent."""
        model = design.fleet.models[agent]
        targets = sorted(i for observer, i in design.knowledge.slot if observer == agent)
        sizes = {i: design.fleet.models[i].n for i in targets}
        return Columns(model.n, model.m, tuple(sorted(design.links.senders[agent])), sizes)

    @property
    def state_width(self) -> int:
        """Numbers in a row of states."""
        return 1 + self.n + self.m

    @property
    def knowledge_width(self) -> int:
        """Numbers in a row of knowledge."""
        return 4 + self.m + len(self.senders) + sum(1 + 2 * n for n in self.targets.values())


class Writer:
    """Writes the rows of one process.

    Args:
        folder: of all records.
        fleet: all agents.
        columns: of this agent.
        agent: its index.
        start: number of processes that the agent has had before.
    """

    def __init__(self, folder: Path, fleet: Fleet, columns: Columns, agent: int, start: int = 0) -> None:
        states, knowledge = (path_of(folder, fleet, agent, start, kind) for kind in ("states", "known"))
        self._states, self._knowledge = open(states, "wb", 0), open(knowledge, "wb", 0)  # noqa: SIM115
        self._ids = [fleet.ids[i] for i in columns.targets]

    def state(self, step: int, x: FloatArray, u: FloatArray) -> None:
        """A row of states."""
        self._states.write(np.array([step, *x, *u]).tobytes())

    def knowledge(
        self,
        step: int,
        timing: tuple[float, float, float],
        u: FloatArray,
        newest: Mapping[int, int],
        estimates: Mapping[str, Estimate],
    ) -> None:
        """A row of knowledge."""
        row = [step, *timing, *u.tolist(), *newest.values()]
        for target in self._ids:
            known = estimates[target]
            row += [known.age, *known.estimate.tolist(), *known.bound.tolist()]
        self._knowledge.write(np.array(row, np.float64).tobytes())

    def close(self) -> None:
        """Close the files."""
        self._states.close()
        self._knowledge.close()


def path_of(folder: Path, fleet: Fleet, agent: int, start: int, kind: str) -> Path:
    """The file of an agent's process; `kind` is "states" or "known"."""
    return folder / f"{fleet.ids[agent]}.{start}.{kind}"


def rows_of(folder: Path, fleet: Fleet, agent: int, kind: str, width: int) -> FloatArray:
    """(rows, width) all complete rows of an agent, of its processes one after the other."""
    found, start = [np.zeros((0, width))], 0
    while (path := path_of(folder, fleet, agent, start, kind)).exists():
        values = np.fromfile(path)
        found.append(values[: len(values) // width * width].reshape(-1, width))
        start += 1
    return np.concatenate(found)
