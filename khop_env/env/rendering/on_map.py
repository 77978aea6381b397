"""Drawing on the map of a frame in metres, for tasks."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np

from khop_env.env.rendering.canvas import Canvas
from khop_env.env.rendering.looks import CIRCLE
from khop_env.observers import FloatArray
from khop_env.tasks import MapCanvas

Symbol = Callable[[MapCanvas], None]


class OnMap:
    """A `tasks.MapCanvas`: drawing in metres.

    Args:
        canvas: of the frame.
        pixels: maps points (..., 2) in m to pixels.
        meters: per pixel.
        radius: of an agent's marker in pixels.

    Attributes:
        marker: its radius in m.
        symbols: of the legend, by text.
    """

    def __init__(
        self, canvas: Canvas, pixels: Callable[[FloatArray], FloatArray], meters: float, radius: float
    ) -> None:
        self._canvas, self._pixels, self._meters, self._radius = canvas, pixels, meters, radius
        self.marker = meters * radius
        self.symbols: dict[str, Symbol] = {}

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

    def legend(self, text: str, symbol: Symbol) -> None:
        """See `tasks.MapCanvas`."""
        self.symbols[text] = symbol

    def draw_symbol(self, symbol: Symbol, at: FloatArray, size: float) -> None:
        """Draw a symbol of the legend about a pixel (2,), `size` pixels large from its middle."""
        symbol(OnMap(self._canvas, lambda points: at + size * points * (1.0, -1.0), 1.0 / size, size))


class Extent:
    """A `tasks.MapCanvas` that draws nothing, and keeps what the view has to hold.

    Attributes:
        marker: 0.
        points: (K, 2) each, in m.
    """

    marker = 0.0

    def __init__(self) -> None:
        self.points: list[FloatArray] = []

    def circle(self, center: FloatArray, radius: float, color: str, *, filled: bool = False) -> None:
        """See `tasks.MapCanvas`."""
        self.points.append(np.asarray(center, float) + radius * np.array([[-1.0, -1.0], [1.0, 1.0]]))

    def line(self, points: FloatArray, color: str, width: float = 2.0) -> None:
        """See `tasks.MapCanvas`."""
        self.points.append(np.asarray(points, float))

    def cross(self, center: FloatArray, color: str) -> None:
        """See `tasks.MapCanvas`."""
        self.points.append(np.asarray(center, float)[None])

    def legend(self, text: str, symbol: Symbol) -> None:
        """See `tasks.MapCanvas`."""
