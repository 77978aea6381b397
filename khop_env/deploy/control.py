"""From what one agent knows to its input: a law on its own state and its estimates, and nothing else."""

from __future__ import annotations

from collections.abc import Callable, Mapping

import networkx as nx
import numpy as np

from khop_env.observers import Estimate, FloatArray
from khop_env.physics import Fleet, read_only
from khop_env.simulation import Law, View

Control = Callable[[float, FloatArray, Mapping[str, Estimate]], FloatArray]
"""(t, own state, estimates by the targets' ids) -> own input (m_i,)."""


class LawControl:
    """A feedback law for one agent: a `Control`.

    The law's `View` is of a fleet of this agent alone, with the others at the far ends of its task edges.

    Args:
        law: the same as a simulator's.
        fleet: all agents.
        agent: index of this one.
        task: task graph.
    """

    def __init__(self, law: Law, fleet: Fleet, agent: int, task: nx.Graph) -> None:
        others = sorted(task.neighbors(agent))
        self._law = law
        self._others = [(fleet.ids[j], fleet.models[j].position_index) for j in others]
        self._own = fleet.models[agent].position_index
        self._t, self._x = np.zeros(1), np.zeros((1, fleet.models[agent].n))
        self._displacement = np.zeros((1, len(others), fleet.position_dim))
        self._view = View(
            fleet=Fleet([fleet.models[agent]]),
            x=read_only(self._x[:]),
            edges=read_only(np.array([(0, -1)] * len(others), np.int64).reshape(-1, 2)),
            known=read_only(np.ones((1, len(others)), bool)),
            displacement=read_only(self._displacement[:]),
        )

    def __call__(self, t: float, x: FloatArray, estimates: Mapping[str, Estimate]) -> FloatArray:
        """The law's input."""
        self._t[0], self._x[0] = t, x
        for row, (other, position) in enumerate(self._others):
            self._displacement[0, row] = estimates[other].estimate[position] - x[self._own]
        return np.array(self._law(self._t, self._view)[0])
