"""How fast others move, from successive observations of their slots: for policies that need to know."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

from agents.policy import EnvDescription, Observations
from agents.velocity_law import VELOCITY_INPUTS
from khop_env.compiled import compiled
from khop_env.env import ObservationLayout
from khop_env.env.layout import Float32Array
from khop_env.observers import FloatArray, IntArray
from khop_env.physics import AgentModel, DriftingIntegrator

HELD = ("integrator", "unicycle")  # types of agents whose last position is held until another arrives
NEWER = 1e-3  # s: a stamp later by less is the same one

_REMEMBERED = {
    "now": "_now",
    "velocity": "velocity",
    "ahead": "ahead",
    "place": "_place",
    "stamp": "_stamp",
    "time": "_time",
}


class Others:
    """The velocities of others, and where they are by dead reckoning.

    The velocity of an agent is that between the last two of its positions that arrived, the times of which follow from
    the age of its slot, cut off at its own limit along each axis. It is zero until two have arrived, and for agents
    that don't act, whose limits aren't known. Where a state says how fast an agent is (carts, vessels), it is that.
    Estimates of integrators and unicycles, whose inputs nobody knows, are held: dead reckoning moves them on by their
    velocity times their age. Estimates of other models are predictions already.

    Args:
        env: in the plane; observations without ages, or of the truth, are taken as new at each step.

    Attributes:
        velocity: (B, P, 2) in m/s, per pair of an agent and one of its slots, sorted by agent; of the last `update`.
        ahead: (B, P, 2) what dead reckoning adds to positions in slots, in m.
        first: (N + 1,) an agent's first pair.
        position: (P, 2) columns of relative positions, in the observations of all agents side by side.
        valid: (P,) columns of the flag that something is known.
        moved_on: (P,) whether positions of the pair are held, with an age, so that `ahead` can be other than zero.
    """

    def __init__(self, env: EnvDescription) -> None:
        self.period, start, first = env.control_period, 0, [0]
        own, position, valid, age, held, limit = [], [], [], [], [], []
        self._measured: list[tuple[int, AgentModel, list[tuple[int, ...]]]] = []
        for agent, layout in env.layouts.items():
            for number, slot in enumerate(layout.slots):
                name, model = f"slot{number}", env.models.get(slot.id)
                own.append([start + layout.index(f"own.{axis}") for axis in env.models[agent].position])
                position.append(start + layout.columns(f"{name}.position"))
                valid.append(start + layout.index(f"{name}.valid"))
                late = (
                    f"{name}.age" in layout.names and env.observe != "oracle"
                )  # where ages are those of messages only
                age.append(start + layout.index(f"{name}.age") if late else -1)
                held.append(model is not None and model.type in HELD and age[-1] >= 0)
                limit.append(np.zeros(2) if model is None else fastest(model))
                if model is not None and model.type not in (*VELOCITY_INPUTS, "unicycle"):
                    self._measured.append((len(own) - 1, model, _state(layout, start, name, model)))
            first.append(len(own))
            start += len(layout)
        self.first, self.position = np.array(first), np.array(position, np.int64).reshape(-1, 2)
        self.valid, self.moved_on = np.array(valid, np.int64), np.array(held, bool)
        own_columns = np.array(own, np.int64).reshape(-1, 2)
        limits = np.array(limit, float).reshape(-1, 2)
        self._columns: Any = (own_columns, self.position, self.valid, np.array(age, np.int64), self.moved_on, limits)
        self._now = 0.0
        self._allocate(0)

    def update(self, flat: Float32Array) -> None:
        """Take account of the observations (B, D) of all agents, side by side; once in a control period.

        Where an environment of a batch begins a new episode, velocities are right again from its third value on.
        """
        if len(flat) != len(self.velocity):
            self._allocate(len(flat))
        _reckon(self._columns, flat, self._now, self._stamp, self._time, self._place, self.velocity, self.ahead)
        self._now += self.period
        for pair, model, columns in self._measured:
            x = np.empty((len(flat), model.n))
            for q, places in enumerate(columns):
                values = [flat[:, place].astype(float) for place in places]
                x[:, q] = values[0] if len(values) == 1 else np.arctan2(values[1], values[0])
            rate = model.drift(np.zeros(len(flat)), x)
            self.velocity[:, pair] = rate[:, [list(model.states).index(axis) for axis in model.position]]

    def extrapolated(self, flat: Float32Array) -> Float32Array:
        """The observations with the positions of others as they are by dead reckoning; `update` before."""
        moved = flat.copy()
        moved[:, self.position] += self.ahead.astype(np.float32)
        return moved

    def get_state(self) -> dict[str, NDArray[Any]]:
        """A copy of what `update` remembers."""
        return {name: np.copy(getattr(self, attribute)) for name, attribute in _REMEMBERED.items()}

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Continue from `get_state()`'s result, of the same environment and batch."""
        for name, attribute in _REMEMBERED.items():
            setattr(self, attribute, state[name].copy())
        self._now = float(state["now"])

    def begin(self, batch: int, env_ids: IntArray | None = None) -> None:
        """Episodes begin in these of `batch` environments, None for all: nothing is known."""
        if env_ids is None:
            self._now = 0.0
            self._allocate(batch)
            return
        for values in (self.velocity, self.ahead, self._place):
            values[env_ids] = 0.0
        self._stamp[env_ids] = self._time[env_ids] = -math.inf

    def _allocate(self, batch: int) -> None:
        pairs = len(self.valid)
        self.velocity, self.ahead, self._place = (np.zeros((batch, pairs, 2)) for _ in range(3))
        self._stamp, self._time = (np.full((batch, pairs), -math.inf) for _ in range(2))


def side_by_side(observations: Observations, agents: tuple[str, ...]) -> Float32Array:
    """(B, D) observations of all agents in one array."""
    parts = [np.asarray(observations[agent], np.float32) for agent in agents]
    return np.concatenate([part.reshape(-1, part.shape[-1]) for part in parts], axis=1)


def fastest(model: AgentModel) -> FloatArray:
    """(2,) largest velocity along each axis without a disturbance, in m/s; infinite if it isn't known."""
    if model.type == "unicycle":
        return np.full(2, float(np.broadcast_to(model.input_limit, model.m)[0]))
    if model.type in VELOCITY_INPUTS:
        drift = 1.0 if isinstance(model, DriftingIntegrator) else 0.0
        return np.broadcast_to(model.input_limit, 2) + drift
    return np.full(2, math.inf)


def _state(layout: ObservationLayout, start: int, name: str, model: AgentModel) -> list[tuple[int, ...]]:
    """By state of another agent its column, or two for an angle; positions, which are relative, as they are."""
    columns: list[tuple[int, ...]] = []
    axes = list(model.position)
    place = layout.columns(f"{name}.position")
    for state, unit in model.states.items():
        if state in axes:
            columns.append((start + int(place[axes.index(state)]),))
        elif unit == "rad":
            columns.append(tuple(start + layout.index(f"{name}.{state}.{how}") for how in ("cos", "sin")))
        else:
            columns.append((start + layout.index(f"{name}.{state}"),))
    return columns


@compiled
def _reckon(
    columns: Any,
    flat: Float32Array,
    now: float,
    stamp: FloatArray,
    time: FloatArray,
    place: FloatArray,
    velocity: FloatArray,
    ahead: FloatArray,
) -> None:
    """Overwrite `velocity` and `ahead`; `stamp`, `time` and `place` are those of the last position that arrived."""
    own, position, valid, age, held, limit = columns
    for b in range(flat.shape[0]):
        for pair in range(len(valid)):
            ahead[b, pair, 0] = ahead[b, pair, 1] = 0.0
            if flat[b, valid[pair]] < 0.5:
                continue
            old = float(flat[b, age[pair]]) if age[pair] >= 0 else 0.0
            newer = now - old > stamp[b, pair] + NEWER
            when = now - old if held[pair] else now
            for axis in range(2):
                if newer:
                    x = float(flat[b, own[pair, axis]]) + float(flat[b, position[pair, axis]])
                    if stamp[b, pair] > -math.inf:
                        speed = (x - place[b, pair, axis]) / (when - time[b, pair])
                        velocity[b, pair, axis] = min(max(speed, -limit[pair, axis]), limit[pair, axis])
                    place[b, pair, axis] = x
                if held[pair]:
                    ahead[b, pair, axis] = velocity[b, pair, axis] * old
            if newer:
                stamp[b, pair], time[b, pair] = now - old, when
