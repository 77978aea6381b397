"""Scripted policies: the feedback laws on observations, two that everything has to beat, and an adversary."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.laws import make_law
from agents.policy import EnvDescription, Observations
from agents.tuned import sampled_gain, tuned_parameters
from agents.velocity_law import VelocityLaw
from khop_env.env.layout import Float32Array
from khop_env.physics import Fleet
from khop_env.scenarios import LawChoice
from khop_env.simulation import View


class ZeroPolicy:
    """Does nothing."""

    def reset(self, env: EnvDescription, seeds: Sequence[int]) -> None:
        """Remember the actions' sizes."""
        self._sizes = env.action_sizes

    def act(self, observations: Observations) -> dict[str, Float32Array]:
        """Zeros."""
        return {
            agent: np.zeros((*given.shape[:-1], self._sizes[agent]), np.float32)
            for agent, given in observations.items()
        }


class RandomPolicy:
    """Uniform in [-1, 1], from a generator for each environment of the batch."""

    def reset(self, env: EnvDescription, seeds: Sequence[int]) -> None:
        """Seed the generators."""
        self._sizes = env.action_sizes
        self._generators = [np.random.default_rng(int(seed)) for seed in seeds]

    def act(self, observations: Observations) -> dict[str, Float32Array]:
        """New numbers for every environment."""
        batch = next(iter(observations.values())).shape[:-1]
        width = sum(self._sizes[agent] for agent in observations)
        drawn = np.array([one.uniform(-1.0, 1.0, width) for one in self._generators], np.float32).reshape(*batch, width)
        ends = np.cumsum([self._sizes[agent] for agent in observations])[:-1]
        return dict(zip(observations, np.split(drawn, ends, axis=-1), strict=True))


class BangBangPolicy(RandomPolicy):
    """Full inputs of random sign, the same for all agents or not by turns of two seconds: an adversary of observers."""

    def reset(self, env: EnvDescription, seeds: Sequence[int]) -> None:
        """Seed the generators."""
        super().reset(env, seeds)
        self._cycle, self._turn = 0, max(1, round(2.0 / env.control_period))

    def act(self, observations: Observations) -> dict[str, Float32Array]:
        """Signs."""
        drawn = super().act(observations)
        if self._cycle // self._turn % 2 == 0:
            first = next(iter(drawn.values()))[..., :1]
            drawn = {agent: np.broadcast_to(first, values.shape) for agent, values in drawn.items()}
        self._cycle += 1
        return {agent: np.where(values < 0.0, -1.0, 1.0).astype(np.float32) for agent, values in drawn.items()}


class LawPolicy:
    """A feedback law that reads its quantities by name from observations, and acts once in a control period.

    The law is the same object that a simulator evaluates in continuous time; what it is shown is built from each
    agent's own observation: its own state, and the slots that its task has an edge to.

    Args:
        name: of the law.
        parameters: its parameters; those left out are the tuned ones for environment, scenario and observation mode
            where there are any (`agents/tuned.toml`), otherwise the law's defaults. A gain that is left out is lowered
            for control periods that are too long for it (`agents.tuned.sampled_gain`); `law.gain` is what is used.
    """

    def __init__(self, name: str, parameters: Mapping[str, Any] | None = None) -> None:
        self.name, self.parameters = name, dict(parameters or {})
        make_law(LawChoice(name, self.parameters))  # refuses what there isn't

    def reset(self, env: EnvDescription, seeds: Sequence[int]) -> None:
        """Choose the parameters, and look up where in the observations everything is."""
        tuned = tuned_parameters(env, self.name)
        self.law = make_law(LawChoice(self.name, {**tuned, **self.parameters}))
        if isinstance(self.law, VelocityLaw) and hasattr(self.law, "gain") and "gain" not in self.parameters:
            self.law.gain = sampled_gain(self.law.gain, self.law.averages, env)
        self._env, self._time = env, 0.0
        self._view: View | None = None
        self._fleet = Fleet(list(env.models.values()))
        self._reader = _Reader(env, self._fleet)

    def act(self, observations: Observations) -> dict[str, Float32Array]:
        """The law's inputs as fractions of their limits."""
        shape = next(iter(observations.values())).shape[:-1]
        flat = np.concatenate(
            [np.asarray(observations[agent]).reshape(-1, observations[agent].shape[-1]) for agent in self._env.agents],
            axis=1,
        )
        self._view = self._reader.view(flat, self._view)
        inputs = self.law(np.full(len(flat), self._time), self._view)
        self._time += self._env.control_period
        fractions = (inputs / self._fleet.input_limit).astype(np.float32)
        actions = {}
        for number, (agent, size) in enumerate(self._env.action_sizes.items()):
            mine = fractions[:, self._fleet.input_slice(number)]
            actions[agent] = np.zeros((len(flat), size), np.float32)
            actions[agent][:, : mine.shape[1]] = mine
            actions[agent] = actions[agent].reshape(*shape, size)
        return actions


class _Reader:
    """Where the observations, side by side, hold what a `View` shows."""

    def __init__(self, env: EnvDescription, fleet: Fleet) -> None:
        self._fleet, dim = fleet, fleet.position_dim
        self._value: list[tuple[int, int]] = []  # (component of the state, column)
        self._angle: list[tuple[int, int, int]] = []  # (component, cosine's column, sine's column)
        edges: list[tuple[int, int]] = []
        valid: list[int] = []
        position: list[NDArray[np.int64]] = []
        wanted: list[NDArray[np.int64]] = []
        first = 0
        for i, (agent, layout) in enumerate(env.layouts.items()):
            for component, (name, unit) in enumerate(env.models[agent].states.items(), int(fleet.state_offset[i])):
                if unit == "rad" and name not in env.models[agent].position:
                    cos, sin = (first + layout.index(f"own.{name}.{how}") for how in ("cos", "sin"))
                    self._angle.append((component, cos, sin))
                else:
                    self._value.append((component, first + layout.index(f"own.{name}")))
            for number, slot in enumerate(layout.slots):
                if slot.task_edge:
                    edges.append((i, env.agents.index(slot.id) if slot.id in env.agents else -1))
                    valid.append(first + layout.index(f"slot{number}.valid"))
                    position.append(first + layout.columns(f"slot{number}.position"))
                    wanted.append(first + layout.columns(f"slot{number}.displacement"))
            first += len(layout)
        self._edges = np.array(edges, np.int64).reshape(-1, 2)
        self._valid = np.array(valid, np.int64)
        self._position = np.array(position, np.int64).reshape(-1, dim)
        self._wanted = np.array(wanted, np.int64).reshape(-1, dim)

    def view(self, flat: Float32Array, old: View | None) -> View:
        """What observations (B, columns) show; in the memory of `old` where that fits."""
        batch = len(flat)
        if old is None or len(old.x) != batch:
            columns = np.zeros((len(self._edges), self._fleet.position_dim, batch))
            known = np.zeros((batch, len(self._edges)), bool)
            old = View(self._fleet, np.zeros((batch, self._fleet.n)), self._edges, known, columns.transpose(2, 0, 1))
        values = flat.T
        for component, column in self._value:
            old.x[:, component] = values[column]
        for component, cos, sin in self._angle:
            old.x[:, component] = np.arctan2(values[sin], values[cos])
        valid = values[self._valid] > 0.5
        old.known[...] = valid.T
        displacement = old.displacement.transpose(1, 2, 0)
        displacement[...] = values[self._position]
        displacement -= values[self._wanted]
        displacement *= valid[:, None]
        return old
