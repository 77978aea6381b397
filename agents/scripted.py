"""Scripted policies: feedback laws on observations, two baselines, and an adversary of the observers."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.laws import make_law
from agents.policy import EnvDescription, Observations, require_description, require_reset
from agents.tuned import sampled_gain, tuned_parameters
from agents.velocity_law import VelocityLaw
from khop_env.env.layout import Float32Array
from khop_env.observers import IntArray
from khop_env.physics import Fleet
from khop_env.scenarios import LawChoice
from khop_env.simulation import View


class ZeroPolicy:
    """All inputs zero: a baseline."""

    def reset(self, env: EnvDescription, seeds: Sequence[int]) -> None:
        """Store the action sizes."""
        require_description(env)
        self._sizes = env.action_sizes

    def act(self, observations: Observations) -> dict[str, Float32Array]:
        """Zero actions."""
        require_reset(self, "_sizes")
        return {
            agent: np.zeros((*observation.shape[:-1], self._sizes[agent]), np.float32)
            for agent, observation in observations.items()
        }


class RandomPolicy:
    """Uniform in [-1, 1], with one generator per environment of the batch: a baseline."""

    def reset(self, env: EnvDescription, seeds: Sequence[int]) -> None:
        """Seed the generators."""
        require_description(env)
        self._sizes = env.action_sizes
        self._generators = [np.random.default_rng(int(seed)) for seed in seeds]

    def act(self, observations: Observations) -> dict[str, Float32Array]:
        """New random actions for every environment."""
        require_reset(self, "_sizes")
        batch = next(iter(observations.values())).shape[:-1]
        width = sum(self._sizes[agent] for agent in observations)
        rows = [generator.uniform(-1.0, 1.0, width) for generator in self._generators]
        drawn = np.array(rows, np.float32).reshape(*batch, width)
        ends = np.cumsum([self._sizes[agent] for agent in observations])[:-1]
        return dict(zip(observations, np.split(drawn, ends, axis=-1), strict=True))


class BangBangPolicy(RandomPolicy):
    """Full inputs of random sign, alternating every two seconds between a common and individual signs: an adversary."""

    def reset(self, env: EnvDescription, seeds: Sequence[int]) -> None:
        """Seed the generators."""
        super().reset(env, seeds)
        self._cycle, self._turn = 0, max(1, round(2.0 / env.control_period))

    def act(self, observations: Observations) -> dict[str, Float32Array]:
        """Actions of -1 or 1."""
        drawn = super().act(observations)
        if self._cycle // self._turn % 2 == 0:
            first = next(iter(drawn.values()))[..., :1]
            drawn = {agent: np.broadcast_to(first, values.shape) for agent, values in drawn.items()}
        self._cycle += 1
        return {agent: np.where(values < 0.0, -1.0, 1.0).astype(np.float32) for agent, values in drawn.items()}


class LawPolicy:
    """A feedback law on observations, evaluated once per control period.

    The law is the same object that a simulator evaluates in continuous time. Its `View` is built from each agent's own
    observation: the agent's own state, and the slots of the agents that it shares a task edge with.

    Args:
        name: name of the law.
        parameters: parameters of the law; others are the tuned ones for environment, scenario and observation mode if
            there are any (`agents/tuned.toml`), else the law's defaults. A gain that isn't passed is lowered if the
            control period is too long for it (`agents.tuned.sampled_gain`); `law.gain` is the gain in use.
    """

    def __init__(self, name: str, parameters: Mapping[str, Any] | None = None) -> None:
        self.name, self.parameters = name, dict(parameters or {})
        make_law(LawChoice(name, self.parameters))  # raises on unknown names or parameters

    def reset(self, env: EnvDescription, seeds: Sequence[int]) -> None:
        """Choose the parameters, and look up the columns of the observations by name.

        Raises:
            ValueError: if no agent has a task edge, along which a law acts.
        """
        require_description(env)
        if not any(slot.task_edge for layout in env.layouts.values() for slot in layout.slots):
            raise ValueError(
                f"{self.name} acts along task edges, and agents of {env.environment} have none; take another policy, "
                "e.g. zero, or one of your own"
            )
        tuned = tuned_parameters(env, self.name)
        self.law = make_law(LawChoice(self.name, {**tuned, **self.parameters}))
        if isinstance(self.law, VelocityLaw) and hasattr(self.law, "gain") and "gain" not in self.parameters:
            self.law.gain = sampled_gain(self.law.gain, self.law.averages, env)
        self._env, self._time = env, np.zeros(1)
        self._view: View | None = None
        self._fleet = Fleet(list(env.models.values()))
        self._reader = Reader(env, self._fleet)

    def act(self, observations: Observations) -> dict[str, Float32Array]:
        """The law's inputs as fractions of their limits."""
        require_reset(self, "_env")
        shape = next(iter(observations.values())).shape[:-1]
        flat = np.concatenate(
            [np.asarray(observations[agent]).reshape(-1, observations[agent].shape[-1]) for agent in self._env.agents],
            axis=1,
        )
        self._view = self._reader.view(flat, self._view)
        inputs = self.law(np.zeros(len(flat)) + self._time, self._view)
        self._time = self._time + self._env.control_period
        fractions = (inputs / self._fleet.input_limit).astype(np.float32)
        actions = {}
        for number, (agent, size) in enumerate(self._env.action_sizes.items()):
            own = fractions[:, self._fleet.input_slice(number)]
            actions[agent] = np.zeros((len(flat), size), np.float32)
            actions[agent][:, : own.shape[1]] = own
            actions[agent] = actions[agent].reshape(*shape, size)
        return actions

    def begin(self, batch: int, env_ids: IntArray | None = None) -> None:
        """New episodes have begun in these of `batch` environments; None for all."""
        time = np.zeros(batch) + self._time
        time[slice(None) if env_ids is None else env_ids] = 0.0
        self._time = time

    def get_state(self) -> dict[str, Any]:
        """What it remembers between actions: times since the beginnings of the episodes."""
        return {"time": self._time}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continue from `get_state()`'s result, after a reset in the same environment."""
        self._time = state["time"]


class Reader:
    """Builds a `View` from the concatenated observations of all agents.

    Slots without a `displacement`, of tasks that add none, have displacement zero: their agents are to meet.

    Raises:
        ValueError: for slots whose `displacement` hasn't as many columns as a position.
    """

    def __init__(self, env: EnvDescription, fleet: Fleet) -> None:
        self._fleet, dim = fleet, fleet.position_dim
        self._value: list[tuple[int, int]] = []  # (component of the state, column)
        self._angle: list[tuple[int, int, int]] = []  # (component, cosine's column, sine's column)
        edges: list[tuple[int, int]] = []
        valid: list[int] = []
        position: list[NDArray[np.int64]] = []
        wanted: list[NDArray[np.int64]] = []
        displaced: list[int] = []  # edges whose slots have a displacement
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
                    prefix = f"slot{number}.displacement"
                    if prefix in layout.names or any(name.startswith(f"{prefix}.") for name in layout.names):
                        columns = layout.columns(prefix)
                        if len(columns) != dim:
                            raise ValueError(
                                f"laws read {prefix!r} as a displacement along each axis of the position, {dim} "
                                f"columns; {agent!r} has {len(columns)}: add as many in slot_columns, or rename them"
                            )
                        displaced.append(len(edges))
                        wanted.append(first + columns)
                    edges.append((i, env.agents.index(slot.id) if slot.id in env.agents else -1))
                    valid.append(first + layout.index(f"slot{number}.valid"))
                    position.append(first + layout.columns(f"slot{number}.position"))
            first += len(layout)
        self._edges = np.array(edges, np.int64).reshape(-1, 2)
        self._valid = np.array(valid, np.int64)
        self._position = np.array(position, np.int64).reshape(-1, dim)
        self._wanted = np.array(wanted, np.int64).reshape(-1, dim)
        self._displaced = slice(None) if len(displaced) == len(edges) else np.array(displaced, np.int64)

    def view(self, flat: Float32Array, old: View | None) -> View:
        """The view from observations (B, columns); the memory of `old` is reused if its batch has the same size."""
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
        displacement[self._displaced] -= values[self._wanted]
        displacement *= valid[:, None]
        return old
