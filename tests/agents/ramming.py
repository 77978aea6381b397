"""A world against the safety filter: everybody rams the nearest, and errors are exactly on their bounds."""

import math
from dataclasses import dataclass, field

import numpy as np

from agents import EnvDescription
from khop_env.env.layout import Field, ObservationLayout, Slot
from khop_env.physics import AgentModel, SingleIntegrator

PERIOD, SPEED, PUSHED, LIMIT = 0.05, 1.0, 0.1, 100.0


@dataclass
class Ramming:
    """Single integrators in B worlds, observed with errors on the faces of their boxes.

    Args:
        agents: number N.
        batch: B.
        largest: largest half width of a box, in m.
        missing: half widths are observed smaller than the errors by this, in m.
        obstacles: (M, 3) discs x, y, radius.
        radius: of a body.
        model: of all agents.
        delay: largest age of announced anchors, in control periods; None where nothing is announced. Boxes round
            estimates are 5 m wider then, so that the announced ones count.
        younger: ages are observed smaller by this, in s.
    """

    agents: int = 4
    batch: int = 200
    largest: float = 0.5
    missing: float = 0.0
    radius: float = 0.2
    obstacles: np.ndarray = field(default_factory=lambda: np.zeros((0, 3)))
    model: AgentModel = field(default_factory=lambda: SingleIntegrator(input_limit=SPEED))
    delay: int | None = None
    younger: float = 0.0

    def __post_init__(self) -> None:
        self.rng = np.random.default_rng(0)
        angle = 2.0 * math.pi * np.arange(self.agents) / self.agents
        ring = 0.6 / math.sin(math.pi / max(self.agents, 3)) * np.column_stack([np.cos(angle), np.sin(angle)])
        self.x = np.broadcast_to(ring, (self.batch, self.agents, 2)).copy()
        self.sent = []  # by control period what each agent announced
        self.closest = np.full(self.batch, math.inf)
        self.clearance = np.full(self.batch, math.inf)

    def description(self, age: bool = True) -> EnvDescription:
        """All agents know of each other."""
        ids = [f"{self.model.type}_{i}" for i in range(self.agents)]
        axes = self.model.position
        near = [f"obstacle{q}.{axis}" for q in range(len(self.obstacles)) for axis in axes]
        layouts = {}
        for i, agent in enumerate(ids):
            fields = [Field(f"own.{axis}", "m", -LIMIT, LIMIT) for axis in axes] + [Field("radius", "m", 0.0, LIMIT)]
            fields += [Field(name, "m", -2 * LIMIT, 2 * LIMIT) for name in near]
            slots = [Slot(j, other, False, 1, True) for j, other in enumerate(ids) if j != i]
            for number in range(len(slots)):
                name = f"slot{number}"
                fields += [Field(f"{name}.valid", "", 0.0, 1.0)] + [Field(f"{name}.age", "s", 0.0, LIMIT)] * age
                fields += [Field(f"{name}.position.{axis}", "m", -2 * LIMIT, 2 * LIMIT) for axis in "xy"]
                fields += [Field(f"{name}.bound.{axis}", "m", 0.0, LIMIT) for axis in axes]
                fields += [Field(f"{name}.message.{c}", "", -1.0, 1.0) for c in range(self.message_size)]
            layouts[agent] = ObservationLayout(agent, fields, slots)
        models = dict.fromkeys(ids, self.model)
        pushed = {agent: np.full(2, PUSHED) for agent in ids}
        sizes = dict.fromkeys(ids, 2 + self.message_size)
        return EnvDescription(
            "test_v0", "ring", "estimate", PERIOD, models, layouts, sizes,
            disturbance=pushed, message_size=self.message_size,
        )  # fmt: skip

    @property
    def message_size(self):
        """Of the filter's data."""
        return 0 if self.delay is None else 4

    def observations(self, env):
        """Each pair's error is on a corner of its box, whose size jumps: both sides know differently much."""
        found = {}
        for i, (agent, layout) in enumerate(env.layouts.items()):
            one, two = self.model.position
            values = {"radius": self.radius, f"own.{one}": self.x[:, i, 0], f"own.{two}": self.x[:, i, 1]}
            gap = self.to_obstacles(self.x[:, i])
            for q in range(len(self.obstacles)):
                values |= {f"obstacle{q}.{axis}": gap[:, q, c] for c, axis in enumerate((one, two))}
            for number, slot in enumerate(layout.slots):
                size = self.largest * self.rng.random((self.batch, 2)) * self.rng.integers(0, 2, (self.batch, 1))
                error = size * self.rng.choice([-1.0, 1.0], (self.batch, 2))
                known = np.maximum(size - self.missing, 0.0)
                seen = self.x[:, slot.agent] + error - self.x[:, i]
                name = f"slot{number}"
                values |= {f"{name}.valid": 1.0, f"{name}.position.x": seen[:, 0], f"{name}.position.y": seen[:, 1]}
                values |= {f"{name}.bound.{one}": known[:, 0], f"{name}.bound.{two}": known[:, 1]}
                values |= {f"{name}.age": 0.0} if f"{name}.age" in layout.names else {}
                if self.delay is not None:
                    values |= {f"{name}.bound.{axis}": size[:, c] + 5.0 for c, axis in enumerate((one, two))}
                    values |= self.announced(name, slot.agent)
            found[agent] = layout.build(values)
        return found

    def announced(self, name, other):
        """What an agent announced some control periods ago, each pair in each world at random."""
        late = np.minimum(self.rng.integers(0, self.delay + 1, self.batch), len(self.sent) - 1)
        values = {f"{name}.age": np.maximum(PERIOD * late - self.younger, 0.0)}
        data = np.zeros((self.batch, 4))
        if self.sent:
            data = np.stack(self.sent)[len(self.sent) - 1 - late, range(self.batch), other]
        return values | {f"{name}.message.{c}": data[:, c] for c in range(4)}

    def to_obstacles(self, points):
        """(B, M, 2) from points (B, 2) to the nearest points of the discs."""
        gap = self.obstacles[:, :2] - points[:, None]
        distance = np.linalg.norm(gap, axis=2, keepdims=True)
        return gap * (1.0 - self.obstacles[:, 2:] / distance)

    def wanted(self):
        """(B, N, 2) full inputs straight at the nearest other, or at the nearest obstacle if there are some."""
        if len(self.obstacles):
            gap = np.stack([self.to_obstacles(self.x[:, i]) for i in range(self.agents)], axis=1)
        else:
            gap = self.x[:, None] - self.x[:, :, None]
            gap[:, range(self.agents), range(self.agents)] = 1e9
        nearest = np.argmin(np.linalg.norm(gap, axis=3), axis=2)
        towards = np.take_along_axis(gap, nearest[:, :, None, None], axis=2)[:, :, 0]
        return towards / np.abs(towards).max(axis=2, keepdims=True)

    def move(self, actions) -> None:
        """A period, with a disturbance towards the nearest that turns round halfway in some worlds."""
        actions = np.clip(np.stack(list(actions.values()), axis=1).astype(float), -1.0, 1.0)
        self.sent.append(actions[:, :, 2:])
        u = self.model.input_limit * actions[:, :, :2]
        push = PUSHED * np.sign(self.wanted())
        turns = self.rng.choice([-1.0, 1.0], (self.batch, 1, 1))
        for part, sign in enumerate((1.0, turns)):
            length = PERIOD * (0.5, 0.5)[part]
            after = self.x + length * (self.model.drift(np.zeros(self.batch), self.x) + u + sign * push)
            for i in range(self.agents):
                for j in range(i):
                    self.closest = np.minimum(
                        self.closest, nearest_on(self.x[:, i] - self.x[:, j], after[:, i] - after[:, j])
                    )
                for x, y, radius in self.obstacles:
                    gap = nearest_on(self.x[:, i] - (x, y), after[:, i] - (x, y)) - radius
                    self.clearance = np.minimum(self.clearance, gap)
            self.x = after


class Ram:
    """A policy that knows the truth: for tests only. It pauses at random, for 1 s on average, if `pauses`."""

    def __init__(self, world: Ramming, pauses: bool = False) -> None:
        self.world, self.pauses = world, pauses
        self.rng, self.paused = np.random.default_rng(1), np.zeros((world.batch, world.agents), bool)

    def reset(self, env, seeds) -> None:
        """Store the ids."""
        self.agents = env.agents

    def act(self, observations):
        """Full inputs at the nearest other."""
        wanted = self.world.wanted()
        if self.pauses:
            self.paused ^= self.rng.random(self.paused.shape) < PERIOD
            wanted = np.where(self.paused[..., None], 0.0, wanted)
        return {agent: wanted[:, i].astype(np.float32) for i, agent in enumerate(self.agents)}


def nearest_on(start, end):
    """(B,) smallest distance from the origin to straight lines between (B, 2) points."""
    along = end - start
    length = (along**2).sum(axis=-1)
    share = np.clip(-(start * along).sum(axis=-1) / np.where(length > 0.0, length, 1.0), 0.0, 1.0)
    return np.linalg.norm(start + share[..., None] * along, axis=-1)
