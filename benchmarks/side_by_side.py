"""One episode twice in a film, side by side: the same starts, disturbances and losses under two policies."""

from __future__ import annotations

import functools
from collections.abc import Callable, Iterator, Mapping, Sequence
from typing import Any, NamedTuple

import numpy as np
from numpy.typing import NDArray

from agents.policies import make_policy, needs
from agents.running import PolicyRun
from khop_env.env.rendering import Renderer, Scene
from khop_env.env.rendering.estimates import Estimates, default_observer
from khop_env.env.rendering.on_map import Extent
from khop_env.observers import FloatArray
from khop_env.registry import make, scenario
from khop_env.tasks import MapCanvas

SIZE = (444, 480)  # pixels of a map; the strip is beside the second
STRIP = 147  # what `Renderer` takes for it at this size, so that both maps are equally wide
ROOM = 0.08  # of the view's width, at its top, for the line of text
INK, BAD, GOOD = "#222222", "#cc3311", "#228833"


class Side:
    """One of the two episodes.

    Args:
        title: above the map.
        run: at the beginning of the episode.
        observer: index of the agent whose estimates are drawn; None as in `Renderer`.
        panel: whether time and legend are beside the map.

    Attributes:
        run: the episode.
        collisions: agents that have begun to touch something, where agents may collide.
    """

    def __init__(self, title: str, run: PolicyRun, observer: int | None, panel: bool) -> None:
        self.title, self.run, self.collisions = title, run, 0
        self._batched = batched = run.env.batched
        task, observers = batched.task, batched.simulator.observers
        design = batched.world.design
        chosen = default_observer(design, task.edges) if observer is None else observer
        self._estimates = Estimates(design, chosen, observers.layout)
        size = (SIZE[0] + STRIP * panel, SIZE[1])
        self._renderer = Renderer.of(task, batched.world, observers, observer=chosen, panel=panel, size=size)
        self._touching: set[int] = set()

    def step(self) -> None:
        """A control period, unless the episode is over."""
        if self.run.ended():
            return
        self.run.step(self._batched.settings.control_period)
        cost = self._batched.task.evaluate(self._batched.world).infos.get("cost")
        touching = set() if cost is None else set(np.flatnonzero(cost[0]).tolist())
        self.collisions += len(touching - self._touching)
        self._touching = touching
        simulator = self._batched.simulator
        self._renderer.remember(float(simulator.t[0]), simulator.x[0])

    def scene(self) -> Scene:
        """What is to be drawn now."""
        return Scene.of(
            self._batched.simulator, None, functools.partial(self._batched.task.draw, world=self._batched.world)
        )

    def in_view(self, scene: Scene) -> FloatArray:
        """(K, 2) points in m that the view has to hold: agents, estimates, what a view follows of their boxes, and what
        the task draws.
        """
        positions = self._batched.world.positions()[..., 0]
        middles, extent = self._estimates.positions(scene.estimates), Extent()
        half = self._estimates.half_widths_in_view(scene.bounds)
        if scene.decorate is not None:
            scene.decorate(extent)
        if extent.points:  # as in `Renderer`
            half = np.zeros_like(half)
        points = np.concatenate([positions, middles - half, middles + half])[:, :2]
        points = np.concatenate([np.pad(points, ((0, 0), (0, 2 - points.shape[1]))), *extent.points])
        found: FloatArray = points[np.isfinite(points).all(axis=1)]
        return found

    def frame(self, scene: Scene, status: tuple[str, str]) -> NDArray[np.uint8]:
        """The picture, with its title and a line of text in a colour."""
        from PIL import Image, ImageDraw

        picture = Image.fromarray(self._renderer.frame(scene))
        pen = ImageDraw.Draw(picture)
        pen.text((44, 15), self.title, INK, _font(13), anchor="lm")
        at = SIZE[0] - 22, 44
        left, top, right, bottom = pen.textbbox(at, status[0], _font(12), anchor="rm")
        pen.rectangle((left - 3, top - 2, right + 3, bottom + 2), "white")
        pen.text(at, status[0], status[1], _font(12), anchor="rm")
        return np.asarray(picture)


class Pictures(NamedTuple):
    """A film, picture by picture.

    Attributes:
        sides: both episodes, which `frames` moves on.
        frames: (H, W, 3) each.
    """

    sides: tuple[Side, Side]
    frames: Iterator[NDArray[np.uint8]]


def side_by_side(
    environment: str,
    policies: Mapping[str, str],
    status: Callable[[Side], tuple[str, str]],
    *,
    scenario_name: str,
    seed: int,
    every: float,
    duration: float | None = None,
    observer: int | None = None,
    shared_view: bool = True,
    arguments: Mapping[str, Any] | None = None,
) -> Pictures:
    """The same episode under two policies, until both are over.

    Args:
        environment: its name.
        policies: two of them, as `make_policy` takes them, by title.
        status: text and colour of the line in a side's map.
        scenario_name: as `khop_env.scenario` takes it.
        seed: of the episode.
        every: time between pictures in s, rounded to control periods.
        duration: of the film in s; None for the whole episode.
        observer: index of the agent whose estimates are drawn; None as in `Renderer`.
        shared_view: whether both maps show the same part of the plane.
        arguments: of the environment.

    Raises:
        ValueError: if the two episodes don't begin in the same state.
    """
    first, second = (
        Side(title, run_of(environment, spec, scenario_name, seed, arguments or {}), observer, panel)
        for (title, spec), panel in zip(policies.items(), (False, True), strict=True)
    )
    if not np.array_equal(first.run.simulator.x, second.run.simulator.x):
        raise ValueError(f"{environment} on {scenario_name}, seed {seed}: the two sides begin in different states")
    sides = first, second
    return Pictures(sides, _frames(sides, status, every, duration, shared_view))


def run_of(environment: str, spec: str, scenario_name: str, seed: int, arguments: Mapping[str, Any]) -> PolicyRun:
    """A policy at the beginning of an episode.

    The environment has what the policy observes and sends. A learned policy's further arguments, which its training
    had, aren't taken on, so that returns of two policies are of the same task.
    """
    policy, where = make_policy(spec), scenario(scenario_name)
    env = make(environment, where, observe="estimate", **needs(policy).among(arguments, where))
    return PolicyRun(env, policy, seed, spec)


def _frames(
    sides: tuple[Side, Side],
    status: Callable[[Side], tuple[str, str]],
    every: float,
    duration: float | None,
    shared_view: bool,
) -> Iterator[NDArray[np.uint8]]:
    settings = sides[0].run.env.batched.settings
    cycles = max(1, round(every / settings.control_period))
    most = settings.horizon if duration is None else round(duration / settings.control_period)
    yield _joined(sides, status, shared_view)
    for _ in range(0, most, cycles):
        if all(side.run.ended() for side in sides):
            break
        for side in sides * cycles:
            side.step()
        yield _joined(sides, status, shared_view)


def _joined(sides: Sequence[Side], status: Callable[[Side], tuple[str, str]], shared_view: bool) -> NDArray[np.uint8]:
    scenes = [side.scene() for side in sides]
    if shared_view:
        points = np.concatenate([side.in_view(scene) for side, scene in zip(sides, scenes, strict=True)])
        low, high = points.min(axis=0), points.max(axis=0)
        top = np.array([[(low[0] + high[0]) / 2, high[1] + ROOM * (high - low).max()]])
        held = np.concatenate([points, top])
        scenes = [scene._replace(decorate=_Holding(scene.decorate, held)) for scene in scenes]
    worst = max(scene.ratio for scene in scenes)  # the gauge is beside both
    pictures = np.hstack(
        [side.frame(scene._replace(ratio=worst), status(side)) for side, scene in zip(sides, scenes, strict=True)]
    )
    return pictures[:, : pictures.shape[1] // 2 * 2]  # films in .mp4 need an even width


class _Holding:
    """What a task draws, and points that the view has to hold."""

    def __init__(self, draw: Callable[[MapCanvas], None] | None, points: FloatArray) -> None:
        self._draw, self._points = draw, points

    def __call__(self, canvas: MapCanvas) -> None:
        if self._draw is not None:
            self._draw(canvas)
        if isinstance(canvas, Extent):
            canvas.line(self._points, INK)


@functools.cache
def _font(size: int) -> Any:
    import matplotlib
    from PIL import ImageFont

    return ImageFont.truetype(f"{matplotlib.get_data_path()}/fonts/ttf/DejaVuSans-Bold.ttf", size)
