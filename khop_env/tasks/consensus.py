"""Meet: p_j = p_i along the edges of the task graph."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from khop_env.observers import FloatArray, IntArray
from khop_env.tasks.base import World, directed
from khop_env.tasks.edges import EdgeTask


@dataclass(eq=False, kw_only=True)
class Consensus(EdgeTask):
    """Agents meet along the edges of the scenario's task graph (the paper's consensus experiment)."""

    def relations(self, world: World) -> tuple[IntArray, FloatArray]:
        """Both directions of each edge of the task graph, without displacement."""
        edges = directed(world.graph)
        return edges, np.zeros((len(edges), world.fleet.position_dim))
