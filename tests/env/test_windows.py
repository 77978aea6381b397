"""Windows show the frames, several of them and beside those of others, and open again when others ended pygame."""

import os
import pickle
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest

import khop_env
from khop_env.env.rendering import canvas
from tests.env.drawing import renderer, scene


@pytest.fixture(autouse=True)
def no_screen(monkeypatch):
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")


def pixels(drawn):
    return canvas.load_pygame().surfarray.array3d(drawn._window._window.get_surface()).swapaxes(0, 1)


def test_shows_the_frame():
    drawn = renderer()
    drawn.show(scene())
    assert np.array_equal(pixels(drawn), renderer().frame(scene()))
    assert pickle.loads(pickle.dumps(drawn))._window is None  # one can't be copied
    drawn.close()
    drawn.close()
    assert drawn._window is None
    drawn.show(scene())  # opens again
    drawn.close()


@pytest.mark.parametrize("kind", ["WINDOWCLOSE", "QUIT"])
def test_closed_by_hand_it_stays_closed(kind):
    pygame = canvas.load_pygame()
    drawn = renderer()
    drawn.show(scene())
    event = {"window": drawn._window._window} if kind == "WINDOWCLOSE" else {}
    pygame.event.post(pygame.event.Event(getattr(pygame, kind), event))
    for t in (0.1, 0.2):
        drawn.show(scene(t))
        assert drawn._window is None
    assert drawn.frame(scene(0.3)).shape == (720, 900, 3)
    drawn.close()


def test_two_windows_live_together():
    """Each shows its own pictures; one closed by hand, and one closed by its environment, leave the others."""
    pygame = canvas.load_pygame()
    first, second, third = renderer(), renderer(size=(640, 480)), renderer()
    moved = scene(0.1, x=(0.5, 0.5, 3.0, 1.0, 1.0, -2.0))
    first.show(scene())
    for drawn in (second, third):
        drawn.show(moved)
    assert np.array_equal(pixels(first), renderer().frame(scene()))
    assert np.array_equal(pixels(second), renderer(size=(640, 480)).frame(moved))
    third.close()
    pygame.event.post(pygame.event.Event(pygame.WINDOWCLOSE, window=first._window._window))
    second.show(scene(0.2))
    assert second._window is not None  # although it was the one that read the event
    first.show(scene(0.2))
    assert first._window is None
    second.show(scene(0.3))
    pygame.event.post(pygame.event.Event(pygame.QUIT))  # the whole program is to end
    first.close()
    first.show(scene(0.4))
    second.show(scene(0.4))
    assert first._window is second._window is None


def test_windows_of_others_stay():
    """Theirs is drawn on as before after ours was closed, and their events stay in the queue."""
    pygame = canvas.load_pygame()
    pygame.display.init()
    theirs, other = pygame.display.set_mode((40, 30)), pygame.Window("other", (20, 20))
    drawn = renderer()
    pygame.event.get()
    pygame.event.post(pygame.event.Event(pygame.KEYDOWN, key=pygame.K_a))
    pygame.event.post(pygame.event.Event(pygame.WINDOWCLOSE, window=other))
    drawn.show(scene())
    drawn.close()
    assert pygame.display.get_surface() is theirs
    theirs.fill("red")
    pygame.display.flip()
    found = [(event.type, getattr(event, "window", None)) for event in pygame.event.get()]
    assert (pygame.WINDOWCLOSE, other) in found
    assert pygame.KEYDOWN in dict(found)
    pygame.display.quit()


@pytest.mark.parametrize("end", ["display.quit", "quit", "quit and init"])
def test_a_window_closed_by_others_opens_again(end):
    """Another environment's close() or anybody's pygame.quit(), after which others may have gone on."""
    pygame = canvas.load_pygame()
    drawn = renderer()
    drawn.show(scene())
    (pygame.display.quit if end == "display.quit" else pygame.quit)()
    if end == "quit and init":
        pygame.display.init()
        pygame.font.init()
    drawn.show(scene())
    assert np.array_equal(pixels(drawn), renderer().frame(scene()))
    pygame.quit()
    drawn.close()


def test_pygame_in_place_of_pygame_ce_is_named(monkeypatch):
    monkeypatch.delattr(canvas.load_pygame(), "Window")
    with pytest.raises(ImportError, match=r"windows need pygame-ce, and pygame .* stands in its place: pip uninst"):
        renderer().show(scene())


def test_without_a_display_there_are_neither_errors_nor_warnings():
    script = (
        "import sys; sys.path.insert(0, 'tests/env'); import test_rendering as here\n"
        "drawn = here.renderer(); frame = drawn.frame(here.scene()); assert frame.min() < 100\n"
        "import pygame; assert not pygame.display.get_init()\n"
        "drawn.show(here.scene(0.1)); drawn.show(here.scene(0.2)); drawn.close()"
    )
    hidden = ("DISPLAY", "WAYLAND_DISPLAY", "SDL_VIDEODRIVER", "PYGAME_HIDE_SUPPORT_PROMPT")
    root = Path(khop_env.__file__).parents[1]
    environment = {name: value for name, value in os.environ.items() if name not in hidden}
    environment["PYTHONPATH"] = str(root)
    done = subprocess.run(
        [sys.executable, "-W", "error", "-c", script], cwd=root, env=environment, capture_output=True, text=True
    )
    assert done.returncode == 0, done.stderr
    assert done.stdout == ""  # pygame's greeting would spoil it
    assert done.stderr.count("khop_env: there is no display") == 1
