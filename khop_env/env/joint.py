"""The centralised single-agent environment: one Gymnasium agent that observes and moves the whole team."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from numpy.typing import ArrayLike, NDArray

from khop_env.env.layout import Float32Array
from khop_env.env.options import initial_states
from khop_env.env.parallel import RENDER_MODES, KHopEnv
from khop_env.env.state import Infos

_AGGREGATES: dict[str, Callable[..., Any]] = {
    "max_normalized_disagreement": np.max,
    "max_error_to_bound": np.max,
    "cost": np.max,
    "min_distance": np.min,
    "obstacle_distance": np.min,
    "clipped_observations": np.sum,
    "clipped_actions": np.sum,
}
"""Aggregation of the agents' infos into the team's; others are means."""


class JointEnv(gymnasium.Env[Float32Array, Float32Array]):
    """All agents' observations side by side, all their actions side by side, and the mean of their rewards.

    Infos hold the largest ratios, the sums of the clip counts, and the means of all other values.

    Args:
        env: the ParallelEnv.

    Attributes:
        env: the ParallelEnv; `env.layout(agent)` names the columns of an agent's observation, and
            `env.batched.observation_offset` is where they begin.
    """

    metadata = {"render_modes": list(RENDER_MODES), "render_fps": 20}  # noqa: RUF012

    def __init__(self, env: KHopEnv) -> None:
        self.env, self.render_mode = env, env.render_mode
        self.metadata = dict(env.metadata)
        layouts = env.batched.layouts
        low, high = (np.concatenate([getattr(layout, end) for layout in layouts]) for end in ("low", "high"))
        self.observation_space = Box(low, high, dtype=np.float32)
        self.action_space = Box(-1.0, 1.0, (int(env.batched.action_offset[-1]),), np.float32)

    def __repr__(self) -> str:
        return f"JointEnv({self.env.batched})"

    def __str__(self) -> str:
        return repr(self)  # Gymnasium's own says nothing

    def reset(
        self, *, seed: int | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Float32Array, dict[str, Any]]:
        """Start a new episode.

        Args:
            seed: as for the ParallelEnv.
            options: likewise.
        """
        batched = self.env.batched
        observations, infos = batched.reset(seed, initial_states=initial_states(batched.fleet, options))
        super().reset(seed=seed)
        self.env.follow(begins=True)
        return observations.reshape(-1), self._info(infos)

    def step(self, action: ArrayLike) -> tuple[Float32Array, float, bool, bool, dict[str, Any]]:
        """Advance by one control period.

        Args:
            action: (A,) all agents' actions, in [-1, 1].

        Raises:
            ValueError: if no episode is running, or for an action of a wrong shape or not finite.
        """
        values = np.asarray(action)
        if values.shape != self.action_space.shape:
            raise ValueError(f"the action must have shape {self.action_space.shape}; got {values.shape}")
        observations, reward, terminated, truncated, infos = self.env.batched.step(values[None])
        self.env.follow()
        info = self._info(infos)
        return observations.reshape(-1), float(reward.mean()), bool(terminated[0]), bool(truncated[0]), info

    def state(self) -> Float32Array:
        """The true global state."""
        return self.env.state()

    def render(self) -> NDArray[np.uint8] | None:
        """A frame (H, W, 3), or the window."""
        return self.env.render()

    def close(self) -> None:
        """Close the window, if there is one."""
        self.env.close()

    def _info(self, infos: Infos) -> dict[str, Any]:
        return {name: _AGGREGATES.get(name, np.mean)(values).item() for name, values in infos.items()}
