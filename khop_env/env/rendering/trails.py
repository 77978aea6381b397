"""The paths of the last seconds, behind the agents of a frame."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Sequence

import numpy as np

from khop_env.env.rendering.canvas import Canvas
from khop_env.env.rendering.looks import TRAIL, Look, mix
from khop_env.observers import FloatArray

_FADES = 8  # shades of a trail


class Trails:
    """Positions of the last `TRAIL` seconds, and their drawing.

    Args:
        agents: the look of each agent.
        strength: share of the colour at the agent.
        width: of the lines in pixels.

    Attributes:
        points: times in s, and positions (N, d) in m.
    """

    def __init__(self, agents: Sequence[Look], strength: float, width: float) -> None:
        self._looks, self._strength, self._width = agents, strength, width
        self.points: deque[tuple[float, FloatArray]] = deque()

    def add(self, t: float, positions: FloatArray) -> None:
        """Add positions (N, d) at a time in s, not before the last one's, and forget old ones."""
        points = self.points
        if (points and t == points[-1][0]) or (len(points) > 1 and t - points[-2][0] < TRAIL / 100):
            points.pop()  # the same time, or closer than is visible
        points.append((t, positions))
        while points[0][0] < t - TRAIL:
            points.popleft()

    def draw(self, canvas: Canvas, t: float, pixels: Callable[[FloatArray], FloatArray]) -> None:
        """Draw them, the older the paler; `pixels` maps positions (K, N, d) to pixels (K, N, 2)."""
        times = np.array([time for time, _ in self.points])
        paths = pixels(np.array([positions for _, positions in self.points]))
        fresh = np.ceil((1.0 - (t - times) / TRAIL) * _FADES).astype(int)  # 0 for the oldest
        for shade in range(1, _FADES + 1):
            places = np.flatnonzero(fresh == shade)
            if not places.size:
                continue
            part = paths[max(0, places[0] - 1) : places[-1] + 1]  # from the end of the previous shade
            for agent, look in enumerate(self._looks):
                path = part[:, agent]
                color = mix(look.color, self._strength * shade / _FADES)
                canvas.line(path[np.isfinite(path[:, 0])], color, self._width)
