"""A safety filter around any policy: the inputs nearest to the policy's that keep all agents apart.

docs/theory/safety.md has the theorem, its assumptions, and what is measured only.
"""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import replace
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from agents.learning.learned import LearnedPolicy
from agents.learning.pretrained import PretrainedPolicy
from agents.others import Others, side_by_side
from agents.policy import EnvDescription, Observations, Policy, require_description, require_policy, require_reset
from agents.safety.checks import checked, is_number, require_state
from agents.safety.columns import ANNOUNCED, DRIFT, Margin, read_columns, without_bounds
from agents.safety.driving import drive
from agents.safety.moves import filter_moves, periods_of_rest
from agents.safety.teams import read_team
from khop_env.env.layout import Float32Array
from khop_env.observers import FloatArray, IntArray
from khop_env.physics import DriftingIntegrator

_REMEMBERED = "anchor", "started", "resting", "memory"


def as_margin(margin: Margin) -> Margin:
    """A margin from text as from code.

    Raises:
        ValueError: if it is neither a name nor a number that is 0 or more.
    """
    if isinstance(margin, str) and margin in ("certified", "none"):
        return margin
    try:
        if not isinstance(margin, bool) and 0.0 <= float(margin) < math.inf:
            return float(margin)
    except (TypeError, ValueError):
        pass
    raise ValueError(f"margin must be 'certified', 'none' or a number of metres, 0 or more; got {margin!r}")


class SafetyFilter:
    """Wraps a policy and changes its inputs as little as possible, so that no two agents come closer than their bodies.

        policy = SafetyFilter(make_policy("tanh"), radius=0.2)       # in an environment made with bounds=True
        policy = shielded("tanh", margin=0.3, radius=0.2)            # a constant margin: no guarantee

    It reads observations only, as a policy does, and remembers each agent's anchor: where its inputs so far would have
    brought it without a disturbance. Agents have to be the library's own models in the plane, whose inputs are their
    actions (actuator="direct"); teams may mix them. Integrators move to the nearest admitted place; unicycles, and
    carts and ships, which have to brake, always keep a way to stop. With margin="certified" the distance is kept
    whatever the network does, provided that all agents run the filter and start apart (docs/theory/safety.md); with
    other margins it is not.

    Args:
        policy: the policy inside; it gets the observations without bounds, unless it was trained with them. None for a
            filter that only corrects actions that it is given.
        margin: a `Margin`.
        gamma: share of the gap that two agents may use up in a period together, above 0 and at most 1.
        announce: whether integrators send their anchors in messages, so that disturbances and noise don't widen boxes.
            Anchors then keep to the speed limit, and for 2 s to a tenth of it after an agent has rested, so that
            an action may be changed where nothing is near, too. Integrators only.
        radius: of an agent's body in m; None for the column `radius` of observations.
        bounds: whether the policy inside observes bounds; None for what a learned policy was trained with, and no
            bounds for others.
        dead_reckoning: whether others' positions, which estimates of integrators hold until a message arrives, are
            moved on by the velocity between the last two that arrived (`agents.others.Others`); with a margin other
            than "certified", whose boxes hold all that may have happened since.

    Attributes:
        policy: the policy inside.
        inside: description of the environment as the policy inside gets it, from the reset on.
        needs_bounds: whether the environment must be made with bounds=True.
        needs_messages: the least message_size of the environment; the last of these numbers are the filter's.
        wanted: by agent (..., m), the actions of the policy inside, of the last `act` or `correct`.
        correction: by agent (..., 2), chosen less wanted input along the axes of positions, of the last one: of the
            velocity in m/s, of carts' and ships' acceleration in m/s^2.
        intervention: by agent (...), its length.
        infeasible: by agent (...), True where the guarantee had to be begun anew: an agent that isn't where its last
            input should have brought it, which then starts from where it is, or that is outside of what observations
            show, which then stops. It is never True while the theorem's assumptions hold.

    Raises:
        TypeError: for a policy without `reset` or `act`.
        ValueError: for a margin, gamma or radius out of range, anchors that aren't needed, or a filter as the policy.
    """

    def __init__(
        self,
        policy: Policy | None,
        margin: Margin = "certified",
        *,
        gamma: float = 1.0,
        announce: bool = False,
        radius: float | None = None,
        bounds: bool | None = None,
        dead_reckoning: bool = False,
    ) -> None:
        if not (is_number(gamma) and 0.0 < gamma <= 1.0):
            raise ValueError(f"gamma must be above 0 and at most 1; got {gamma!r}")
        if radius is not None and not (is_number(radius) and 0.0 < radius < math.inf):
            raise ValueError(f"radius must be a positive number of metres; got {radius!r}")
        if policy is None and dead_reckoning:
            raise ValueError(
                "dead_reckoning=True is for a filter with a policy, which it begins anew with every episode"
            )
        if isinstance(policy, SafetyFilter):
            raise ValueError(
                "the policy is in a safety filter already, which another would undo: leave one of them out"
            )
        self.policy: Policy = _NoPolicy() if policy is None else policy
        require_policy(self.policy)
        self.margin, self.gamma = as_margin(margin), float(gamma)
        if announce and self.margin != "certified":
            raise ValueError(f"announce=True is for margin='certified'; got margin={margin!r}")
        self.announce, self.needs_messages = bool(announce), ANNOUNCED if announce else 0
        if dead_reckoning and self.margin == "certified":
            raise ValueError(
                "dead_reckoning=True needs margin='none' or a number of metres; got margin='certified', whose bounds "
                "are those of estimates as they are"
            )
        self.dead_reckoning = bool(dead_reckoning)
        self.radius, self._bounds = radius, bounds
        self._least_radius = radius if self.margin == "certified" else None
        self.needs_bounds = self.margin == "certified"
        self.wanted: dict[str, Float32Array] = {}
        self.correction: dict[str, FloatArray] = {}
        self.intervention: dict[str, FloatArray] = {}
        self.infeasible: dict[str, np.ndarray] = {}

    def __repr__(self) -> str:
        options = ", announce=True" * self.announce + ", dead_reckoning=True" * self.dead_reckoning
        return f"SafetyFilter({self.policy!r}, margin={self.margin!r}, gamma={self.gamma:g}{options})"

    def reset(self, env: EnvDescription, seeds: Sequence[int]) -> None:
        """Look up the columns, and reset the policy inside.

        Raises:
            ValueError: if the filter or the policy inside doesn't fit the environment; the message says why.
        """
        require_description(env)
        brakes = any(type(model) not in DRIFT for model in env.models.values())
        others = _held(env) if self.dead_reckoning else None
        if brakes:
            if self.announce:
                raise ValueError("announce=True is for teams of integrators only: leave it out, or choose such a team")
            team = read_team(env, self.margin, self.radius)
            self._columns: Any = tuple(team)
            self._limit, self._own, self._pairs = team.limit, team.own[:, :2], len(team.pair)
        else:
            columns = read_columns(env, self.margin, self.radius, self.announce)
            self._columns, self._scale = tuple(columns), columns.scale
            self._limit, self._own, self._pairs = columns.speed, columns.own, 0
        self._env, self._brakes, self._others = env, brakes, others
        models = enumerate(env.models.values())
        self._drifting = {number: model for number, model in models if isinstance(model, DriftingIntegrator)}
        self.begin(0)
        self._kept, inside = without_bounds(env, self._observes_bounds(env), self.needs_messages)
        self.inside = replace(inside, shielded=True)
        self._sizes = inside.action_sizes
        self.policy.reset(self.inside, seeds)

    def act(self, observations: Observations) -> dict[str, Float32Array]:
        """The policy's actions where they are safe, otherwise the nearest safe ones; once in a control period.

        Raises:
            ValueError: as `correct`, or if there is no policy inside.
        """
        self._require_reset()
        observations = checked(observations, self._env, self._least_radius)
        return self.correct(observations, self.policy.act(self.seen(observations)))

    def seen(self, observations: Observations) -> Observations:
        """The observations for the policy inside, or a learner: those that `inside` describes."""
        self._require_reset()
        if not self._kept:
            return observations
        return {agent: np.asarray(observations[agent])[..., self._kept[agent]] for agent in observations}

    def correct(self, observations: Observations, actions: Mapping[str, ArrayLike]) -> dict[str, Float32Array]:
        """Actions where they are safe, otherwise the nearest safe ones; once in a control period.

        Args:
            observations: (..., D_i) by agent, of the environment that the filter was reset for.
            actions: (..., m_i) by agent, as `inside` describes them.

        Raises:
            ValueError: if an agent's observation or action is missing or of another shape, the batch has changed since
                the reset, there was none, or with margin="certified" agents are observed to be larger than `radius`.
        """
        self._require_reset()
        observations = checked(observations, self._env, self._least_radius)
        agents = self._env.agents
        shape = observations[agents[0]].shape[:-1]
        self.wanted = {agent: _numbers(agent, action) for agent, action in actions.items()}
        flat = np.ascontiguousarray(side_by_side(observations, agents))
        batch = len(flat)
        if self._started.shape[0] != batch:
            if self._started.size:
                raise ValueError(f"the batch of observations changed from {len(self._started)} to {batch}: reset first")
            self.begin(batch)
        if self._others is not None:
            self._others.update(flat)
            flat = self._others.extrapolated(flat)
        fractions = np.stack([self._wanted(agent, batch) for agent in agents], axis=1)
        limit, period, drift = self._limit, self._env.control_period, self._drift(flat)
        wanted = np.clip(fractions, -1.0, 1.0, dtype=np.float64) * limit
        chosen, infeasible = np.empty_like(wanted), np.empty((batch, len(agents)), np.bool_)
        memory, found = (self._anchor, self._started), (chosen, infeasible)
        if self._brakes:
            correction = np.empty((batch, len(agents), 2))
            drive(self._columns, flat, wanted, drift, period, self.gamma, *memory, self._memory, *found, correction)
        else:
            filter_moves(self._columns, flat, wanted, drift, period, self.gamma, *memory, self._resting, *found)
            correction = chosen - wanted
        change = np.linalg.norm(correction, axis=2)
        changed = (np.linalg.norm(chosen - wanted, axis=2) > 0.0)[..., None]  # what isn't finite is refused later
        safe = np.where(changed, chosen / np.where(limit > 0.0, limit, 1.0), fractions).astype(np.float32)
        corrected = {}
        for number, agent in enumerate(agents):
            action = np.zeros((batch, self._env.action_sizes[agent]), np.float32)
            action[:, : self._sizes[agent]] = self.wanted[agent].reshape(batch, -1)
            inputs = self._env.models[agent].m
            action[:, :inputs] = safe[:, number, :inputs]
            if self.announce:
                anchor = self._anchor[:, number] / self._scale
                action[:, -ANNOUNCED:-2] = anchor
                action[:, -2] = self._started[:, number] & (np.abs(anchor) < 1.0).all(axis=1)
                action[:, -1] = self._resting[:, number] == periods_of_rest(self._env.control_period)
            corrected[agent] = action.reshape(*shape, -1)
            self.correction[agent] = correction[:, number].reshape(*shape, 2)
            self.intervention[agent] = change[:, number].reshape(shape)
            self.infeasible[agent] = infeasible[:, number].reshape(shape)
        return corrected

    def begin(self, batch: int, env_ids: IntArray | None = None) -> None:
        """New episodes have begun: no agent has an anchor.

        Args:
            batch: number of environments.
            env_ids: those in which they have begun; None for all.
        """
        self._require_reset()
        if env_ids is None:
            shape = batch, len(self._env.agents)
            self._anchor, self._started = np.zeros((*shape, 4 if self._brakes else 2)), np.zeros(shape, np.bool_)
            self._resting = np.zeros(shape, np.int64)
            self._memory = np.full((batch, self._pairs, 8), np.nan)
            if self._others is not None:
                self._others.begin(batch)
        elif len(self._started):
            self._started[env_ids], self._resting[env_ids], self._memory[env_ids] = False, 0, np.nan

    def get_state(self) -> dict[str, NDArray[Any]]:
        """A copy of what the filter remembers between actions; not of what the policy inside does."""
        self._require_reset()
        state = {name: getattr(self, f"_{name}").copy() for name in _REMEMBERED}
        return state if self._others is None else state | self._others.get_state()

    def set_state(self, state: Mapping[str, NDArray[Any]]) -> None:
        """Continue from `get_state()`'s result, after a reset in the same environment.

        Raises:
            ValueError: if it is of another team, batch or kind of filter; nothing has changed then.
        """
        require_state(state, self.get_state())
        for name in _REMEMBERED:
            setattr(self, f"_{name}", state[name].copy())
        if self._others is not None:
            self._others.set_state(state)

    def _require_reset(self) -> None:
        require_reset(self, "_env")

    def _wanted(self, agent: str, batch: int) -> Float32Array:
        """(B, M) what the policy inside wants of an agent, with zeros after its inputs."""
        if agent not in self.wanted:
            raise ValueError(f"the safety filter got no action for {agent!r}")
        wanted, expected = self.wanted[agent], (batch, self._sizes[agent])
        if wanted.size != batch * expected[1]:
            raise ValueError(
                f"actions of {agent!r} must have shape {expected}, one row per environment; the safety filter got "
                f"{wanted.shape}"
            )
        inputs, found = self._env.models[agent].m, np.zeros((batch, self._limit.shape[1]), np.float32)
        found[:, :inputs] = wanted.reshape(expected)[:, :inputs]
        return found

    def _drift(self, flat: Float32Array) -> FloatArray:
        """(B, N, 2) velocities of agents without an input."""
        places = flat[:, self._own].astype(float)
        drift = np.zeros_like(places)
        for number, model in self._drifting.items():
            drift[:, number] = model.drift(np.zeros(len(flat)), places[:, number])
        return drift

    # -- the environment -----------------------------------------------------------------------------------------

    def _observes_bounds(self, env: EnvDescription) -> bool:
        """Whether the policy inside gets the bounds, too."""
        if self._bounds is not None:
            return self._bounds
        policy = self.policy
        if getattr(policy, "needs_bounds", False):
            return True
        if isinstance(policy, PretrainedPolicy):
            policy = policy.chosen(env)
        return isinstance(policy, LearnedPolicy) and bool(policy.about.get("bounds"))


def _held(env: EnvDescription) -> Others:
    """Others, whose positions dead reckoning moves on; it leaves the truth as it is.

    Raises:
        ValueError: if there are none on estimates.
    """
    others = Others(env)
    if env.observe != "oracle" and not others.moved_on.any():
        raise ValueError(
            "dead_reckoning=True has nothing to do: it moves on estimates of integrators that hold the last position "
            "that arrived, by the age of their slots; give the environment a network, or leave it out for other models "
            "(their estimates are predictions)"
        )
    return others


def _numbers(agent: str, action: ArrayLike) -> Float32Array:
    try:
        return np.asarray(action, np.float32)
    except (TypeError, ValueError):
        raise ValueError(f"the action of {agent!r} isn't numbers: {action!r}") from None


class _NoPolicy:
    """Inside a filter that only corrects actions that it is given."""

    def __repr__(self) -> str:
        return "None"

    def reset(self, env: EnvDescription, seeds: Sequence[int]) -> None:
        """Nothing to prepare."""

    def act(self, observations: Observations) -> dict[str, Float32Array]:
        raise ValueError("there is no policy inside the safety filter: give it one, or call correct() with actions")
