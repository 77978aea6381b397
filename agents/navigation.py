"""Towards the goal, whoever is in the way."""

from __future__ import annotations

import math
from collections.abc import Iterator, Mapping, Sequence
from typing import Any

import numpy as np

from agents.others import side_by_side
from agents.policy import EnvDescription, Observations, require_description, require_reset
from agents.scripted import Reader
from agents.velocity_law import VELOCITY_INPUTS
from khop_env.env.layout import Float32Array
from khop_env.observers import FloatArray, IntArray
from khop_env.physics import AgentModel, Fleet, velocity_to_input

GAIN = 5.0  # 1/s, where the input is a velocity
SLOW_GAIN = 1.0  # 1/s, where it is a force or an acceleration
TURN_GAIN = 4.0  # 1/s
RANGE = 1.5  # m: others that are farther don't matter
TURN = 2.0  # most that another turns an agent, as the tangent of the angle
STUCK = 0.05  # m
_REMEMBERED = ("past", "detour", "left", "generators")  # of KeepRight
SLOW_NEAR = 0.15  # m: from its goal an agent with a slow gain may be held by a disturbance


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
        require_description(env)
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
        require_reset(self, "_fleet")
        shape = next(iter(observations.values())).shape[:-1]
        flat = side_by_side(observations, tuple(self._models))
        states = self._reader.view(flat, None).x
        ways = {}
        for i, agent in enumerate(self._models):
            seen = np.asarray(observations[agent], dtype=float).reshape(len(flat), -1)
            ways[agent] = self.way(agent, states[:, self._fleet.position_index[i]], seen)
        actions = {}
        for agent, u in self.inputs(flat, states, ways).items():
            model = self._models[agent]
            actions[agent] = np.zeros((len(flat), self._sizes[agent]), np.float32)
            actions[agent][:, : model.m] = u / model.input_limit
            actions[agent] = actions[agent].reshape(*shape, -1)
        return actions

    def inputs(self, flat: Float32Array, states: FloatArray, ways: dict[str, FloatArray]) -> dict[str, FloatArray]:
        """By agent the inputs (B, m), within the limits.

        Args:
            flat: (B, D) observations of all agents, side by side.
            states: (B, n) of all agents.
            ways: by agent (B, d), where it is to go.
        """
        return {agent: towards(model, states[:, part], ways[agent]) for agent, model, part in self._agents()}

    def _agents(self) -> Iterator[tuple[str, AgentModel, slice]]:
        """Ids, models, and where their states are."""
        for i, (agent, model) in enumerate(self._models.items()):
            yield agent, model, self._fleet.state_slice(i)

    def way(self, agent: str, position: FloatArray, seen: FloatArray) -> FloatArray:
        """Where an agent is to go, (B, d) in m, from where it is.

        Args:
            agent: its id.
            position: (B, d) in m.
            seen: (B, D) its observations.
        """
        return seen[:, self._goal[agent]]


class KeepRight(GoToGoal):
    """To the goal, passing others on the right, and aside for a while if nothing moves: fewer deadlocks in a filter.

    Of the others ahead, by their estimates, the nearest turns an agent to the right, the more the nearer it is within
    `RANGE`. An agent that has moved by less than `STUCK` in 1 s, and isn't at its goal, goes in a random direction for
    0.5 to 1.5 s, and then tries again for at least 1 s. A cart or ship, which a disturbance keeps some centimetres off
    its goal, is at its goal within `SLOW_NEAR`. In the plane.
    """

    def reset(self, env: EnvDescription, seeds: Sequence[int]) -> None:
        """Find the goals and the others in the observations, and seed the generators.

        Raises:
            ValueError: if an agent has no goal, or positions aren't in the plane.
        """
        super().reset(env, seeds)
        require_plane("keep_right", env)
        self._velocity_agents = {
            agent for agent, model in env.models.items() if model.type in (*VELOCITY_INPUTS, "unicycle")
        }
        self._others, self._known = {}, {}
        for agent, layout in env.layouts.items():
            slots = range(len(layout.slots))
            self._others[agent] = np.array([layout.columns(f"slot{q}.position") for q in slots], int).reshape(-1, 2)
            self._known[agent] = np.array([layout.index(f"slot{q}.valid") for q in slots], int)
        self._generators = [np.random.default_rng(int(seed)) for seed in seeds]
        self._second = max(1, round(1.0 / env.control_period))
        self._period = env.control_period
        self._past: dict[str, list[FloatArray]] = {agent: [] for agent in env.layouts}
        self._detour = {agent: np.zeros((len(seeds), 2)) for agent in env.layouts}
        self._left = {agent: np.full(len(seeds), -1.0) for agent in env.layouts}  # s, of a detour; since it ended

    def way(self, agent: str, position: FloatArray, seen: FloatArray) -> FloatArray:
        """See the class."""
        way = super().way(agent, position, seen)
        distance = np.hypot(way[:, 0], way[:, 1])
        ahead = way / np.maximum(distance, 1e-9)[:, None]
        others = seen[:, self._others[agent]]  # (B, slots, 2)
        far = np.hypot(others[..., 0], others[..., 1])
        counted = (seen[:, self._known[agent]] > 0.5) & ((others * ahead[:, None]).sum(axis=2) > 0.0)
        nearest = np.where(counted, far, RANGE).min(axis=1, initial=RANGE)
        near_goal = np.minimum(distance / RANGE, 1.0)  # nobody circles round its goal
        turn = (TURN * (1.0 - nearest / RANGE) * near_goal)[:, None]
        way = way + turn * distance[:, None] * np.column_stack([ahead[:, 1], -ahead[:, 0]])
        past, left, detour = self._past[agent], self._left[agent], self._detour[agent]
        past.append(position.copy())
        if len(past) > self._second:
            moved = np.hypot(*(position - past.pop(0)).T)
            near = STUCK if agent in self._velocity_agents else SLOW_NEAR
            for env in np.flatnonzero((moved < STUCK) & (distance > near) & (left <= -1.0)).tolist():
                angle = self._generators[env].uniform(0.0, 2.0 * math.pi)
                detour[env] = math.cos(angle), math.sin(angle)
                left[env] = self._generators[env].uniform(0.5, 1.5)
        aside = left > 0.0
        left -= self._period
        return np.where(aside[:, None], detour, way)

    def begin(self, batch: int, env_ids: IntArray | None = None) -> None:
        """New episodes have begun in these of `batch` environments; None for all."""
        if env_ids is None:
            shape = batch, 2
            self._past = {agent: [np.full(shape, np.nan) for _ in range(self._second)] for agent in self._past}
            self._detour = {agent: np.zeros(shape) for agent in self._detour}
            self._left = {agent: np.full(batch, -1.0) for agent in self._left}
            return
        for agent, past in self._past.items():
            for position in past:
                position[env_ids] = np.nan  # hasn't moved by less than any length
            self._detour[agent][env_ids], self._left[agent][env_ids] = 0.0, -1.0

    def get_state(self) -> dict[str, Any]:
        """What it remembers between actions: positions in the last second, detours, and its generators."""
        return {name: getattr(self, f"_{name}") for name in _REMEMBERED}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continue from `get_state()`'s result, after a reset in the same environment."""
        for name in _REMEMBERED:
            setattr(self, f"_{name}", state[name])


def require_plane(name: str, env: EnvDescription) -> None:
    """Refuse agents that don't move in the plane.

    Args:
        name: of the policy.
        env: the environment.

    Raises:
        ValueError: naming the policy and the number of axes.
    """
    axes = len(next(iter(env.models.values())).position)
    if axes != 2:
        raise ValueError(
            f"{name} needs positions in the plane; here they have {axes} {'axis' if axes == 1 else 'axes'}"
        )


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
