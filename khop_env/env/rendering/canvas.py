"""Lines, markers and texts on a picture: all uses of pygame, which is imported on demand."""

from __future__ import annotations

import functools
import math
import os
import sys
import weakref
from types import ModuleType
from typing import Any

import numpy as np
from numpy.typing import NDArray

from khop_env.env.rendering.looks import INK
from khop_env.extras import how_to_install
from khop_env.observers import FloatArray

Rect = tuple[float, float, float, float]
"""Left, top, width and height in pixels."""

FRAMES_PER_SECOND = 25  # of a window, at most

_FINE = 2  # render at 2x and downscale (anti-aliasing)


@functools.cache
def load_pygame() -> ModuleType:
    """The module, without its greeting on stdout.

    Raises:
        ModuleNotFoundError: without pygame-ce; the message says how to install it.
    """
    os.environ.setdefault("PYGAME_HIDE_SUPPORT_PROMPT", "1")
    try:
        import pygame
    except ModuleNotFoundError:
        raise ModuleNotFoundError(f"rendering needs pygame-ce: {how_to_install('render')}") from None
    return pygame


class Canvas:
    """Lines, markers and texts on a picture of `size`, with smooth edges; no display is needed."""

    def __init__(self, size: tuple[int, int]) -> None:
        import matplotlib  # for its font, which has Greek letters and is the same on every machine

        self._pg = load_pygame()
        self._pg.font.init()
        self._font_file = f"{matplotlib.get_data_path()}/fonts/ttf/DejaVuSans.ttf"
        self._large = self._pg.Surface((size[0] * _FINE, size[1] * _FINE), 0, 32)
        self.surface = self._pg.Surface(size, 0, 32)
        self._texts: list[tuple[Any, tuple[float, float]]] = []
        self._font = functools.cache(self._open_font)
        self._written = functools.lru_cache(1000)(self._write)

    def clear(self) -> None:
        """Start a picture."""
        try:
            self._font(12).get_height()
        except self._pg.error:  # others have called pygame.quit(), which makes every open font invalid for good
            self._pg.font.init()
            self._font.cache_clear()
        self._large.fill("white")
        self._texts.clear()

    def finish(self) -> None:
        """Scale down, and write the texts on top."""
        self._pg.transform.smoothscale(self._large, self.surface.get_size(), self.surface)
        self.surface.blits(self._texts)

    def array(self) -> NDArray[np.uint8]:
        """(H, W, 3) pixels, a fresh array."""
        width, height = self.surface.get_size()
        return np.frombuffer(bytearray(self._pg.image.tobytes(self.surface, "RGB")), np.uint8).reshape(height, width, 3)

    def clip(self, rect: Rect | None) -> None:
        """Draw inside a rectangle only, except for texts; everywhere if it is None."""
        self._large.set_clip(None if rect is None else [round(_FINE * edge) for edge in rect])

    def line(self, points: FloatArray, color: Any, width: float) -> None:
        """A line through points (K, 2)."""
        if len(points) > 1:
            self._pg.draw.lines(self._large, color, False, (_FINE * points).tolist(), max(1, round(_FINE * width)))

    def dashes(self, start: FloatArray, end: FloatArray, color: Any, width: float, dash: float, gap: float) -> None:
        """A dashed line between two points (2,)."""
        length = float(np.hypot(*(end - start)))
        for begin in np.arange(0.0, length, dash + gap):
            part = np.array([[begin], [min(begin + dash, length)]]) / length
            self.line(start + part * (end - start), color, width)

    def polygon(self, corners: FloatArray, color: Any, width: float = 0.0) -> None:
        """Filled, or with a border of `width`; corners (K, 2)."""
        self._pg.draw.polygon(self._large, color, (_FINE * corners).tolist(), round(_FINE * width))

    def marker(self, outline: FloatArray, at: FloatArray, heading: float, color: Any, width: float = 0.0) -> None:
        """A shape (K, 2), its second axis up, turned by `heading` (rad) and moved to a pixel (2,)."""
        cos, sin = math.cos(heading), math.sin(heading)
        self.polygon(at + outline @ np.array([[cos, -sin], [-sin, -cos]]), color, width)

    def box(self, rect: Rect, color: str, tint: float = 0.1) -> None:
        """A rectangle with a border; its inside is tinted, unless it covers the whole view."""
        left, top, width, height = (_FINE * edge for edge in rect)
        area = self._pg.Rect(
            round(left), round(top), round(left + width) - round(left), round(top + height) - round(top)
        )
        visible = area.clip(self._large.get_clip())
        if visible != self._large.get_clip():
            inside = self._pg.Surface(visible.size)
            inside.fill(color)
            inside.set_alpha(round(255 * tint))
            self._large.blit(inside, visible)
        border = round(_FINE * 1.5)  # half of it on either side of the edge; pygame draws all of it inside
        self._pg.draw.rect(self._large, color, area.inflate(border, border), border)

    def measure(self, text: str, size: int) -> tuple[int, int]:
        """Width and height of a text in pixels."""
        width, height = self._font(size).size(text)
        return width, height

    def text(
        self,
        text: str,
        at: tuple[float, float],
        size: int,
        *,
        color: str = INK,
        anchor: tuple[float, float] = (0.0, 0.5),
        halo: bool = False,
        room: float = math.inf,
        upright: bool = False,
    ) -> None:
        """Text with the point `anchor` of its box, as fractions of width and height, at `at`; cut off to fit `room`."""
        while self.measure(text, size)[0] > room and len(text) > 1:
            text = text[:-2] + "…"
        image = self._written(text, size, color, halo, upright)
        left, top = (round(p - a * extent) for p, a, extent in zip(at, anchor, image.get_size(), strict=True))
        self._texts.append((image, (left, top)))

    def _write(self, text: str, size: int, color: str, halo: bool, upright: bool) -> Any:
        letters = self._font(size).render(text, True, color)
        if upright:
            return self._pg.transform.rotate(letters, 90)
        if not halo:
            return letters
        image = self._pg.Surface((letters.get_width() + 4, letters.get_height() + 4), self._pg.SRCALPHA)
        white = self._font(size).render(text, True, "white")
        image.blits([(white, (x, y)) for x in range(5) for y in range(5) if (x - 2) ** 2 + (y - 2) ** 2 < 6])
        image.blit(letters, (2, 2))
        return image

    def _open_font(self, size: int) -> Any:
        return self._pg.font.Font(self._font_file, size)


class Window:
    """A window on the screen; there may be several. Without a display nothing is visible, and a message says so.

    Args:
        size: in pixels.
        title: of the window.

    Raises:
        ImportError: for pygame in place of pygame-ce; it has one window only.
    """

    def __init__(self, size: tuple[int, int], title: str) -> None:
        pg = self._pg = load_pygame()
        if not hasattr(pg, "Window"):
            raise ImportError(
                f"windows need pygame-ce, and pygame {pg.version.ver} stands in its place: pip uninstall pygame, and "
                "then pip install --force-reinstall pygame-ce"
            )
        self._size, self._title, self._dismissed = size, title or "khop_env", False
        self._clock = pg.time.Clock()
        self._open()
        _windows.add(self)

    def show(self, canvas: Canvas) -> bool:
        """Show a picture, wait to keep the frame rate, and return True if the user has closed the window."""
        try:
            surface = self._window.get_surface()
        except self._pg.error:  # others have called pygame.quit() or pygame.display.quit(), which close every window
            self._open()
            surface = self._window.get_surface()
        surface.blit(canvas.surface, (0, 0))
        self._window.flip()
        self._clock.tick(FRAMES_PER_SECOND)
        self._read_events()
        return self._dismissed

    def close(self) -> None:
        """Close this window only."""
        self._window.destroy()
        _windows.discard(self)

    def _open(self) -> None:
        pg = self._pg
        if sys.platform == "linux" and not {"DISPLAY", "WAYLAND_DISPLAY"} & set(os.environ):
            os.environ.setdefault("SDL_VIDEODRIVER", "dummy")
        pg.display.init()
        if pg.display.get_driver() in ("dummy", "offscreen"):
            _say_once('khop_env: there is no display to show frames on; render_mode="rgb_array" returns them as arrays')
        self._window = pg.Window(self._title, self._size)

    def _read_events(self) -> None:
        """Pass closing events to all of our windows; there is one queue, and events of other windows stay in it."""
        pg = self._pg
        ours_alone = pg.display.get_surface() is None  # then no other window's owner empties the queue
        for event in pg.event.get(None if ours_alone else (pg.QUIT, pg.WINDOWCLOSE)):
            if event.type == pg.QUIT:
                for window in _windows:
                    window._dismissed = True
            elif event.type == pg.WINDOWCLOSE:
                closed = [window for window in _windows if window._window is event.window]
                for window in closed:
                    window._dismissed = True
                if not closed:
                    pg.event.post(event)


_windows: weakref.WeakSet[Window] = weakref.WeakSet()


@functools.cache
def _say_once(text: str) -> None:
    print(text, file=sys.stderr)
