"""The Stable-Baselines3 vector environment: one sub-environment per agent, parameters shared by whoever trains."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from khop_env.env.batched import BatchedEnv
from khop_env.env.layout import Float32Array
from khop_env.env.options import initial_states
from khop_env.env.state import Infos
from khop_env.env.vector import require_uniform, single_spaces


class KHopSB3VecEnv(VecEnv):
    """Rows are (copy, agent) pairs, the agents of one copy side by side, with Stable-Baselines3's conventions.

    Copies whose episode ends are reset in the same step. The info of a row is empty until its episode ends; then it has
    the last "terminal_observation", "TimeLimit.truncated" (a horizon is a truncation, after which PPO bootstraps) and
    the keys of the other environments.

    Args:
        batched: the copies, with uniform observations.

    Attributes:
        batched: the environment as arrays (B, N, ...).
        infos: of the last step, as arrays (B, N), before copies that ended were reset.

    Raises:
        ValueError: for ragged observations.
    """

    def __init__(self, batched: BatchedEnv) -> None:
        require_uniform(batched, "a Stable-Baselines3 VecEnv")
        self.batched = batched
        self.infos: Infos = {}
        self._actions: NDArray[Any] = np.zeros(0)
        super().__init__(batched.num_envs * len(batched.agents), *single_spaces(batched))

    def reset(self) -> Float32Array:
        """Start new episodes in all copies; from the seed given to `seed`, copy b from seed + b.

        Options given to `set_options` are those of the ParallelEnv; they hold for all copies.
        """
        observations, _ = self.batched.reset(
            self._seeds[0], initial_states=initial_states(self.batched.fleet, self._options[0])
        )
        self._reset_seeds()
        self._reset_options()
        self.reset_infos = [{} for _ in range(self.num_envs)]
        return observations.reshape(self.num_envs, -1)

    def step_async(self, actions: NDArray[Any]) -> None:
        """Take the actions (rows, m)."""
        self._actions = actions

    def step_wait(self) -> tuple[Float32Array, Float32Array, NDArray[np.bool_], list[dict[str, Any]]]:
        """Advance all rows by one control period.

        Raises:
            ValueError: for actions of a wrong shape or not finite; nothing has changed then.
        """
        batched, agents = self.batched, len(self.batched.agents)
        given, shape = np.asarray(self._actions), (self.num_envs, int(batched.action_offset[1]))
        if given.shape != shape:
            raise ValueError(f"actions must have shape {shape}; got {given.shape}")
        observations, reward, terminated, truncated, infos = batched.step(given.reshape(batched.num_envs, agents, -1))
        self.infos = infos
        over = terminated | truncated
        described: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if over.any():
            last = observations.reshape(self.num_envs, -1)
            columns = {key: value.reshape(-1).tolist() for key, value in infos.items()}
            for row in np.flatnonzero(np.repeat(over, agents)).tolist():
                described[row] = {key: values[row] for key, values in columns.items()}
                described[row]["terminal_observation"] = last[row]
                described[row]["TimeLimit.truncated"] = bool(truncated[row // agents])
            observations, _ = batched.reset(env_ids=np.flatnonzero(over))
        rows = observations.reshape(self.num_envs, -1)
        return rows, reward.reshape(-1).astype(np.float32), np.repeat(over, agents), described

    def close(self) -> None:
        """Nothing to close."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """The same attribute of the whole for every row."""
        value = None if attr_name == "render_mode" else getattr(self.batched, attr_name)
        return [value for _ in self._get_indices(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Refused: rows aren't environments of their own.

        Raises:
            AttributeError: always.
        """
        raise AttributeError(f"rows share one environment; set {attr_name!r} of `batched`, or build another one")

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of the whole once; the result stands for every row that is asked for."""
        result = getattr(self.batched, method_name)(*method_args, **method_kwargs)
        return [result for _ in self._get_indices(indices)]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        """Rows aren't wrapped."""
        return [False for _ in self._get_indices(indices)]
