"""The PettingZoo environment: dictionaries by agent, from a batch of one environment."""

from __future__ import annotations

import functools
import itertools
import reprlib
import warnings
from collections.abc import Mapping
from typing import TYPE_CHECKING, Any

import numpy as np
from gymnasium.spaces import Box
from numpy.typing import NDArray
from pettingzoo import ParallelEnv

from khop_env.env.batched import BatchedEnv
from khop_env.env.layout import Float32Array, ObservationLayout
from khop_env.env.options import initial_states
from khop_env.env.state import EnvState, Infos
from khop_env.observers import FloatArray, IntArray
from khop_env.physics import did_you_mean, or_did_you_mean

if TYPE_CHECKING:
    from khop_env.env.rendering import Renderer

RENDER_MODES = ("human", "rgb_array")
ParallelStep = tuple[
    dict[str, Float32Array], dict[str, float], dict[str, bool], dict[str, bool], dict[str, dict[str, float]]
]


class KHopEnv(ParallelEnv[str, Float32Array, Float32Array]):
    """Agents under partial communication, with estimates of k-hop targets: a PettingZoo ParallelEnv.

    Observations, actions, rewards, infos and arguments are described in the modules `consensus_v0`, `formation_v0`,
    `leader_following_v0` and `navigation_v0`, which make such environments.

    Args:
        batched: a `BatchedEnv` with num_envs = 1.
        name: of the environment.
        render_mode: None, "human" or "rgb_array".

    Attributes:
        batched: the environment as arrays.

    Raises:
        ValueError: for an unknown render mode, or num_envs above 1.
    """

    def __init__(self, batched: BatchedEnv, *, name: str, render_mode: str | None = None) -> None:
        if batched.num_envs != 1:
            raise ValueError(
                f"a ParallelEnv is one environment; got num_envs={batched.num_envs}: use make_vec for several"
            )
        if render_mode is not None and render_mode not in RENDER_MODES:
            raise ValueError(
                f"render_mode must be None, 'human' or 'rgb_array'; got {render_mode!r}"
                f"{or_did_you_mean(render_mode, RENDER_MODES)}"
            )
        self.metadata = {
            "name": name,
            "render_modes": list(RENDER_MODES),
            "render_fps": 1.0 / batched.settings.control_period,
            "is_parallelizable": True,
        }
        self.batched, self.render_mode = batched, render_mode
        self.possible_agents = list(batched.agents)
        self.agents: list[str] = []
        self._layouts = dict(zip(batched.agents, batched.layouts, strict=True))
        self.observation_spaces = {
            agent: Box(layout.low, layout.high, dtype=np.float32) for agent, layout in self._layouts.items()
        }
        self._columns = _slices(batched.agents, batched.observation_offset)
        self._entries = _slices(batched.agents, batched.action_offset)
        self.action_spaces = {
            agent: Box(-1.0, 1.0, (part.stop - part.start,), np.float32) for agent, part in self._entries.items()
        }
        self.state_space = state_space(batched)
        self._actions = np.zeros((1, int(batched.action_offset[-1])))
        self._shapes = [space.shape for space in self.action_spaces.values()]
        self._begun = False
        self._renderer: Renderer | None = None
        if render_mode is not None:
            from khop_env.env.rendering import Renderer

            self._renderer = Renderer.of(batched.task, batched.world, batched.simulator.observers, title=name)

    def __repr__(self) -> str:
        return f"KHopEnv({self.batched})"

    def __str__(self) -> str:
        return str(self.metadata["name"])

    def observation_space(self, agent: str) -> Box:
        """The same object at every call."""
        return self.observation_spaces[self._known(agent)]

    def action_space(self, agent: str) -> Box:
        """[-1, 1] per input; the same object at every call."""
        return self.action_spaces[self._known(agent)]

    def layout(self, agent: str) -> ObservationLayout:
        """Names, units and bounds of every column of this agent's observation."""
        return self._layouts[self._known(agent)]

    def reset(
        self, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[dict[str, Float32Array], dict[str, dict[str, float]]]:
        """Start a new episode.

        Args:
            seed: draws initial states, disturbances and leaders' routes. Without a seed, an environment that was
                seeded goes on with its generator; if it never was, it draws fresh entropy.
            options: {"initial_state": {agent: states}} or the whole fleet's (n,); others are ignored with a warning.

        Raises:
            ValueError: for an unknown agent or states of a wrong length.
            DesignError: for initial states outside the funnels.
        """
        observations, infos = self.batched.reset(seed, initial_states=initial_states(self.batched.fleet, options))
        self.follow(begins=True)
        return self._by_agent(observations), self._infos(infos)

    def step(self, actions: Mapping[str, Float32Array]) -> ParallelStep:
        """Advance by one control period.

        Args:
            actions: one per agent, entries in [-1, 1].

        Raises:
            TypeError: if `actions` isn't a mapping; nothing has changed then.
            ValueError: if no episode is running, or an action is missing, of an unknown agent, of a wrong shape or
                not finite; nothing has changed then.
        """
        observations, reward, terminated, truncated, infos = self.batched.step(self._flat(actions))
        self.follow()
        agents = self.possible_agents
        return (
            self._by_agent(observations),
            dict(zip(agents, reward.tolist()[0])),  # noqa: B905 -- strict costs time, at every step
            dict.fromkeys(agents, terminated.item()),
            dict.fromkeys(agents, truncated.item()),
            self._infos(infos),
        )

    def observe(self, agent: str) -> Float32Array:
        """Observation of an agent at the present time."""
        return self.batched.observations().reshape(-1)[self._columns[self._known(agent)]]

    def state(self) -> Float32Array:
        """The true global state, leaders included; `batched.state_fields` names its entries."""
        return self.batched.state()[0]

    def get_state(self) -> EnvState:
        """Everything that the next steps depend on, generators included."""
        return self.batched.get_state()

    def set_state(self, state: EnvState) -> None:
        """Continue from `get_state()`'s result, bit for bit.

        Raises:
            TypeError: if it isn't an `EnvState`; nothing has changed then.
            ValueError: if it is of an environment of another task, actuator or size, naming the difference; likewise.
        """
        self.batched.set_state(state)
        self._begun = state.generators[0] is not None
        self.agents = [] if state.over[0] else list(self.possible_agents)
        self._remember(begins=True)

    def render(self) -> NDArray[np.uint8] | None:
        """A frame (H, W, 3) in mode "rgb_array"; shows it in mode "human".

        Raises:
            ModuleNotFoundError: without pygame-ce.
            ValueError: without a render mode, or before the first reset.
        """
        if self._renderer is None:
            raise ValueError(
                "render() needs a render mode: make the environment with render_mode='rgb_array' or 'human'"
            )
        if not self._begun:
            raise ValueError("there is nothing to render yet: call reset() first")
        return self._draw(self._renderer)

    def close(self) -> None:
        """Close the window, if there is one."""
        if self._renderer is not None:
            self._renderer.close()

    def _known(self, agent: str) -> str:
        fleet = self.batched.fleet
        if agent not in self._layouts:
            label = self.batched.task.driven_label
            why = f"it is a {label}, which takes no part" if agent in fleet.ids else did_you_mean(agent, self._layouts)
            raise ValueError(f"no agent {agent!r}; {why}")
        return agent

    def _flat(self, actions: Mapping[str, Float32Array]) -> FloatArray:
        if type(actions) is not dict and not isinstance(actions, Mapping):
            raise TypeError(
                f"step() takes a mapping with an action for each agent, {{{self.possible_agents[0]!r}: ..., ...}}; got "
                f"{reprlib.repr(actions)} ({type(actions).__name__}); arrays of all agents go to batched.step()"
            )
        if not self.agents:
            raise ValueError("no episode is running: it is over, or none has begun; call reset() first")
        if type(actions) is dict and len(actions) == len(self._shapes) and self._joined(actions):
            return self._actions
        if actions.keys() != self._entries.keys():
            for agent in actions:  # a wrong name explains the missing ones
                self._known(agent)
        flat = self._actions[0]
        for agent, part in self._entries.items():
            if agent not in actions:
                missing = [known for known in self.agents if known not in actions]
                raise ValueError(
                    f"actions are missing for {len(missing)} agent{'s' * (len(missing) > 1)}: {', '.join(missing[:8])}"
                )
            try:
                action = np.asarray(actions[agent], dtype=np.float64)
            except (TypeError, ValueError):
                raise ValueError(f"the action of {agent!r} isn't numbers: {actions[agent]!r}") from None
            if action.shape != (part.stop - part.start,):
                raise ValueError(
                    f"the action of {agent!r} must have shape ({part.stop - part.start},); got {action.shape}"
                )
            flat[part] = action
        return self._actions

    def _joined(self, actions: Mapping[str, Float32Array]) -> bool:
        """Write arrays of the agents' shapes into the flat action; False if they are anything else."""
        try:
            values = [actions[agent] for agent in self.possible_agents]
            if [value.shape for value in values] != self._shapes:
                return False
            np.concatenate(values, out=self._actions[0])
        except Exception:  # whatever it is, a look at one action after the other finds it
            return False
        return True

    def _by_agent(self, observations: Float32Array) -> dict[str, Float32Array]:
        if observations.ndim == 3:
            return dict(zip(self.possible_agents, observations[0]))  # noqa: B905
        flat = observations[0]
        return {agent: flat[part] for agent, part in self._columns.items()}

    def follow(self, *, begins: bool = False) -> None:
        """Bring `agents`, trails and the window up to date with `batched`, after a reset or a step of it.

        Args:
            begins: whether an episode has just begun.
        """
        self._begun = True
        self.agents = self.possible_agents.copy() if self.batched.running else []
        if self._renderer is None:
            return
        self._remember(begins=begins)
        if self.render_mode == "human":
            try:
                self._draw(self._renderer)
            except Exception as error:  # for any fault of a display: the step has been made, so return its results
                warnings.warn(f"the window isn't drawn: {error}", RuntimeWarning, stacklevel=3)

    def _infos(self, infos: Infos) -> dict[str, dict[str, float]]:
        rows = zip(*[values.tolist()[0] for values in infos.values()])  # noqa: B905
        return dict(zip(self.possible_agents, map(dict, map(zip, itertools.repeat(tuple(infos)), rows))))  # noqa: B905

    def _remember(self, *, begins: bool) -> None:
        """Add to the trails, or begin new ones, so that frames show the whole path however seldom they are drawn."""
        if self._renderer is None:
            return
        if begins:
            self._renderer.restart()
        self._renderer.remember(float(self.batched.simulator.t[0]), self.batched.simulator.x[0])

    def _draw(self, renderer: Renderer) -> NDArray[np.uint8] | None:
        from khop_env.env.rendering import Scene

        batched = self.batched
        decorate = functools.partial(batched.task.draw, world=batched.world)
        scene = Scene.of(batched.simulator, float(batched.task_errors().mean()), decorate)
        if self.render_mode == "rgb_array":
            return renderer.frame(scene)
        renderer.show(scene)
        return None


def _slices(agents: tuple[str, ...], offset: IntArray) -> dict[str, slice]:
    return {agent: slice(int(a), int(b)) for agent, a, b in zip(agents, offset[:-1], offset[1:], strict=True)}


def state_space(batched: BatchedEnv) -> Box:
    """The space of `BatchedEnv.state`'s rows."""
    low, high = (
        np.array([getattr(field, end) for field in batched.state_fields], np.float32) for end in ("low", "high")
    )
    return Box(low, high, dtype=np.float32)
