"""The place where agents move: their size, obstacles, and how far apart they start."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Literal

import numpy as np

from khop_env.observers import FloatArray

Goals = Literal["opposite", "random"]
_TRIES = 1000  # draws of all points


@dataclass(frozen=True)
class Obstacle:
    """All points within `radius` of the straight line from `start` to `end`: a disc if they are equal, else a wall.

    Attributes:
        start: (2,) in m.
        end: (2,) in m; `start` by default.
        radius: of the disc, or half the wall's thickness, in m.

    Raises:
        ValueError: for points that aren't two finite numbers, or a radius that is negative or not finite.
    """

    start: tuple[float, float]
    end: tuple[float, float] | None = None
    radius: float = 0.0

    def __post_init__(self) -> None:
        end = self.start if self.end is None else self.end
        for name, point in (("start", self.start), ("end", end)):
            values = np.asarray(point, dtype=float)
            if values.shape != (2,) or not np.isfinite(values).all():
                raise ValueError(f"Obstacle.{name} must be two finite numbers, x and y in m; got {point!r}")
            object.__setattr__(self, name, (float(values[0]), float(values[1])))
        if not 0.0 <= self.radius < math.inf:
            raise ValueError(f"Obstacle.radius must be finite and not negative; got {self.radius!r}")


@dataclass(frozen=True)
class Arena:
    """The space in which agents of a scenario move, for tasks.

    Attributes:
        radius: of every agent, which is a disc (a ball in three dimensions), in m.
        apart: smallest distance between two agents' initial positions, and between two goals, in m.
        goals: "opposite" for each agent's initial position mirrored at the origin, "random" for any positions within
            the box that contains all initial positions.
        obstacles: that don't move, in the plane.

    Raises:
        ValueError: for a radius that isn't positive, or a distance below 0.
    """

    radius: float = 0.2
    apart: float = 0.0
    goals: Goals = "random"
    obstacles: tuple[Obstacle, ...] = ()

    def __post_init__(self) -> None:
        if not 0.0 < self.radius < math.inf:
            raise ValueError(f"Arena.radius must be positive and finite; got {self.radius!r}")
        if not 0.0 <= self.apart < math.inf:
            raise ValueError(f"Arena.apart must be finite and not negative; got {self.apart!r}")
        if self.goals not in ("opposite", "random"):
            raise ValueError(f"Arena.goals must be 'opposite' or 'random'; got {self.goals!r}")
        object.__setattr__(self, "obstacles", tuple(self.obstacles))

    def segments(self) -> FloatArray:
        """(M, 5) of each obstacle the ends x, y, x, y, and the radius, in m."""
        rows = [(*each.start, *each.end, each.radius) for each in self.obstacles]  # type: ignore[misc]
        return np.array(rows, dtype=float).reshape(-1, 5)

    def draw(self, center: FloatArray, radius: FloatArray, rng: np.random.Generator) -> FloatArray:
        """Points, one per agent, uniform in boxes, conditional on being `apart` and not touching an obstacle.

        Args:
            center: (N, d) of the boxes in m.
            radius: (N, d) their half widths.
            rng: draws the points one after the other, and all again if one doesn't fit.

        Raises:
            ValueError: if that fails too often.
        """
        segments, points = self.segments(), np.zeros(center.shape)
        for _ in range(_TRIES):
            for i in range(len(points)):
                for _ in range(_TRIES // 10):
                    points[i] = center[i] + radius[i] * rng.uniform(-1.0, 1.0, center.shape[1])
                    gaps = points[:i] - points[i]
                    if (gaps * gaps).sum(axis=1).min(initial=math.inf) < self.apart**2:
                        continue
                    if len(segments) == 0 or gap_to(points[i], segments).min() >= self.radius:
                        break
                else:
                    break
            else:
                return points
        raise ValueError(
            f"no room for {len(points)} agents {self.apart:g} m apart, of radius {self.radius:g} m, beside "
            f"{len(segments)} obstacles in the boxes where they may be; take a wider initial set, fewer agents or a "
            "smaller distance"
        )


def gap_to(point: FloatArray, segments: FloatArray) -> FloatArray:
    """(M,) distance in m from a point (2,) to obstacles (M, 5); negative within one."""
    start, along = segments[:, :2], segments[:, 2:4] - segments[:, :2]
    length = (along * along).sum(axis=1)
    share = ((point - start) * along).sum(axis=1) / np.where(length > 0.0, length, 1.0)
    nearest = start + np.clip(share, 0.0, 1.0)[:, None] * along
    return np.hypot(*(point - nearest).T) - segments[:, 4]
