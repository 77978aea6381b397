"""The Gymnasium vector environment: B copies of N agents as B x N rows."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from khop_env.env.batched import BatchedEnv
from khop_env.env.layout import Float32Array
from khop_env.env.options import initial_states
from khop_env.env.state import Infos
from khop_env.observers import FloatArray

VectorStep = tuple[Float32Array, FloatArray, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]


class KHopVectorEnv(VectorEnv[Float32Array, Float32Array, FloatArray]):
    """Rows are (copy, agent) pairs, the agents of one copy side by side: row b * N + i is agent i of copy b.

    Copies whose episode ends are reset in the same step (`AutoresetMode.SAME_STEP`): their rows hold the next episode's
    first observation, and infos["final_obs"] and infos["final_info"] the last one's. Without autoreset, and as arrays
    (B, N, ...) for centralised training, the same is `batched`.

    Args:
        batched: the copies, with uniform observations.
        name: of the environment.

    Attributes:
        batched: the environment as arrays (B, N, ...).
        num_envs: B x N rows.

    Raises:
        ValueError: for ragged observations.
    """

    def __init__(self, batched: BatchedEnv, *, name: str) -> None:
        require_uniform(batched, "a vector environment")
        self.metadata = {"name": name, "render_modes": [], "autoreset_mode": AutoresetMode.SAME_STEP}
        self.batched = batched
        self.num_envs = batched.num_envs * len(batched.agents)
        self.single_observation_space, self.single_action_space = single_spaces(batched)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Float32Array, dict[str, Any]]:
        """Start new episodes in all copies.

        Args:
            seed: copy b starts from seed + b, or from the b-th of B seeds.
            options: as for the ParallelEnv.
        """
        observations, infos = self.batched.reset(seed, initial_states=initial_states(self.batched.fleet, options))
        return self._rows(observations), self._described(infos)

    def step(self, actions: ArrayLike) -> VectorStep:  # type: ignore[override]  # Gymnasium's own flags are bool, too
        """Advance all rows by one control period.

        Args:
            actions: (rows, m) in [-1, 1].

        Raises:
            ValueError: for actions of a wrong shape or not finite.
        """
        batched, agents = self.batched, len(self.batched.agents)
        given = np.asarray(actions)
        if given.shape != self.action_space.shape:
            raise ValueError(f"actions must have shape {self.action_space.shape}; got {given.shape}")
        observations, reward, terminated, truncated, infos = batched.step(given.reshape(batched.num_envs, agents, -1))
        over = terminated | truncated
        if over.any():
            last, last_infos = self._rows(observations), infos
            observations, infos = batched.reset(env_ids=np.flatnonzero(over))
            described = self._described(infos)
            described |= self._final(last, last_infos, np.repeat(over, agents))
        else:
            described = self._described(infos)
        return (
            self._rows(observations),
            reward.reshape(-1),
            np.repeat(terminated, agents),
            np.repeat(truncated, agents),
            described,
        )

    def _rows(self, observations: Float32Array) -> Float32Array:
        return observations.reshape(self.num_envs, -1)

    def _described(self, infos: Infos) -> dict[str, Any]:
        """Infos in Gymnasium's form: an array per key, and which rows have it."""
        described: dict[str, Any] = {}
        for key, value in infos.items():
            described[key] = value.reshape(-1)
            described[f"_{key}"] = np.ones(self.num_envs, bool)
        return described

    def _final(self, observations: Float32Array, infos: Infos, over: NDArray[np.bool_]) -> dict[str, Any]:
        final_obs = np.full(self.num_envs, None, object)
        for row in np.flatnonzero(over):
            final_obs[row] = observations[row]
        final_info: dict[str, Any] = {}
        for key, value in infos.items():
            final_info[key] = np.where(over, value.reshape(-1), 0)
            final_info[f"_{key}"] = over.copy()
        return {"final_obs": final_obs, "_final_obs": over, "final_info": final_info, "_final_info": over.copy()}


def require_uniform(batched: BatchedEnv, what: str) -> None:
    """Refuse ragged observations.

    Raises:
        ValueError: with `what` needs uniform ones.
    """
    if not batched.settings.uniform:
        raise ValueError(f"{what} has one space for all rows: it needs uniform=True")


def single_spaces(batched: BatchedEnv) -> tuple[Box, Box]:
    """Observation and action space of one agent, of uniform environments."""
    layout = batched.layouts[0]
    size = int(batched.action_offset[1])
    return Box(layout.low, layout.high, dtype=np.float32), Box(-1.0, 1.0, (size,), np.float32)
