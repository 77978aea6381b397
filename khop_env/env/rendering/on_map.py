"""Drawing on the map of a frame in metres, for tasks."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from khop_env.env.rendering.canvas import Canvas
from khop_env.env.rendering.panel import CIRCLE
from khop_env.observers import FloatArray


class OnMap:
    """A `tasks.MapCanvas`: drawing in metres.

    Args:
        canvas: of the frame.
        pixels: maps points (..., 2) in m to pixels.
        meters: per pixel.
        radius: of an agent's marker in pixels.
    """

    def __init__(
        self, canvas: Canvas, pixels: Callable[[FloatArray], FloatArray], meters: float, radius: float
    ) -> None:
        self._canvas, self._pixels, self._meters, self._radius = canvas, pixels, meters, radius

    def circle(self, center: FloatArray, radius: float, color: str, *, filled: bool = False) -> None:
        """See `tasks.MapCanvas`."""
        outline = min(radius / self._meters, 9999.0) * CIRCLE
        width = 0.0 if filled else 1.5
        self._canvas.marker(outline, self._pixels(np.asarray(center, float)), 0.0, color, width)

    def line(self, points: FloatArray, color: str, width: float = 2.0) -> None:
        """See `tasks.MapCanvas`."""
        self._canvas.line(self._pixels(np.asarray(points, float)), color, width)

    def cross(self, center: FloatArray, color: str) -> None:
        """See `tasks.MapCanvas`."""
        middle = self._pixels(np.asarray(center, float))
        for end in ((1.0, 1.0), (1.0, -1.0)):
            arm = 0.9 * self._radius * np.array(end)
            self._canvas.line(np.array([middle - arm, middle + arm]), color, 2.0)
