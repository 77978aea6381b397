"""The strip beside the map: time, the worst ratio against its guaranteed limit of 1, and the legend."""

from __future__ import annotations

import math
from collections.abc import Mapping

import numpy as np

from khop_env.brief import BOUND_REACHED, ratio_text
from khop_env.env.rendering.canvas import Canvas, Rect
from khop_env.env.rendering.links import DOWN, FRESH, draw_link, faded
from khop_env.env.rendering.looks import (
    ALARM_COLOR,
    CIRCLE,
    INK,
    LEADER_COLOR,
    PALE,
    SOFT,
    TASK_COLOR,
    TRAIL,
    Look,
    mix,
)
from khop_env.env.rendering.on_map import OnMap
from khop_env.env.rendering.scene import Scene
from khop_env.observers import FloatArray

_GAUGE_END = 1.25  # the largest ratio that the gauge has room for
_MOST_TYPES, _MOST_TYPES_WITH_LINKS = 9, 5  # that the legend has room for
_STAR = np.array(
    [[r * math.sin(a), r * math.cos(a)] for a, r in zip(np.arange(10) * math.pi / 5, [1, 0.45] * 5, strict=True)]
)


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
        estimator: name of the one that estimates from messages; "" for continuous exchange.
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
        estimator: str = "",
    ) -> None:
        self._left, self._top, self._width, _ = rect
        self._unit, self._error_label, self._error_unit = unit, error_label, error_unit
        self._types, self._driven, self._task, self._observer = types, driven, task, observer
        self._estimator = estimator

    def draw(
        self,
        canvas: Canvas,
        scene: Scene,
        hidden: int,
        unbounded: int = 0,
        ages: FloatArray | None = None,
        additions: OnMap | None = None,
    ) -> None:
        """Draw it.

        Args:
            canvas: to draw on.
            scene: of the frame.
            hidden: number of guaranteed boxes that are larger than the view.
            unbounded: number of targets that have no bound, and so no box.
            ages: (K,) of what the observer knows of its targets, in s; None for continuous exchange.
            additions: of the task.
        """
        self._line = self._top + 12 * self._unit
        self._write(canvas, f"t = {scene.t:.2f} s", size=20, advance=38)
        self._draw_gauge(canvas, scene)
        if scene.task_error is not None:
            self._write(canvas, f"{self._error_label}  {scene.task_error:#.3g} {self._error_unit}", advance=20)
        if self._estimator:
            self._write(canvas, f"estimator  {self._estimator}", advance=20)
        self._draw_legend(canvas, scene)
        if additions is not None:
            for text, symbol in additions.symbols.items():
                additions.draw_symbol(symbol, self._symbol(), 11 * self._unit)
                self._write(canvas, text, indent=34, advance=21)
        if self._observer is not None:
            self._draw_estimates(canvas, self._observer, ages)
        if hidden:
            boxes = "box is" if hidden == 1 else "boxes are"
            self._note(canvas, f"{hidden} {boxes} larger", "than the view")
        if unbounded:
            have = "target has" if unbounded == 1 else "targets have"
            self._note(canvas, f"{unbounded} {have} no bound", "now, and no box")

    def _write(
        self, canvas: Canvas, text: str, *, size: int = 13, color: str = INK, advance: float = 24, indent: float = 0
    ) -> None:
        at = self._left + indent * self._unit, self._line
        canvas.text(text, at, round(size * self._unit), color=color, room=self._width - indent * self._unit)
        self._line += advance * self._unit

    def _note(self, canvas: Canvas, *lines: str) -> None:
        """Small print below a symbol's text."""
        for text in lines:
            self._write(canvas, text, size=11, color=SOFT, advance=15, indent=34)

    def _draw_gauge(self, canvas: Canvas, scene: Scene) -> None:
        """A bar up to the largest ratio; it has to end before the mark at 1, or at it if it is of a certified bound."""
        unit, ratio, certified = self._unit, scene.ratio, scene.messages is not None
        kept = ratio <= 1.0 + BOUND_REACHED if certified else ratio < 1.0
        value = ratio_text(ratio, BOUND_REACHED if certified else 0.0)
        label = "largest error/bound" if certified else "largest |e|"
        self._write(canvas, f"{label}  {value}", color=INK if kept else ALARM_COLOR, advance=20)
        left, height = self._left, 12 * unit
        top, mark = self._line - height / 2, left + self._width / _GAUGE_END
        share = min(ratio / _GAUGE_END, 1.0) if math.isfinite(ratio) else 1.0
        for extent, color in ((1.0, PALE), (share, "#5A5A5A" if kept else ALARM_COLOR)):
            right = left + extent * self._width
            canvas.polygon(np.array([[left, top], [right, top], [right, top + height], [left, top + height]]), color)
        canvas.line(np.array([[mark, top - 4 * unit], [mark, top + height + 4 * unit]]), INK, 2.0 * unit)
        self._line += 18 * unit
        size = round(11 * unit)
        canvas.text("0", (left, self._line), size, color=SOFT)
        canvas.text("guarantee: 1", (mark, self._line), size, color=SOFT, anchor=(0.85, 0.5))
        self._line += 30 * unit

    def _draw_legend(self, canvas: Canvas, scene: Scene) -> None:
        unit, radius = self._unit, 7 * self._unit
        self._line += 12 * unit
        most = _MOST_TYPES if scene.messages is None else _MOST_TYPES_WITH_LINKS
        for number, (text, look) in enumerate(self._types.items()):
            if number == most:
                self._write(canvas, f"and {len(self._types) - number} more types", indent=34)
                break
            draw_agent(canvas, look, self._symbol(), 0.0, radius, star=False, ring=False)
            self._write(canvas, text, indent=34)
        first = next(iter(self._types.values()))
        if self._driven is not None:
            draw_agent(canvas, first, self._symbol(), 0.0, radius, star=True, ring=False)
            self._write(canvas, self._driven, indent=34)
        dash = np.array([[-12 * unit, 0], [12 * unit, 0]])
        draw_link(canvas, self._symbol() + dash, FRESH, unit)
        if scene.messages is None:
            self._write(canvas, "communication", indent=34)
        else:
            self._write(canvas, "link, message arrived", indent=34)
            thirds = np.linspace(self._symbol() + dash[0], self._symbol() + dash[1], 4)
            for missed, third in zip((1.0, 3.0, 8.0), range(3), strict=True):
                draw_link(canvas, thirds[third : third + 2], faded(missed), unit)
            self._write(canvas, "link, messages lost", indent=34, advance=17)
            self._note(canvas, "half beside an agent:", "what it receives")
            self._line += 7 * unit
        if scene.up is not None:
            draw_link(canvas, self._symbol() + dash, DOWN, unit)
            self._write(canvas, "link that is down", indent=34)
        if self._task:
            draw_task_edge(canvas, self._symbol() + dash, unit, unit)
            self._write(canvas, "task", indent=34)
        canvas.line(self._symbol() + dash, mix(first.color, 0.5), 2.0 * unit)
        self._write(canvas, f"path of the last {TRAIL:g} s", indent=34)

    def _draw_estimates(self, canvas: Canvas, observer: tuple[str, Look], ages: FloatArray | None) -> None:
        unit, radius = self._unit, 7 * self._unit
        first, (name, own) = next(iter(self._types.values())), observer
        self._line += 12 * unit
        self._write(canvas, "One agent's estimates", advance=28)
        draw_agent(canvas, own, self._symbol(), 0.0, 0.7 * radius, star=False, ring=True)
        self._write(canvas, name, indent=34, advance=24 if ages is None else 17)
        if ages is not None:
            self._note(canvas, *_ages(ages))
            self._line += 9 * unit
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


def _ages(ages: FloatArray) -> list[str]:
    """Mean and largest age of what is known, and the number of agents of which nothing is."""
    known = ages[np.isfinite(ages)]
    lines = [f"states {known.mean():.2f} s old in the", f"mean, the oldest {known.max():.2f} s"] if known.size else []
    if missing := ages.size - known.size:
        lines.append(f"nothing yet of {missing} agent{'s' * (missing > 1)}")
    return lines
