"""The strip beside the map: time, the worst ratio |e| against its guaranteed limit of 1, and the legend."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from khop_env.env.rendering.canvas import Canvas, Rect
from khop_env.env.rendering.scene import (
    ALARM_COLOR,
    EDGE_COLOR,
    INK,
    LEADER_COLOR,
    PALE,
    SOFT,
    TASK_COLOR,
    TRAIL,
    Look,
    mix,
)
from khop_env.observers import FloatArray

_GAUGE_END = 1.25  # the largest |e| that the gauge has room for
_MOST_TYPES = 9
_STAR = np.array(
    [[r * math.sin(a), r * math.cos(a)] for a, r in zip(np.arange(10) * math.pi / 5, [1, 0.45] * 5, strict=True)]
)
CIRCLE = np.stack([np.cos(np.arange(48) * math.pi / 24), np.sin(np.arange(48) * math.pi / 24)], axis=-1)


def draw_agent(
    canvas: Canvas, look: Look, at: FloatArray, heading: float, radius: float, *, star: bool, ring: bool
) -> None:
    """An agent's marker with a white rim, a star if it doesn't act, and a ring if its estimates are drawn."""
    canvas.marker(1.25 * radius * look.outline, at, heading, "white")
    canvas.marker(radius * look.outline, at, heading, look.color)
    if star:
        canvas.marker(0.95 * radius * _STAR, at, 0.0, INK)
        canvas.marker(0.7 * radius * _STAR, at, 0.0, LEADER_COLOR)
    if ring:
        canvas.marker(2.0 * radius * CIRCLE, at, 0.0, INK, 0.25 * radius)


def draw_task_edge(canvas: Canvas, ends: FloatArray, unit: float, thin: float, *, beside: bool = False) -> None:
    """A dashed line between two points (2, 2), or a little beside it where a communication edge is drawn there."""
    if beside:
        along = ends[1] - ends[0]
        ends = ends + 3.0 * thin * np.array([-along[1], along[0]]) / max(float(np.hypot(*along)), 1e-9)
    canvas.dashes(ends[0], ends[1], TASK_COLOR, 2.0 * thin, 6.0 * unit, 5.0 * unit)


def draw_arrow_head(canvas: Canvas, ends: FloatArray, before: float, unit: float) -> None:
    """The head of a one-way link, from the first of two points (2, 2) to the second, `before` pixels ahead of it."""
    along = ends[1] - ends[0]
    along = along / max(float(np.hypot(*along)), 1e-9)
    tip, across = ends[1] - before * along, np.array([-along[1], along[0]])
    back = tip - 9.0 * unit * along
    canvas.polygon(np.array([tip, back + 4.0 * unit * across, back - 4.0 * unit * across]), EDGE_COLOR)


class Panel:
    """The strip: constant contents as arguments, and those that change in `draw`.

    Args:
        rect: where it is.
        unit: size of a pixel of the usual frame.
        types: text and look of each type of agent.
        driven: name in the legend of agents with a star; None if there are none.
        task: whether there are task edges.
        observer: id and look of the agent whose estimates are drawn; None without estimates.
        error_label: name of the error beside the gauge.
        error_unit: its unit.
    """

    def __init__(
        self,
        rect: Rect,
        unit: float,
        types: Mapping[str, Look],
        *,
        driven: str | None,
        task: bool,
        observer: tuple[str, Look] | None,
        error_label: str = "task error",
        error_unit: str = "m",
    ) -> None:
        self._left, self._top, self._width, _ = rect
        self._unit, self._error_label, self._error_unit = unit, error_label, error_unit
        self._types, self._driven, self._task, self._observer = types, driven, task, observer

    def draw(self, canvas: Canvas, t: float, normalized: float, task_error: float | None, hidden: int) -> None:
        """Draw it.

        Args:
            canvas: to draw on.
            t: in s.
            normalized: largest |e|.
            task_error: if there is one.
            hidden: number of guaranteed boxes that are larger than the view.
        """
        self._line = self._top + 12 * self._unit
        self._write(canvas, f"t = {t:.2f} s", size=20, advance=38)
        self._draw_gauge(canvas, normalized)
        if task_error is not None:
            self._write(canvas, f"{self._error_label}  {task_error:#.3g} {self._error_unit}", advance=20)
        self._draw_legend(canvas)
        if hidden:
            boxes = "box is" if hidden == 1 else "boxes are"
            self._write(canvas, f"{hidden} {boxes} larger", size=11, color=SOFT, advance=15, indent=34)
            self._write(canvas, "than the view", size=11, color=SOFT, indent=34)

    def _write(
        self, canvas: Canvas, text: str, *, size: int = 13, color: str = INK, advance: float = 24, indent: float = 0
    ) -> None:
        at = self._left + indent * self._unit, self._line
        canvas.text(text, at, round(size * self._unit), color=color, room=self._width - indent * self._unit)
        self._line += advance * self._unit

    def _draw_gauge(self, canvas: Canvas, normalized: float) -> None:
        """A bar up to the largest |e|; it has to end before the mark at 1."""
        unit, kept = self._unit, normalized < 1.0
        value = "not finite" if not math.isfinite(normalized) else f"{normalized:.3f}"
        if kept and value == "1.000":
            value = "0.999…"
        self._write(canvas, f"largest |e|  {value}", color=INK if kept else ALARM_COLOR, advance=20)
        left, height = self._left, 12 * unit
        top, mark = self._line - height / 2, left + self._width / _GAUGE_END
        share = min(normalized / _GAUGE_END, 1.0) if math.isfinite(normalized) else 1.0
        for extent, color in ((1.0, PALE), (share, "#5A5A5A" if kept else ALARM_COLOR)):
            right = left + extent * self._width
            canvas.polygon(np.array([[left, top], [right, top], [right, top + height], [left, top + height]]), color)
        canvas.line(np.array([[mark, top - 4 * unit], [mark, top + height + 4 * unit]]), INK, 2.0 * unit)
        self._line += 18 * unit
        size = round(11 * unit)
        canvas.text("0", (left, self._line), size, color=SOFT)
        canvas.text("guarantee: 1", (mark, self._line), size, color=SOFT, anchor=(0.85, 0.5))
        self._line += 30 * unit

    def _draw_legend(self, canvas: Canvas) -> None:
        unit, radius = self._unit, 7 * self._unit
        self._line += 12 * unit
        for number, (text, look) in enumerate(self._types.items()):
            if number == _MOST_TYPES:
                self._write(canvas, f"and {len(self._types) - number} more types", indent=34)
                break
            draw_agent(canvas, look, self._symbol(), 0.0, radius, star=False, ring=False)
            self._write(canvas, text, indent=34)
        first = next(iter(self._types.values()))
        if self._driven is not None:
            draw_agent(canvas, first, self._symbol(), 0.0, radius, star=True, ring=False)
            self._write(canvas, self._driven, indent=34)
        dash = np.array([[-12 * unit, 0], [12 * unit, 0]])
        canvas.line(self._symbol() + dash, EDGE_COLOR, 2.0 * unit)
        self._write(canvas, "communication", indent=34)
        if self._task:
            draw_task_edge(canvas, self._symbol() + dash, unit, unit)
            self._write(canvas, "task", indent=34)
        canvas.line(self._symbol() + dash, mix(first.color, 0.5), 2.0 * unit)
        self._write(canvas, f"path of the last {TRAIL:g} s", indent=34)
        if self._observer is None:
            return
        self._line += 12 * unit
        name, own = self._observer
        self._write(canvas, "One agent's estimates", advance=28)
        draw_agent(canvas, own, self._symbol(), 0.0, 0.7 * radius, star=False, ring=True)
        self._write(canvas, name, indent=34)
        estimate, truth = ends = self._symbol() + np.array([[-7 * unit, 0], [9 * unit, 0]])
        canvas.line(ends, first.color, 1.0 * unit)
        canvas.marker(0.6 * radius * first.outline, truth, 0.0, first.color)
        canvas.marker(radius * first.outline, estimate, 0.0, first.color, 1.5 * unit)
        self._write(canvas, "estimated position", indent=34, advance=16)
        self._write(canvas, "of a target", indent=34, advance=28)
        x, y = self._symbol()
        canvas.box((x - 11 * unit, y - 9 * unit, 22 * unit, 18 * unit), first.color)
        self._write(canvas, "box that holds the", indent=34, advance=16)
        self._write(canvas, "target (guaranteed)", indent=34, advance=26)

    def _symbol(self) -> FloatArray:
        """Middle of the symbol of the present line."""
        return np.array([self._left + 13 * self._unit, self._line])
