"""Keep a formation anywhere: p_j - p_i = r_j - r_i along the edges of the task graph."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from khop_env.observers import FloatArray, IntArray
from khop_env.tasks.base import World, directed
from khop_env.tasks.edges import EdgeTask, require_positive, ring

MOST_ON_A_RING = 12  # agents; more of them stand in a square grid


@dataclass(eq=False, kw_only=True)
class Formation(EdgeTask):
    """Agents keep displacements d_ij = r_j - r_i along the edges of the scenario's task graph.

    Attributes:
        points: (N, d) the points r_i in m; by default a ring, or a square grid of many agents.
        spacing: distance of neighbouring default points in m.

    Raises:
        ValueError: for points of a wrong shape or not finite, or a spacing that isn't positive.
    """

    points: Sequence[Sequence[float]] | np.ndarray | None = None
    spacing: float = 1.0

    def relations(self, world: World) -> tuple[IntArray, FloatArray]:
        """Both directions of each edge of the task graph, with the displacement between its points."""
        shape = (len(world.fleet), world.fleet.position_dim)
        if self.points is None:
            require_positive("spacing", self.spacing)
            points = _ring_or_grid(*shape) * self.spacing
        else:
            points = np.asarray(self.points, dtype=float)
            if points.shape != shape or not np.isfinite(points).all():
                raise ValueError(
                    f"points must be finite, of shape (agents, position axes) = {shape}, in m; got {points.shape}"
                )
        edges = directed(world.graph)
        return edges, points[edges[:, 1]] - points[edges[:, 0]]


def _ring_or_grid(count: int, dim: int) -> FloatArray:
    """Points whose nearest neighbours are 1 apart: a line, a ring, or a square grid."""
    points = np.zeros((count, dim))
    if dim == 1:
        points[:, 0] = np.arange(count)
    elif 1 < count <= MOST_ON_A_RING:
        points = ring(count, dim) / (2.0 * math.sin(math.pi / count))
    else:
        side = math.ceil(math.sqrt(count))
        points[:, 0], points[:, 1] = np.arange(count) % side, np.arange(count) // side
    return points
