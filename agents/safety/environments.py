"""Environments in which a safety filter corrects the actions of any learner."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any, NoReturn

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray
from pettingzoo.utils.wrappers import BaseParallelWrapper

from agents.policy import batched_of, describe
from agents.safety.columns import Margin
from agents.safety.filter import SafetyFilter
from khop_env.env import CostsApart, EnvState, KHopEnv, ObservationLayout
from khop_env.env.layout import Float32Array
from khop_env.tasks import World

Infos = dict[str, dict[str, Any]]
ShieldedState = tuple[EnvState, dict[str, NDArray[Any]]]


ARROW_TIME = 0.5  # s: frames show a filter's correction of a velocity as the way of this time,
ARROW_LENGTH = 0.75  # m: at most so long


class ShieldedEnv(BaseParallelWrapper[str, Float32Array, Float32Array]):
    """A ParallelEnv whose actions a safety filter corrects before the environment gets them.

        env = ShieldedEnv(navigation_v0.parallel_env(bounds=True))
        env = ShieldedEnv(navigation_v0.parallel_env(), margin=0.3)  # a constant margin: no guarantee

    Observations are without bounds unless `bounds=True`: the filter needs them, a learner hardly does. Infos have two
    more keys, "intervention", the length of the correction in m/s, and "infeasible"; `SafetyFilter` explains both, and
    does the same to a policy's actions. Frames have arrows and rings for them.

    Args:
        env: made with bounds=True for margin="certified", and with message_size=4 for announce=True.
        margin: of the filter.
        options: of `SafetyFilter`: gamma, announce, radius, bounds; not dead_reckoning, which needs a policy inside.

    Attributes:
        filter: the safety filter.

    Raises:
        TypeError: if `env` is no ParallelEnv of khop_env, or returns costs apart: CostsApart goes around a ShieldedEnv.
        ValueError: if the filter doesn't fit the environment, or an option is out of range.
    """

    def __init__(self, env: KHopEnv, margin: Margin = "certified", **options: Any) -> None:
        _require_parallel(env)
        super().__init__(env)
        self._inner = env
        self.filter = SafetyFilter(None, margin, **options)
        self.filter.reset(describe(env), [0])
        self.filter.begin(1)
        self.action_spaces = {
            agent: Box(-1.0, 1.0, (size,), np.float32) for agent, size in self.filter.inside.action_sizes.items()
        }
        self.observation_spaces = {agent: space_of(layout) for agent, layout in self.filter.inside.layouts.items()}
        self._seen_by_filter: dict[str, Float32Array] = {}

    @property
    def batched(self) -> NoReturn:
        """Refused: whoever steps the environment inside passes the filter by."""
        raise TypeError(
            "a ShieldedEnv isn't for functions that step the environment inside, such as evaluate(): give them "
            f"env.unwrapped and the policy shielded(policy, {self.filter.margin!r}); describe(env) describes it"
        )

    @property
    def _world(self) -> World:
        return batched_of(self._inner).world

    def observation_space(self, agent: str) -> Box:
        """The same object at every call."""
        self.env.observation_space(agent)  # names those that aren't there
        return self.observation_spaces[agent]

    def action_space(self, agent: str) -> Box:
        """[-1, 1] per input, without what the filter sends; the same object at every call."""
        self.env.action_space(agent)
        return self.action_spaces[agent]

    def layout(self, agent: str) -> ObservationLayout:
        """Names, units and bounds of every column of this agent's observation."""
        self.env.observation_space(agent)
        return self.filter.inside.layouts[agent]

    def reset(
        self, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[dict[str, Float32Array], Infos]:
        """Start a new episode, as the environment inside."""
        observations, infos = self.env.reset(seed=seed, options=options)
        self.filter.begin(1)
        self._world.arrows = self._world.marked = None
        nothing = {"intervention": 0.0, "infeasible": False}
        return self._seen(observations), {agent: {**info, **nothing} for agent, info in infos.items()}

    def step(
        self, actions: Mapping[str, Float32Array]
    ) -> tuple[dict[str, Float32Array], dict[str, float], dict[str, bool], dict[str, bool], Infos]:
        """Correct the actions, and advance by one control period.

        Args:
            actions: as for the environment inside.

        Raises:
            TypeError: as the environment inside; nothing has changed then.
            ValueError: likewise.
        """
        remembered, world = self.filter.get_state(), self._world
        shown = world.arrows, world.marked
        try:
            if isinstance(actions, Mapping) and self.agents:
                actions = {**actions, **self.filter.correct(self._seen_by_filter, actions)}
                show_corrections(world, self.filter)
            observations, rewards, terminations, truncations, infos = self.env.step(actions)
        except Exception:
            self.filter.set_state(remembered)
            world.arrows, world.marked = shown
            raise
        found = self.filter
        described: Infos = {
            agent: {
                **info,
                "intervention": float(found.intervention[agent]),
                "infeasible": bool(found.infeasible[agent]),
            }
            for agent, info in infos.items()
        }
        return self._seen(observations), rewards, terminations, truncations, described

    def observe(self, agent: str) -> Float32Array:
        """Observation of an agent at the present time."""
        return np.asarray(self.filter.seen({agent: self._inner.observe(agent)})[agent])

    def get_state(self) -> ShieldedState:
        """Everything that the next steps depend on, what the filter remembers included."""
        return self._inner.get_state(), self.filter.get_state()

    def set_state(self, state: ShieldedState) -> None:
        """Continue from `get_state()`'s result, bit for bit.

        Raises:
            TypeError: if it isn't of such an environment; nothing has changed then.
            ValueError: if it is of an environment of another task, actuator or size; likewise.
        """
        inner, remembered = state if isinstance(state, tuple) and len(state) == 2 else (state, None)
        if remembered is None:
            raise TypeError(f"set_state() takes what get_state() of a ShieldedEnv returned; got {type(state).__name__}")
        before = self.filter.get_state()
        self.filter.set_state(remembered)
        try:
            self._inner.set_state(inner)
        except Exception:
            self.filter.set_state(before)
            raise
        self._world.arrows = self._world.marked = None
        self._seen_by_filter = {agent: self._inner.observe(agent) for agent in self._inner.possible_agents}

    def _seen(self, observations: dict[str, Float32Array]) -> dict[str, Float32Array]:
        self._seen_by_filter = observations
        return dict(self.filter.seen(observations))


def show_corrections(world: World, policy: object) -> None:
    """Frames get arrows for what a safety filter changed, and rings where its guarantee had to be begun anew.

    Args:
        world: of the environment, of B environments.
        policy: the filter, or any policy with its attributes `correction` and `infeasible`; nothing is shown of others.
    """
    if correction := getattr(policy, "correction", None):
        arrows = ARROW_TIME * np.stack([np.atleast_2d(each).T for each in correction.values()])  # (N, 2, B)
        length = np.linalg.norm(arrows, axis=1, keepdims=True)
        world.arrows = arrows / np.maximum(length / ARROW_LENGTH, 1.0)
    if infeasible := getattr(policy, "infeasible", None):
        world.marked = np.stack([np.atleast_1d(each) for each in infeasible.values()])


def _require_parallel(env: object) -> None:
    """Refuse what a ShieldedEnv can't step.

    Raises:
        TypeError: naming what it is, and what to do.
    """
    inner = env
    while isinstance(inner, BaseParallelWrapper):
        if isinstance(inner, CostsApart):
            raise TypeError("costs come apart last: CostsApart(ShieldedEnv(env)), not ShieldedEnv(CostsApart(env))")
        if isinstance(inner, ShieldedEnv):
            raise TypeError("the environment is a ShieldedEnv already; give all options to one")
        inner = inner.env
    if not isinstance(inner, KHopEnv):
        raise TypeError(
            "a ShieldedEnv is around a ParallelEnv of khop_env, e.g. navigation_v0.parallel_env(bounds=True); got "
            f"{type(env).__name__}. Batches: SafetyFilter(None, ...).correct(observations, actions), or "
            "ShieldedSB3VecEnv for Stable-Baselines3"
        )


def space_of(layout: ObservationLayout) -> Box:
    """The space of observations with a layout."""
    return Box(layout.low, layout.high, dtype=np.float32)
