"""How leaders move: smooth random routes, drawn per episode, that no observer is told."""

from __future__ import annotations

import math

import numpy as np

from khop_env.env.tasks import Task
from khop_env.observers import FloatArray
from khop_env.physics import Fleet, velocity_to_input

SINES = 3  # per axis
BAND = (1.5, 2.5)  # rad/s: where the route's frequencies are drawn from
POSITION_GAIN = 1.0  # 1/s: pulls a leader back to its route, so that drift and disturbance don't carry it away


class LeaderRoutes:
    """Velocity commands of the leaders, from numbers drawn per episode.

    Along each axis the route's velocity is a sum of sines with frequencies drawn from `BAND` and phases from a circle;
    the leader is commanded that velocity plus `POSITION_GAIN` times what it lacks to the route.

    Args:
        fleet: all agents.
        task: says who leads, and how fast.
        batch: number of environments B.

    Attributes:
        drawn: (B, 2, leaders, d, SINES) frequencies in rad/s and phases of this episode.
        start: (B, leaders, d) where the routes begin, in m.
    """

    def __init__(self, fleet: Fleet, task: Task, batch: int) -> None:
        self._fleet, self._leaders = fleet, np.array(task.leaders, np.int64)
        shape = len(self._leaders), fleet.position_dim
        self.drawn = np.ones((batch, 2, *shape, SINES))
        self.start = np.zeros((batch, *shape))
        self._amplitude = np.array(task.leader_speed).reshape(-1, 1, 1) * math.sqrt(2.0 / (SINES * shape[1]))
        self._models = [fleet.models[i] for i in task.leaders]

    def draw(self, env: int, rng: np.random.Generator, x: FloatArray) -> None:
        """Draw the routes of environment `env`, which begin at its states `x` (n,)."""
        shape = self.drawn.shape[2:]
        self.drawn[env, 0] = rng.uniform(*BAND, shape)
        self.drawn[env, 1] = rng.uniform(0.0, 2.0 * math.pi, shape)
        self.start[env] = x[self._fleet.position_index[self._leaders]]

    def command(self, t: FloatArray, x: FloatArray, u: FloatArray) -> None:
        """Write the leaders' inputs at times `t` (B,) and states `x` (B, n) into `u` (B, m)."""
        frequency, phase = self.drawn[:, 0], self.drawn[:, 1]
        angle = frequency * t[:, None, None, None] + phase
        velocity = (self._amplitude * np.sin(angle)).sum(axis=-1)
        route = self.start + (self._amplitude * (np.cos(phase) - np.cos(angle)) / frequency).sum(axis=-1)
        velocity += POSITION_GAIN * (route - x[:, self._fleet.position_index[self._leaders]])
        for number, (i, model) in enumerate(zip(self._leaders, self._models, strict=True)):
            states = x[:, self._fleet.state_slice(i)]
            u[:, self._fleet.input_slice(i)] = velocity_to_input(model, states, velocity[:, number])
