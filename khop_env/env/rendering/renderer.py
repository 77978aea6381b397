"""Frames of a running fleet: positions, communication graph, task edges, and the estimates of one agent."""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from khop_env.env.rendering.camera import Camera, Labels
from khop_env.env.rendering.canvas import Canvas, Window
from khop_env.env.rendering.estimates import Estimates, default_observer
from khop_env.env.rendering.links import LinkLines
from khop_env.env.rendering.looks import PALE, SOFT, angles, headings, looks, sensible, short_names, undirected
from khop_env.env.rendering.on_map import Extent, OnMap
from khop_env.env.rendering.panel import Panel, draw_agent, draw_task_edge
from khop_env.env.rendering.scene import Scene
from khop_env.env.rendering.trails import Trails
from khop_env.network import PROFILES, Network
from khop_env.observers import FloatArray, IntArray, Networked, ObserverDesign, Observers, PairLayout
from khop_env.tasks import Task, World

_MOST_LABELS = 40  # in larger fleets only the observer and its targets are labelled


class Renderer:
    """Draws the state of a fleet as pictures, or in a window.

    Agents by type, communication links solid, with an arrow where they go one way, and task edges dashed; for one
    agent its estimates: hollow markers at the estimated positions of its targets, each in the box that is guaranteed to
    hold the target. Under a network neighbours are among the targets, boxes grow with the age of what has arrived, and
    links whose newest messages are lost fade. Fleets in space are seen from above, fleets on a line have a row for each
    agent.

    Args:
        design: the observers, with the fleet and the communication graph.
        task_edges: (E, 2) directed pairs (i, j): agent i acts on j.
        layout: of the estimates; that of the design's observers by default.
        network: over which agents exchange messages; None for continuous exchange.
        estimator: its name, under a network.
        driven: indices of the agents that don't act, marked with a star.
        driven_label: their name in the legend.
        observer: index of the agent whose estimates are drawn; by default the agent with most task edges to k-hop
            targets.
        title: text above the picture.
        error_label: name of the error beside the map.
        error_unit: its unit; by default that of positions.
        panel: whether there is a strip with time, errors and legend beside the map.
        size: width and height in pixels.

    Attributes:
        observer: index of the agent whose estimates are drawn.

    Raises:
        ValueError: for an observer or a driven agent that isn't in the fleet.
    """

    def __init__(
        self,
        design: ObserverDesign,
        task_edges: IntArray,
        *,
        layout: PairLayout | None = None,
        network: Network | None = None,
        estimator: str = "",
        driven: Sequence[int] = (),
        driven_label: str = "driven agent",
        observer: int | None = None,
        title: str = "",
        error_label: str = "task error",
        error_unit: str | None = None,
        panel: bool = True,
        size: tuple[int, int] = (900, 720),
    ) -> None:
        fleet, agents = design.fleet, len(design.fleet)
        self._fleet, self._title, self._size = fleet, title, size
        self._driven = frozenset(fleet.agent(agent) for agent in driven)
        self.observer = default_observer(design, task_edges) if observer is None else fleet.agent(observer)
        self._estimates = Estimates(design, self.observer, layout)
        self._tasks = undirected(task_edges)
        self._headings = headings(fleet)
        self._looks = looks(fleet.models)
        self._look = [self._looks[model.type] for model in fleet.models]
        self._names = short_names(fleet)
        self._crowded = agents > _MOST_LABELS
        self._labelled = [self.observer, *self._estimates.targets] if self._crowded else list(range(agents))

        self._unit = max(0.75, min(size[0] / 900, size[1] / 720))
        self._radius = self._unit * float(np.clip(9.0 * math.sqrt(20 / agents), 4.5, 9.0))
        self._thin = self._unit * (0.5 if self._crowded else 1.0)
        self._links = LinkLines(design.links, self._radius, self._thin)
        self._neighbors = frozenset(self._links.pairs)
        strip = (212 if panel else 16) * self._unit
        left, top, bottom = 58 * self._unit, 40 * self._unit, 50 * self._unit
        self._map = (left, top, size[0] - left - strip, size[1] - top - bottom)
        self._rows = top + self._map[3] * (np.arange(agents) + 0.5) / agents
        self._panel = Panel(
            (size[0] - strip + 20 * self._unit, top, strip - 36 * self._unit, self._map[3]),
            self._unit,
            {f"{kind}  {self._span(kind)}": look for kind, look in self._looks.items()},
            driven=driven_label if self._driven else None,
            task=bool(self._tasks),
            observer=(fleet.ids[self.observer], self._look[self.observer]) if self._estimates.targets else None,
            error_label=error_label,
            error_unit=fleet.position_unit() if error_unit is None else error_unit,
            estimator=estimator,
        )
        self._with_panel = panel
        self._network = "" if network is None or not panel else described(network)
        self._canvas: Canvas | None = None
        self._window: Window | None = None
        self._dismissed = False
        self.restart()

    @classmethod
    def of(cls, task: Task, world: World, observers: Observers, **arguments: Any) -> Renderer:
        """A renderer of a task's fleet: its edges, and the agents that don't act.

        Args:
            task: bound to the fleet.
            world: of the task.
            observers: of its simulator.
            arguments: other arguments of the renderer.
        """
        acting = set(task.acting(world))
        driven = [i for i in range(len(world.fleet)) if i not in acting]
        label, unit = task.driven_label, task.error_unit(world)
        arguments |= {"driven": driven, "driven_label": label, "error_unit": unit, "layout": observers.layout}
        if isinstance(observers, Networked):
            arguments |= {"network": observers.network, "estimator": observers.estimator.name}
        return cls(world.design, task.edges, **arguments)

    def restart(self) -> None:
        """Begin a new episode: clear the trails, the view and the places of labels."""
        self._trails = Trails(self._look, 0.3 if self._crowded else 0.6, 2.0 * self._thin)
        self._drawn = -math.inf
        self._labels = Labels()
        self._camera = Camera(self._map, margin=38 * self._unit)

    def remember(self, t: float, x: FloatArray) -> None:
        """Add to the trails, without a picture. A time before the last one's begins a new episode.

        Args:
            t: in s.
            x: (n,) state of the fleet.
        """
        points = self._trails.points
        if points and t < points[-1][0]:
            self.restart()
        self._trails.add(t, self._positions(x))

    def frame(self, scene: Scene) -> NDArray[np.uint8]:
        """One picture (H, W, 3), a fresh array. A time before the last one's begins a new episode.

        Raises:
            ModuleNotFoundError: without pygame-ce.
        """
        return self._draw(scene).array()

    def show(self, scene: Scene) -> None:
        """Show the picture that `frame` would return in a window, at most 25 pictures a second.

        After the user has closed the window, nothing is drawn. Without a display nothing is visible.

        Raises:
            ModuleNotFoundError: without pygame-ce.
        """
        if self._dismissed:
            return
        if self._window is None:
            self._window = Window(self._size, self._title)
        if self._window.show(self._draw(scene)):
            self.close()
            self._dismissed = True

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._window is not None:
            self._window.close()
        self._window, self._dismissed = None, False

    def __getstate__(self) -> dict[str, Any]:
        """Without the window, surfaces and fonts, which can't be copied."""
        return {**self.__dict__, "_canvas": None, "_window": None}

    def _span(self, kind: str) -> str:
        names = [name for name, model in zip(self._names, self._fleet.models, strict=True) if model.type == kind]
        return names[0] if len(names) == 1 else f"{names[0]}–{names[-1]}"

    def _draw(self, scene: Scene) -> Canvas:
        canvas = self._canvas = self._canvas or Canvas(self._size)
        self.remember(scene.t, scene.x)
        positions, estimated = self._positions(scene.x), self._estimates.positions(scene.estimates)
        self._follow(positions, estimated, scene)
        everyone, targets = np.arange(len(positions)), np.array(self._estimates.targets, int)
        middles, estimate_pixels = self._pixels(positions, everyone), self._pixels(estimated, targets)

        canvas.clear()
        self._draw_grid(canvas)
        canvas.clip(self._map)
        self._trails.draw(canvas, scene.t, lambda points: self._pixels(points, everyone))
        half = self._estimates.half_widths(scene.bounds)
        unbounded = int(np.count_nonzero(~np.isfinite(half).all(axis=1)))
        hidden = self._draw_boxes(canvas, estimated, half)
        additions = OnMap(canvas, self._pixels_in_plane, self._camera.meters, self._radius)
        if scene.decorate is not None:
            scene.decorate(additions)
        self._links.draw(canvas, middles, scene)
        for i, j in self._tasks:
            if np.isfinite(middles[[i, j]]).all():
                draw_task_edge(canvas, middles[[i, j]], self._unit, self._thin, beside=(i, j) in self._neighbors)
        self._draw_agents(canvas, scene.x, middles)
        self._draw_estimates(canvas, scene.estimates, middles, estimate_pixels)
        self._draw_labels(canvas, middles, estimate_pixels)
        canvas.clip(None)
        if self._with_panel:
            ages = None if scene.messages is None else self._estimates.ages(scene.messages)
            self._panel.draw(canvas, scene, hidden, unbounded, ages, additions)
        canvas.finish()
        return canvas

    def _positions(self, x: FloatArray) -> FloatArray:
        """(N, d) positions in m, d at most 2; nan where they make no sense."""
        return sensible(x[self._fleet.position_index[:, :2]])

    def _follow(self, positions: FloatArray, estimated: FloatArray, scene: Scene) -> None:
        extent = Extent()
        if scene.decorate is not None:
            scene.decorate(extent)
        boxes = [estimated]
        if not extent.points:  # otherwise the task says what is to be seen, and the view is steady
            half = self._estimates.half_widths_in_view(scene.bounds)
            boxes = [estimated - half, estimated + half]
        points = np.concatenate([positions, *boxes])
        points = np.concatenate([np.pad(points, ((0, 0), (0, 2 - points.shape[1]))), *map(sensible, extent.points)])
        self._camera.follow(points[np.all(np.isfinite(points), axis=1)], scene.t - self._drawn)
        self._drawn = scene.t

    def _pixels(self, points: FloatArray, agents: IntArray) -> FloatArray:
        """(..., K, 2) pixels of points (..., K, d) in m that belong to `agents` (K,)."""
        if points.shape[-1] == 1:
            pixels = self._camera.pixels(np.concatenate([points, np.zeros_like(points)], axis=-1))
            pixels[..., 1] = self._rows[agents]
        else:
            pixels = self._camera.pixels(points)
        return np.clip(pixels, -9999.0, 9999.0)  # points far out of view must fit into pygame's integers

    def _pixels_in_plane(self, points: FloatArray) -> FloatArray:
        """(..., 2) pixels of points (..., 2) in m that belong to no agent."""
        return np.clip(self._camera.pixels(points), -9999.0, 9999.0)

    def _draw_grid(self, canvas: Canvas) -> None:
        left, top, width, height = self._map
        size = round(11 * self._unit)
        for x, text in self._camera.ticks(0):
            canvas.line(np.array([[x, top], [x, top + height]]), PALE, 1.0)
            canvas.text(text, (x, top + height + 10 * self._unit), size, color=SOFT, anchor=(0.5, 0.5))
        middle = left + width / 2, top + height + 30 * self._unit
        canvas.text(f"first coordinate ({self._fleet.position_unit(0)})", middle, size, color=SOFT, anchor=(0.5, 0.5))
        if self._fleet.position_dim > 1:
            for y, text in self._camera.ticks(1):
                canvas.line(np.array([[left, y], [left + width, y]]), PALE, 1.0)
                canvas.text(text, (left - 6 * self._unit, y), size, color=SOFT, anchor=(1.0, 0.5))
            middle = 11 * self._unit, top + height / 2
            label = f"second coordinate ({self._fleet.position_unit(1)})"
            canvas.text(label, middle, size, color=SOFT, anchor=(0.5, 0.5), upright=True)
        corners = np.array([[left, top], [left + width, top], [left + width, top + height], [left, top + height]])
        canvas.polygon(corners, "#BBBBBB", 1.0)
        titled = round(14 * self._unit)
        canvas.text(self._title, (left, top / 2), titled, room=self._size[0] - 2 * left)
        if self._network:
            right = self._size[0] - 16 * self._unit
            room = right - left - canvas.measure(self._title, titled)[0] - 20 * self._unit
            canvas.text(self._network, (right, top / 2), size, color=SOFT, anchor=(1.0, 0.5), room=room)

    def _draw_boxes(self, canvas: Canvas, estimated: FloatArray, half: FloatArray) -> int:
        """Draw the guaranteed boxes, and return the number of boxes whose edges are all out of view.

        A target with an infinite bound has no box.
        """
        left, top, width, height = self._map
        half = np.where(np.isfinite(half).all(axis=1, keepdims=True), half, np.nan)
        targets = np.array(self._estimates.targets, int)
        low, high = self._pixels(estimated - half, targets), self._pixels(estimated + half, targets)
        hidden = 0
        for target, (x1, y1), (x2, y2) in zip(targets, low, high, strict=True):
            if not np.isfinite([x1, y1, x2, y2]).all():
                continue
            if estimated.shape[1] == 1:
                y1, y2 = y1 + 1.8 * self._radius, y2 - 1.8 * self._radius
            canvas.box((x1, y2, x2 - x1, y1 - y2), self._look[target].color, min(0.1, 0.3 / len(targets)))
            hidden += x1 < left and x2 > left + width and y2 < top and y1 > top + height
        return hidden

    def _draw_agents(self, canvas: Canvas, x: FloatArray, middles: FloatArray) -> None:
        turned = angles(self._headings, x)
        for agent in np.flatnonzero(np.isfinite(middles).all(axis=1)).tolist():
            at, look = middles[agent], self._look[agent]
            observing = agent == self.observer and bool(self._estimates.targets)
            draw_agent(canvas, look, at, turned[agent], self._radius, star=agent in self._driven, ring=observing)

    def _draw_estimates(
        self, canvas: Canvas, estimates: FloatArray, middles: FloatArray, estimated: FloatArray
    ) -> None:
        turned = self._estimates.headings(estimates)
        for target, at, heading in zip(self._estimates.targets, estimated, turned, strict=True):
            if not np.isfinite(at).all():
                continue
            color = self._look[target].color
            if np.isfinite(middles[target]).all():
                canvas.line(np.array([at, middles[target]]), color, 1.0 * self._unit)
            canvas.marker(1.55 * self._radius * self._look[target].outline, at, heading, color, 1.5 * self._unit)

    def _draw_labels(self, canvas: Canvas, middles: FloatArray, estimated: FloatArray) -> None:
        """Write short names where they cover no marker, with a line to their own marker if it isn't near."""
        size = round(12 * self._unit)
        reach = np.full(len(middles), 1.2 * self._radius)
        estimate_reach = 2.0 * self._radius
        reach[[self.observer] * bool(self._estimates.targets)] = estimate_reach
        for target, at in zip(self._estimates.targets, estimated, strict=True):
            if np.hypot(*(at - middles[target])) < estimate_reach:
                reach[target] = estimate_reach
        visible = [agent for agent in self._labelled if np.isfinite(middles[agent]).all()]
        extent = np.array([canvas.measure(self._names[agent], size) for agent in visible]).reshape(-1, 2)
        markers = [
            np.hstack([middles - reach[:, None], middles + reach[:, None]]),
            np.hstack([estimated - estimate_reach, estimated + estimate_reach]),
        ]
        taken = np.concatenate(markers)
        taken = taken[np.isfinite(taken).all(axis=1)]
        places = self._labels.place(middles[visible], extent, reach[visible], taken, self._map)
        for number, (middle, far) in places.items():
            if far:
                canvas.line(np.array([middle, middles[visible[number]]]), SOFT, 0.75)
            text = self._names[visible[number]]
            canvas.text(text, tuple(middle), size, anchor=(0.5, 0.5), halo=True)


def described(network: Network) -> str:
    """A network in a line, with its profile's name if it has one."""
    name = next((f"network {name}: " for name, profile in PROFILES.items() if profile == network), "")
    return name + network.described().replace("+-", "±")
