"""The Stable-Baselines3 vector environment: one row per agent, so that a trained policy is shared between agents."""

from __future__ import annotations

import time
from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray
from stable_baselines3.common.vec_env import VecEnv
from stable_baselines3.common.vec_env.base_vec_env import VecEnvIndices

from khop_env.env.batched import BatchedEnv
from khop_env.env.layout import Float32Array
from khop_env.env.options import initial_states, reset_options
from khop_env.env.state import Infos
from khop_env.env.vector import require_uniform, single_spaces
from khop_env.observers import FloatArray


class KHopSB3VecEnv(VecEnv):
    """Rows are (environment, agent) pairs, the agents of an environment side by side; Stable-Baselines3's conventions.

    Environments whose episode ends are reset in the same step. The info of a row is empty until its episode ends; then
    it has the last "terminal_observation", the global state at the end as "terminal_state", "TimeLimit.truncated" (a
    horizon is a truncation, after which PPO bootstraps), "episode" as Stable-Baselines3's Monitor writes it (return "r"
    and length "l" of the row's episode, seconds "t" since the environment was made), from which ep_rew_mean is logged,
    and the infos of `BatchedEnv`.

    The rows of an environment have one seed, their options are merged, and attributes and methods are those of
    `batched`.

    Args:
        batched: the environments, with uniform observations.

    Attributes:
        batched: the environment as arrays (B, N, ...).
        infos: of the last step, as arrays (B, N), before the environments that ended were reset.

    Raises:
        ValueError: for ragged observations.
    """

    def __init__(self, batched: BatchedEnv) -> None:
        require_uniform(batched, "a Stable-Baselines3 VecEnv")
        self.batched = batched
        self.infos: Infos = {}
        self._actions: NDArray[Any] = np.zeros(0)
        self._made = time.perf_counter()
        self._returns, self._lengths = (
            np.zeros((batched.num_envs, len(batched.agents))),
            np.zeros(batched.num_envs, int),
        )
        super().__init__(batched.num_envs * len(batched.agents), *single_spaces(batched))

    def __repr__(self) -> str:
        return f"KHopSB3VecEnv({self.num_envs} rows; {self.batched})"

    def seed(self, seed: int | None = None) -> Sequence[int | None]:
        """Seed the next reset: environment b starts from seed + b.

        Args:
            seed: drawn from NumPy's global generator if left out, which Stable-Baselines3 seeds.

        Returns:
            The seed of each row, which is that of its copy.
        """
        first = super().seed(seed)[0]
        self._seeds = [first + row // len(self.batched.agents) for row in range(self.num_envs)]  # type: ignore[operator]
        return self._seeds

    def set_options(self, options: list[dict[str, Any]] | dict[str, Any] | None = None) -> None:
        """Options of the next reset, as for the ParallelEnv: the same for all rows, or for each row.

        Rows of one environment may set initial states of different agents.

        Raises:
            ValueError: for a list of another length, or of anything but dictionaries.
        """
        if options is not None and not isinstance(options, Mapping):
            if len(options) != self.num_envs:
                raise ValueError(
                    f"options are a dictionary, or a list with one for each of the {self.num_envs} rows; got "
                    f"{len(options)}"
                )
            options = [dict(reset_options(row_options)) for row_options in options]
        super().set_options(options)

    def reset(self) -> Float32Array:
        """Start new episodes in all environments, with the seed and options set before, which are used once.

        Raises:
            ValueError: for an unknown agent, or states of a wrong length, not finite, or different ones of rows of one
                environment.
        """
        seeds = self._seeds[:: len(self.batched.agents)]
        observations, _ = self.batched.reset(seeds, initial_states=self._initial_states())
        self._returns[...], self._lengths[...] = 0.0, 0
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
        actions, shape = np.asarray(self._actions), (self.num_envs, int(batched.action_offset[1]))
        if actions.shape != shape:
            raise ValueError(f"actions must have shape {shape}; got {actions.shape}")
        observations, reward, terminated, truncated, infos = batched.step(actions.reshape(batched.num_envs, agents, -1))
        self.infos = infos
        self._returns += reward
        self._lengths += 1
        over = terminated | truncated
        described: list[dict[str, Any]] = [{} for _ in range(self.num_envs)]
        if over.any():
            last, state = observations.reshape(self.num_envs, -1), batched.state()
            columns = {key: value.reshape(-1).tolist() for key, value in infos.items()}
            returns, elapsed = self._returns.reshape(-1), round(time.perf_counter() - self._made, 6)
            for row in np.flatnonzero(np.repeat(over, agents)).tolist():
                described[row] = {key: values[row] for key, values in columns.items()}
                described[row]["terminal_observation"] = last[row]
                described[row]["terminal_state"] = state[row // agents]
                described[row]["TimeLimit.truncated"] = bool(truncated[row // agents])
                length = int(self._lengths[row // agents])
                described[row]["episode"] = {"r": round(float(returns[row]), 6), "l": length, "t": elapsed}
            self._returns[over], self._lengths[over] = 0.0, 0
            observations, _ = batched.reset(env_ids=np.flatnonzero(over))
        rows = observations.reshape(self.num_envs, -1)
        return rows, reward.reshape(-1).astype(np.float32), np.repeat(over, agents), described

    def close(self) -> None:
        """Nothing to close."""

    def get_attr(self, attr_name: str, indices: VecEnvIndices = None) -> list[Any]:
        """An attribute of `batched`, once for every row.

        Raises:
            AttributeError: if `batched` has no such attribute.
            IndexError: if a row is out of range.
        """
        value = None if attr_name == "render_mode" else getattr(self.batched, attr_name)
        return [value for _ in self._rows(indices)]

    def set_attr(self, attr_name: str, value: Any, indices: VecEnvIndices = None) -> None:
        """Set an attribute of `batched`, for all rows at once.

        Raises:
            AttributeError: for some of the rows only, or if `batched` has no such attribute.
            IndexError: if a row is out of range.
        """
        self._require_all(f"{attr_name!r} can be set", self._rows(indices))
        if not hasattr(self.batched, attr_name):
            raise AttributeError(f"the environment has no attribute {attr_name!r} that could be set")
        setattr(self.batched, attr_name, value)

    def env_method(
        self, method_name: str, *method_args: Any, indices: VecEnvIndices = None, **method_kwargs: Any
    ) -> list[Any]:
        """Call a method of `batched` once; the result is repeated for every row in `indices`.

        Raises:
            AttributeError: if `batched` has no such method, or if it changes all rows and is called for some.
            IndexError: if a row is out of range.
        """
        rows = self._rows(indices)
        if method_name in ("reset", "step", "set_state"):
            self._require_all(f"{method_name!r} can be called", rows)
        result = getattr(self.batched, method_name)(*method_args, **method_kwargs)
        return [result for _ in rows]

    def env_is_wrapped(self, wrapper_class: type[Any], indices: VecEnvIndices = None) -> list[bool]:
        """Rows aren't wrapped."""
        return [False for _ in self._rows(indices)]

    def _rows(self, indices: VecEnvIndices) -> list[int]:
        """Indices of rows; negative ones count from the end.

        Raises:
            IndexError: if a row is out of range.
        """
        chosen = list(self._get_indices(indices))
        for row in chosen:
            if not -self.num_envs <= row < self.num_envs:
                raise IndexError(f"no row {row}: there are {self.num_envs}")
        return [row % self.num_envs for row in chosen]

    def _require_all(self, what: str, rows: list[int]) -> None:
        if set(rows) != set(range(self.num_envs)):
            raise AttributeError(
                f"rows share one environment: {what} for all {self.num_envs} of them, not for {len(set(rows))}; "
                "`batched` is the environment, and batched.reset(env_ids=...) resets some of the batch"
            )

    def _initial_states(self) -> FloatArray | None:
        """(B, n) initial states from the merged options of each environment's rows; nan where they are drawn.

        Raises:
            ValueError: for rows of one environment that set the same states differently.
        """
        if not any(self._options):
            return None
        fleet, agents = self.batched.fleet, len(self.batched.agents)
        x0 = np.full((self.batched.num_envs, fleet.n), np.nan)
        for row, options in enumerate(self._options):
            b, states = row // agents, initial_states(fleet, options)
            if states is None:
                continue
            if states.shape == x0.shape:
                states = states[b]
            if states.shape != (fleet.n,):
                raise ValueError(
                    f"option initial_state: expected {{agent: states}}, or an array of shape ({fleet.n},) or "
                    f"{x0.shape}; got {states.shape} for row {row}"
                )
            is_set = np.isfinite(states)
            if np.any(is_set & np.isfinite(x0[b]) & (x0[b] != states)):
                raise ValueError(
                    f"option initial_state: row {row} and a row before it are agents of environment {b}, and give the "
                    "same states different values; give each agent's once, or the same in all rows of the environment"
                )
            x0[b, is_set] = states[is_set]
        return x0
