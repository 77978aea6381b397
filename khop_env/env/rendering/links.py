"""Communication links in a frame."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from khop_env.env.rendering.canvas import Canvas
from khop_env.env.rendering.looks import EDGE_COLOR, mix
from khop_env.env.rendering.scene import Scene
from khop_env.observers import FloatArray
from khop_env.physics import Links

_KEPT = 0.75  # of the colour, per round that a message is missing
_FAINTEST = 0.25  # darker than the lines of the grid
_DOWN = 0.6  # of the colour of a link that is down


class Stroke(NamedTuple):
    """How a link is drawn.

    Attributes:
        color: its red, green and blue.
        dashed: whether it is down.
    """

    color: tuple[int, int, int]
    dashed: bool = False


FRESH, DOWN = Stroke(mix(EDGE_COLOR, 1.0)), Stroke(mix(EDGE_COLOR, _DOWN), True)


def faded(missed: float) -> Stroke:
    """The stroke of a link whose newest message is `missed` rounds older than it had to be."""
    return Stroke(mix(EDGE_COLOR, max(_FAINTEST, _KEPT**missed)))


class LinkLines:
    """Draws the links of a graph: a line where they go both ways, an arrow where they go one way.

    A link that is down is dashed, and one whose newest messages are lost fades from round to round. Of a line, the half
    beside an agent shows the link by which this agent receives.

    Args:
        links: of the graph.
        radius: of agents' markers in pixels.
        thin: scale of the lines' width.
    """

    def __init__(self, links: Links, radius: float, thin: float) -> None:
        self._radius, self._thin = radius, thin
        self.pairs = sorted({(min(pair), max(pair)) for pair in links.index})
        self._lines: list[tuple[list[int], int, int | None]] = []  # sender and receiver, the link, and the one back
        for i, j in self.pairs:
            sender, receiver = (i, j) if (i, j) in links.index else (j, i)
            there, back = links.index[sender, receiver], links.index.get((receiver, sender))
            self._lines.append(([sender, receiver], there, back))

    def draw(self, canvas: Canvas, middles: FloatArray, scene: Scene) -> None:
        """Draw them between agents at the pixels `middles` (N, 2); nan where an agent isn't drawn."""
        heads = []
        for agents, there, back in self._lines:
            ends = middles[agents]
            if not np.isfinite(ends).all():
                continue
            stroke = stroke_of(scene, there)
            other = stroke if back is None else stroke_of(scene, back)
            if other == stroke:
                draw_link(canvas, ends, stroke, self._thin)
            else:
                middle = ends.mean(axis=0)
                draw_link(canvas, np.array([middle, ends[1]]), stroke, self._thin)
                draw_link(canvas, np.array([middle, ends[0]]), other, self._thin)
            if back is None:
                heads.append((ends, stroke.color))
        for ends, color in heads:  # above all lines
            draw_arrow_head(canvas, ends, 1.6 * self._radius, self._thin, color)


def stroke_of(scene: Scene, link: int) -> Stroke:
    """How a link is drawn at an instant."""
    if scene.up is not None and not scene.up[link]:
        return DOWN
    return FRESH if scene.messages is None else faded(float(scene.messages.missed[link]))


def draw_link(canvas: Canvas, ends: FloatArray, stroke: Stroke, thin: float) -> None:
    """A line between two points (2, 2)."""
    if stroke.dashed:
        canvas.dashes(ends[0], ends[1], stroke.color, 2.0 * thin, 3.0 * thin, 5.0 * thin)
    else:
        canvas.line(ends, stroke.color, 2.0 * thin)


def draw_arrow_head(canvas: Canvas, ends: FloatArray, before: float, thin: float, color: Any) -> None:
    """The head of a one-way link, from the first of two points (2, 2) to the second, `before` pixels ahead of it."""
    along = ends[1] - ends[0]
    along = along / max(float(np.hypot(*along)), 1e-9)
    tip, across = ends[1] - before * along, np.array([-along[1], along[0]])
    back = tip - 9.0 * thin * along
    canvas.polygon(np.array([tip, back + 4.0 * thin * across, back - 4.0 * thin * across]), color)
