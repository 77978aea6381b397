"""A world against the safety filter, of any agents: everybody rams the nearest, and errors are on their bounds."""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np

from agents import EnvDescription
from khop_env.env.layout import Field, ObservationLayout, Slot
from khop_env.physics import AgentModel, DoubleIntegrator, SurfaceVessel
from tests.agents.ramming import nearest_on

LIMIT = 100.0
PUSHED = {
    "integrator": (0.1, 0.1),
    "drifter": (0.1, 0.1),
    "cart": (0, 0, 0.1, 0.1),
    "unicycle": (0, 0, 0.3),
    "vessel": (0, 0, 0, 0.1, 0.1, 0),
}
# Half widths of boxes, as shares of `largest`: metres, m/s or rad.
BOUNDS = {
    "x1": 1.0,
    "x2": 1.0,
    "x": 1.0,
    "y": 1.0,
    "vx": 2.0,
    "vy": 2.0,
    "heading": 5.0,
    "surge": 1.0,
    "sway": 1.0,
    "yaw_rate": 1.0,
}


@dataclass
class RammingTeam:
    """Agents of any model in B worlds, observed with errors on the faces of their boxes, in Euler steps.

    Args:
        models: of the agents.
        batch: B.
        steps: of the simulator in a control period.
        largest: largest half width of the box of a position, in m.
        missing: half widths of positions are observed smaller than the errors by this, in m.
        obstacles: (M, 3) discs x, y, radius.
        period: in s.
        radius: of a body, in m.
        ring: distance between neighbours at the start, in m.
        shift: of the whole world along both axes, in m.
    """

    models: list[AgentModel]
    batch: int = 100
    steps: int = 1
    largest: float = 0.3
    missing: float = 0.0
    obstacles: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    period: float = 0.05
    radius: float = 0.2
    ring: float = 0.6
    shift: float = 0.0

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(0)
        count = len(self.models)
        angle = 2.0 * math.pi * np.arange(count) / count
        places = self.ring / math.sin(math.pi / max(count, 3)) * np.column_stack([np.cos(angle), np.sin(angle)])
        self.ids = [f"{model.type}_{i}" for i, model in enumerate(self.models)]
        self.x = [np.zeros((self.batch, model.n)) for model in self.models]
        for i, (model, x) in enumerate(zip(self.models, self.x, strict=True)):
            x[:, :2] = places[i] + self.shift
            if "heading" in model.states:
                x[:, 2] = self.rng.uniform(-math.pi, math.pi, self.batch)
        self.closest = np.full(self.batch, math.inf)
        self.clearance = np.full(self.batch, math.inf)
        self.side = np.ones((self.batch, count, 1))

    def description(self) -> EnvDescription:
        """All agents know of each other, by messages."""
        layouts = {}
        for i, agent in enumerate(self.ids):
            fields = [Field(f"own.{name}", "", *_range(name)) for name in _names(self.models[i])]
            fields += [Field("radius", "m", 0.0, LIMIT)]
            near = [f"obstacle{q}.{axis}" for q in range(len(self.obstacles)) for axis in "xy"]
            fields += [Field(name, "m", -2 * LIMIT, 2 * LIMIT) for name in near]
            slots = [Slot(j, other, False, 1, True) for j, other in enumerate(self.ids) if j != i]
            for number, slot in enumerate(slots):
                name, model = f"slot{number}", self.models[slot.agent]
                fields += [Field(f"{name}.valid", "", 0.0, 1.0), Field(f"{name}.age", "s", 0.0, LIMIT)]
                fields += [Field(f"{name}.position.{axis}", "m", -2 * LIMIT, 2 * LIMIT) for axis in "xy"]
                fields += [Field(f"{name}.{each}", "", *_range(each)) for each in _names(model)[2:]]
                fields += [Field(f"{name}.bound.{each}", "", 0.0, LIMIT) for each in model.states]
            layouts[agent] = ObservationLayout(agent, fields, slots)
        models = dict(zip(self.ids, self.models, strict=True))
        pushed = {agent: np.array(PUSHED[model.type], float) for agent, model in models.items()}
        sizes = {agent: model.m for agent, model in models.items()}
        return EnvDescription(
            "test_v0", "ring", "estimate", self.period, models, layouts, sizes, disturbance=pushed, steps=self.steps
        )

    def observations(self, env: EnvDescription) -> dict[str, np.ndarray]:
        """Each pair's error is on a corner of its box, whose size jumps: both sides know differently much."""
        found = {}
        for i, (agent, layout) in enumerate(env.layouts.items()):
            values: dict[str, object] = {"radius": self.radius}
            values |= {f"own.{name}": each for name, each in _seen(self.models[i], self.x[i]).items()}
            gap = self.to_obstacles(self.x[i][:, :2])
            for q in range(len(self.obstacles)):
                values |= {f"obstacle{q}.x": gap[:, q, 0], f"obstacle{q}.y": gap[:, q, 1]}
            for number, slot in enumerate(layout.slots):
                name, model, true = f"slot{number}", self.models[slot.agent], self.x[slot.agent]
                scale = self.largest * np.array([BOUNDS.get(each, 1.0) for each in model.states])
                size = scale * self.rng.random((self.batch, model.n)) * self.rng.integers(0, 2, (self.batch, 1))
                estimate = true + size * self.rng.choice([-1.0, 1.0], size.shape)
                known = np.maximum(size - self.missing * (np.arange(model.n) < 2), 0.0)
                values |= {f"{name}.valid": 1.0}
                values |= {f"{name}.age": self.period} if f"{name}.age" in layout.names else {}  # old: memory counts
                seen = _seen(model, estimate)
                relative = estimate[:, :2] - self.x[i][:, :2]
                values |= {f"{name}.position.{axis}": relative[:, c] for c, axis in enumerate("xy")}
                values |= {f"{name}.{each}": seen[each] for each in _names(model)[2:]}
                values |= {f"{name}.bound.{each}": known[:, c] for c, each in enumerate(model.states)}
            found[agent] = layout.build(values)
        return found

    def to_obstacles(self, points: np.ndarray) -> np.ndarray:
        """(B, M, 2) from points (B, 2) to the nearest points of the discs."""
        gap = self.obstacles[:, :2] - points[:, None]
        return gap * (1.0 - self.obstacles[:, 2:] / np.linalg.norm(gap, axis=2, keepdims=True))

    def towards(self) -> np.ndarray:
        """(B, N, 2) unit vectors to the nearest other, or the nearest obstacle if there are some."""
        places = np.stack([x[:, :2] for x in self.x], axis=1)
        if len(self.obstacles):
            gap = np.stack([self.to_obstacles(x[:, :2]) for x in self.x], axis=1)
        else:
            gap = places[:, None] - places[:, :, None]
            gap[:, range(len(self.x)), range(len(self.x))] = 1e9
        nearest = np.argmin(np.linalg.norm(gap, axis=3), axis=2)
        way = np.take_along_axis(gap, nearest[:, :, None, None], axis=2)[:, :, 0]
        return way / np.linalg.norm(way, axis=2, keepdims=True)

    def wanted(self) -> dict[str, np.ndarray]:
        """(B, m) by agent: full inputs at the nearest other, in fractions; ships and unicycles turn at random."""
        found = {}
        for i, (agent, model, x) in enumerate(zip(self.ids, self.models, self.x, strict=True)):
            way = self.towards()[:, i]
            if "heading" in model.states:
                cos, sin = np.cos(x[:, 2]), np.sin(x[:, 2])
                way = np.column_stack([cos * way[:, 0] + sin * way[:, 1], cos * way[:, 1] - sin * way[:, 0]])
            action = way / np.abs(way).max(axis=1, keepdims=True)
            if model.type == "unicycle":
                action = np.column_stack([np.sign(way[:, 0]), np.sign(way[:, 1])])
            elif model.type == "vessel":
                action = np.column_stack([action, self.rng.choice([-1.0, 1.0], self.batch)])
            found[agent] = action.astype(np.float32)
        return found

    def move(self, actions: dict[str, np.ndarray]) -> None:
        """A period, with disturbances at their bounds towards the nearest, that turn round from time to time."""
        self.side = np.where(self.rng.random(self.side.shape) < 0.2, -self.side, self.side)
        push = np.sign(self.towards()) * self.side
        chosen = [np.clip(actions[agent].astype(float), -1.0, 1.0) for agent in self.ids]
        inputs = [model.input_limit * action for model, action in zip(self.models, chosen, strict=True)]
        for _ in range(self.steps):
            before = [x[:, :2].copy() for x in self.x]
            after = []
            for i, (model, x, u) in enumerate(zip(self.models, self.x, inputs, strict=True)):
                w = np.array(PUSHED[model.type]) * np.tile(push[:, i], (1, 3))[:, : model.n]
                rate = model.drift(np.zeros(self.batch), x) + model.input_map(np.zeros(self.batch), x, u) + w
                after.append(x + self.period / self.steps * rate)
            self.x = after
            for i in range(len(after)):
                for j in range(i):
                    gap = nearest_on(before[i] - before[j], after[i][:, :2] - after[j][:, :2])
                    self.closest = np.minimum(self.closest, gap)
                for x, y, radius in self.obstacles:
                    gap = nearest_on(before[i] - (x, y), after[i][:, :2] - (x, y)) - radius
                    self.clearance = np.minimum(self.clearance, gap)


class Ram:
    """A policy that knows the truth: for tests only."""

    def __init__(self, world: RammingTeam) -> None:
        self.world = world

    def reset(self, env, seeds) -> None:
        """Nothing to prepare."""

    def act(self, observations):
        """Full inputs at the nearest other."""
        return self.world.wanted()


def cart() -> DoubleIntegrator:
    """Of the scenarios for navigation, up to 1 m/s."""
    return DoubleIntegrator(damping=2.0, input_limit=2.0)


def ship() -> SurfaceVessel:
    """Likewise."""
    return SurfaceVessel(linear_drag=(30.0, 40.0, 5.0), quadratic_drag=(0.0, 0.0, 0.0), input_limit=(30.0, 40.0, 5.0))


def _names(model: AgentModel) -> list[str]:
    return [n for s in model.states for n in ((f"{s}.cos", f"{s}.sin") if s == "heading" else (s,))]


def _range(name: str) -> tuple[float, float]:
    return (-1.0, 1.0) if name.endswith((".cos", ".sin")) else (-LIMIT, LIMIT)


def _seen(model: AgentModel, x: np.ndarray) -> dict[str, np.ndarray]:
    found = {}
    for c, name in enumerate(model.states):
        if name == "heading":
            found |= {"heading.cos": np.cos(x[:, c]), "heading.sin": np.sin(x[:, c])}
        else:
            found[name] = x[:, c]
    return found
