"""The part of the plane that a rendered frame shows, and where labels find room in it."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from khop_env.observers import FloatArray

SMALLEST_VIEW = 0.1  # m across
SHRINKING = 1.0  # s: time constant with which the view closes in; it widens at once
TICK_DISTANCE = 70  # px between grid lines, or up to 2.5 times as much

_STEPS = (1.0, 2.0, 5.0, 10.0)
_SIDES = np.array(  # of a marker, in the order in which they are tried
    [
        *([1, 0], [-1, 0], [0, -1], [0, 1], [1, -1], [1, 1], [-1, -1], [-1, 1]),
        *([1, -0.5], [1, 0.5], [-1, -0.5], [-1, 0.5], [0.5, -1], [0.5, 1], [-0.5, -1], [-0.5, 1]),
    ]
)
_DISTANCES = np.array([[[4.0]], [[14.0]], [[28.0]]])  # px from the marker's edge to its label


class Camera:
    """Maps the plane (m) to a rectangle of pixels, to the same scale on both axes; the second axis points up.

    Args:
        rect: left, top, width and height of the rectangle in pixels.
        margin: pixels along its edges that followed points stay out of.
    """

    def __init__(self, rect: tuple[float, float, float, float], margin: float) -> None:
        self.rect = rect
        self._middle = np.array([rect[0] + rect[2] / 2, rect[1] + rect[3] / 2])
        self._room = np.array([rect[2] / 2 - margin, rect[3] / 2 - margin])
        self.center = np.zeros(2)
        self.meters = SMALLEST_VIEW / rect[3]  # per pixel

    def follow(self, points: FloatArray, elapsed: float) -> None:
        """Bring all points into view: widen at once, close in little by little.

        Args:
            points: (K, 2) in m, finite.
            elapsed: s since the last call; infinite to close in at once.
        """
        if not len(points):
            return
        low, high = points.min(axis=0), points.max(axis=0)
        self.center = (low + high) / 2
        needed = max(float(((high - low) / 2 / self._room).max()), SMALLEST_VIEW / self.rect[3])
        self.meters = max(needed, needed + (self.meters - needed) * math.exp(-elapsed / SHRINKING))

    def pixels(self, points: FloatArray) -> FloatArray:
        """(..., 2) pixel positions of points (..., 2) in m."""
        return self._middle + (points - self.center) / self.meters * (1.0, -1.0)

    def ticks(self, axis: int) -> list[tuple[float, str]]:
        """(pixel, label in m) of each grid line across an axis."""
        half = self.rect[2 + axis] / 2 * self.meters
        rough = TICK_DISTANCE * self.meters
        power = 10.0 ** math.floor(math.log10(rough))
        step = next(power * s for s in _STEPS if power * s >= rough * (1 - 1e-9))
        first, last = (math.ceil((self.center[axis] - half) / step), math.floor((self.center[axis] + half) / step))
        decimals = max(0, -math.floor(math.log10(step) + 1e-9))
        values = [n * step for n in range(first, last + 1)]
        points = np.tile(self.center, (len(values), 1))
        points[:, axis] = values
        text = [f"{v:.{decimals}f}" if abs(v) < 1e5 else f"{v:.3g}" for v in values]
        return list(zip(self.pixels(points)[:, axis].tolist(), text, strict=True))


class Labels:
    """Places short texts beside their markers so that they cover neither markers nor each other."""

    def __init__(self) -> None:
        self._last: dict[int, int] = {}

    def place(
        self,
        anchors: FloatArray,
        sizes: FloatArray,
        radii: FloatArray,
        taken: FloatArray,
        within: tuple[float, float, float, float],
    ) -> dict[int, tuple[FloatArray, bool]]:
        """Positions of the labels; labels without room are left out.

        A label stays on the side where it was in the frame before, if it can.

        Args:
            anchors: (L, 2) middles of the markers in pixels.
            sizes: (L, 2) widths and heights of the texts.
            radii: (L,) of the markers in pixels.
            taken: (M, 4) left, top, right, bottom of rectangles that must stay visible.
            within: left, top, width, height of the area for labels.

        Returns:
            By label its centre, and True if it is so far from its marker that a line should join them.
        """
        left, top, width, height = within
        found = {}
        for number, (anchor, size, radius) in enumerate(zip(anchors, sizes, radii, strict=True)):
            middles = anchor + (_SIDES * (radius + _DISTANCES) + np.sign(_SIDES) * size / 2).reshape(-1, 2)
            low, high = middles - size / 2, middles + size / 2
            free = ~_overlap(low, high, taken)
            free &= np.all((low >= (left, top)) & (high <= (left + width, top + height)), axis=1)
            choice = self._last.get(number, 0)
            if not free[choice]:
                choice = int(np.argmax(free))
            if free[choice]:
                self._last[number] = choice
                found[number] = middles[choice], choice >= len(_SIDES)
                taken = np.vstack([taken, [*low[choice], *high[choice]]])
        return found


def _overlap(low: FloatArray, high: FloatArray, taken: FloatArray) -> NDArray[np.bool_]:
    """(C,) True for each of C rectangles that overlaps any of the M taken ones."""
    apart = (high[:, None, :] <= taken[None, :, :2]) | (low[:, None, :] >= taken[None, :, 2:])
    return np.any(~np.any(apart, axis=-1), axis=-1)
