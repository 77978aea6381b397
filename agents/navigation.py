"""Towards the goal, whoever is in the way."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np

from agents.policy import EnvDescription, Observations
from agents.scripted import Reader
from agents.velocity_law import VELOCITY_INPUTS
from khop_env.env.layout import Float32Array
from khop_env.observers import FloatArray
from khop_env.physics import AgentModel, Fleet, velocity_to_input

GAIN = 5.0  # 1/s, where the input is a velocity
SLOW_GAIN = 1.0  # 1/s, where it is a force or an acceleration
TURN_GAIN = 4.0  # 1/s


class GoToGoal:
    """Straight to the goal at full speed, without regard for others: the wish that a safety filter corrects.

    The commanded velocity is the gain times the way that is left. Where the input is a velocity it is shortened to the
    input limits without a change of direction, and a known drift is cancelled; unicycles turn towards the goal while
    they drive; carts and vessels follow the command by `physics.velocity_to_input`.
    """

    def reset(self, env: EnvDescription, seeds: Sequence[int]) -> None:
        """Find the goals in the observations.

        Raises:
            ValueError: if an agent has no goal.
        """
        self._fleet, self._sizes = Fleet(list(env.models.values())), env.action_sizes
        self._reader = Reader(env, self._fleet)
        self._models = dict(env.models)
        self._goal = {}
        for agent, layout in env.layouts.items():
            names = [name for name in layout.names if name.startswith("goal.")]
            if len(names) != self._fleet.position_dim:
                raise ValueError(
                    f"go_to_goal needs an environment with goals, e.g. navigation_v0: the observation of {agent!r} in "
                    f"{env.environment} has no columns goal.x, goal.y"
                )
            self._goal[agent] = layout.columns("goal")

    def act(self, observations: Observations) -> dict[str, Float32Array]:
        """Inputs as fractions of their limits."""
        shape = next(iter(observations.values())).shape[:-1]
        flat = np.concatenate(
            [np.asarray(observations[agent]).reshape(-1, observations[agent].shape[-1]) for agent in self._models],
            axis=1,
        )
        states = self._reader.view(flat, None).x
        actions = {}
        for i, (agent, model) in enumerate(self._models.items()):
            way = np.asarray(observations[agent], dtype=float).reshape(len(flat), -1)[:, self._goal[agent]]
            u = towards(model, states[:, self._fleet.state_slice(i)], way)
            actions[agent] = np.zeros((len(flat), self._sizes[agent]), np.float32)
            actions[agent][:, : model.m] = u / model.input_limit
            actions[agent] = actions[agent].reshape(*shape, -1)
        return actions


def towards(model: AgentModel, x: FloatArray, way: FloatArray) -> FloatArray:
    """Inputs (B, m), within the limits, that move agents of a model along `way`.

    Args:
        model: the agents' common model.
        x: (B, n) their states.
        way: (B, d) from their positions to their goals, in m.
    """
    if model.type in VELOCITY_INPUTS:
        drift = model.drift(np.zeros(len(x)), x)
        u = GAIN * way
        room = np.maximum(model.input_limit - np.abs(drift), 0.0)  # what the drift leaves of the limits
        u *= (room / np.maximum(np.abs(u), 1e-9)).min(axis=1, initial=1.0, keepdims=True)
        return np.clip(u - drift, -model.input_limit, model.input_limit)
    if model.type == "unicycle":
        distance = np.hypot(way[:, 0], way[:, 1])
        turn = np.arctan2(way[:, 1], way[:, 0]) - x[:, 2]
        turn = np.where(distance > 1e-3, (turn + math.pi) % (2.0 * math.pi) - math.pi, 0.0)
        u = np.column_stack([GAIN * distance * np.maximum(np.cos(turn), 0.0), TURN_GAIN * turn])
        return np.clip(u, -model.input_limit, model.input_limit)
    return velocity_to_input(model, x, SLOW_GAIN * way)
