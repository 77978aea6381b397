"""The Gymnasium vector environment: B environments of N agents as B x N rows."""

from __future__ import annotations

import warnings
from collections.abc import Mapping, Sequence
from typing import Any

import gymnasium
import numpy as np
from gymnasium.spaces import Box
from gymnasium.vector import AutoresetMode, VectorEnv
from gymnasium.vector.utils import batch_space
from numpy.typing import ArrayLike, NDArray

from khop_env.env.batched import BatchedEnv
from khop_env.env.layout import Float32Array
from khop_env.env.options import initial_states, reset_options
from khop_env.env.state import Infos
from khop_env.observers import FloatArray

_WRAPPERS_MISCOUNT = tuple(map(int, gymnasium.__version__.split(".")[:2])) < (1, 4)

VectorStep = tuple[Float32Array, FloatArray, NDArray[np.bool_], NDArray[np.bool_], dict[str, Any]]


class KHopVectorEnv(VectorEnv[Float32Array, Float32Array, FloatArray]):
    """Rows are (environment, agent) pairs, environment by environment: row b * N + i is agent i of environment b.

    `autoreset_mode` is one of Gymnasium's three ways to reset an environment whose episode has ended:

    - "same_step": it is reset in the same step. Its rows hold the next episode's first observation, and
      infos["final_obs"] and infos["final_info"] the last one's. Every row of every step is a transition, as TorchRL
      and most training loops expect. Gymnasium's NormalizeObservation refuses it, and before Gymnasium 1.4 its
      wrappers for observations do, too, and RecordEpisodeStatistics and NormalizeReward miss a step per episode.
    - "next_step": it is reset in the step after; its rows hold the last observation until then. In that step its
      actions are ignored, its rewards are 0, and its rows hold the next episode's first observation. This is
      Gymnasium's own default, with which all of its wrappers work.
    - "disabled": it waits for `reset(options={"reset_mask": mask})`.

    `batched` has the same as arrays (B, N, ...), without autoreset, for centralised training.

    Args:
        batched: the environments, with uniform observations.
        name: of the environment.
        autoreset_mode: "same_step", "next_step", "disabled", or a `gymnasium.vector.AutoresetMode`; "same_step" if left
            out, with a warning where Gymnasium's wrappers would miscount.

    Attributes:
        batched: the environment as arrays (B, N, ...).
        num_envs: B x N rows.
        autoreset_mode: a `gymnasium.vector.AutoresetMode`, also in metadata["autoreset_mode"].

    Raises:
        ValueError: for ragged observations, or another autoreset mode.
    """

    def __init__(self, batched: BatchedEnv, *, name: str, autoreset_mode: str | AutoresetMode | None = None) -> None:
        require_uniform(batched, "a vector environment")
        if autoreset_mode is None and _WRAPPERS_MISCOUNT:
            warnings.warn(
                f"Gymnasium {gymnasium.__version__}'s RecordEpisodeStatistics and NormalizeReward miss a step per "
                "episode where environments are reset in the same step: give autoreset_mode='next_step' to use them, "
                "autoreset_mode='same_step' otherwise",
                UserWarning,
                stacklevel=3,
            )
        self.autoreset_mode = _autoreset_mode(AutoresetMode.SAME_STEP if autoreset_mode is None else autoreset_mode)
        self.metadata = {"name": name, "render_modes": [], "autoreset_mode": self.autoreset_mode}
        self.batched = batched
        self.num_envs = batched.num_envs * len(batched.agents)
        self.single_observation_space, self.single_action_space = single_spaces(batched)
        self.observation_space = batch_space(self.single_observation_space, self.num_envs)
        self.action_space = batch_space(self.single_action_space, self.num_envs)

    def __repr__(self) -> str:
        return f"KHopVectorEnv({self.num_envs} rows, autoreset {self.autoreset_mode.name.lower()}; {self.batched})"

    def reset(
        self, *, seed: int | Sequence[int | None] | None = None, options: Mapping[str, Any] | None = None
    ) -> tuple[Float32Array, dict[str, Any]]:
        """Start new episodes in all environments, or in those of a mask.

        Args:
            seed: environment b starts from seed + b, or from the b-th of B seeds.
            options: as for the ParallelEnv; and "reset_mask", (rows,) of bool, equal in all rows of an environment.

        Returns:
            Observations of all rows, and infos of those that were reset.

        Raises:
            ValueError: for a mask, seeds or initial states that don't fit; nothing has been reset then.
        """
        batched, chosen = self.batched, np.ones(self.batched.num_envs, bool)
        options = dict(reset_options(options))  # wrappers look for the mask in the caller's own
        if "reset_mask" in options:
            chosen = self._environments(options.pop("reset_mask"))
        which = np.flatnonzero(chosen)
        if isinstance(seed, Sequence) and len(seed) == batched.num_envs:
            seed = [seed[b] for b in which.tolist()]
        states = initial_states(batched.fleet, options)
        if states is not None and states.shape == (batched.num_envs, batched.fleet.n):
            states = states[which]
        observations, infos = batched.reset(seed, env_ids=which, initial_states=states)
        return self._rows(observations), self._described(infos, np.repeat(chosen, len(batched.agents)))

    def step(self, actions: ArrayLike) -> VectorStep:  # type: ignore[override]  # Gymnasium's own flags are bool, too
        """Advance all rows by one control period.

        Args:
            actions: (rows, m) in [-1, 1].

        Raises:
            ValueError: for actions of a wrong shape or not finite, or, without autoreset, an environment whose
                episode is over.
        """
        batched, agents = self.batched, len(self.batched.agents)
        values = np.asarray(actions)
        if values.shape != self.action_space.shape:
            raise ValueError(f"actions must have shape {self.action_space.shape}; got {values.shape}")
        values = values.reshape(batched.num_envs, agents, -1)
        ended = np.zeros(batched.num_envs, bool)
        if self.autoreset_mode is AutoresetMode.NEXT_STEP and not batched.running:
            ended = batched.over & batched.begun
        if ended.any():
            values = values.copy()
            values[ended] = 0
        observations, reward, terminated, truncated, infos = batched.step(values, ended)
        if ended.any():
            observations, infos = batched.reset(env_ids=np.flatnonzero(ended))
            reward[ended], terminated[ended], truncated[ended] = 0.0, False, False
        over, final = terminated | truncated, {}
        if self.autoreset_mode is AutoresetMode.SAME_STEP and over.any():
            final = self._final(self._rows(observations), infos, np.repeat(over, agents))
            observations, infos = batched.reset(env_ids=np.flatnonzero(over))
        return (
            self._rows(observations),
            reward.reshape(-1),
            np.repeat(terminated, agents),
            np.repeat(truncated, agents),
            self._described(infos, np.ones(self.num_envs, bool)) | final,
        )

    def _rows(self, observations: Float32Array) -> Float32Array:
        return observations.reshape(self.num_envs, -1)

    def _environments(self, mask: Any) -> NDArray[np.bool_]:
        """(B,) mask of environments from a mask of rows.

        Raises:
            ValueError: for anything but a mask of all rows of one or more environments.
        """
        if not isinstance(mask, np.ndarray) or mask.shape != (self.num_envs,) or mask.dtype != np.bool_:
            got = f"{mask.dtype} of shape {mask.shape}" if isinstance(mask, np.ndarray) else type(mask).__name__
            raise ValueError(f"option reset_mask must be an array of {self.num_envs} bool, one per row; got {got}")
        by_env = mask.reshape(self.batched.num_envs, -1)
        if not mask.any():
            raise ValueError("option reset_mask has no True: there is nothing to reset")
        torn = np.flatnonzero(by_env.any(axis=1) & ~by_env.all(axis=1))
        if torn.size:
            b, agents = int(torn[0]), by_env.shape[1]
            raise ValueError(
                f"option reset_mask: rows {b * agents} to {b * agents + agents - 1} are the agents of environment {b}, "
                f"which are reset together: mask all or none; got {by_env[b].tolist()}"
            )
        return np.asarray(by_env.all(axis=1))

    def _described(self, infos: Infos, rows: NDArray[np.bool_]) -> dict[str, Any]:
        """Infos in Gymnasium's form: an array per key, and which rows have it; 0 in the others."""
        described: dict[str, Any] = {}
        for key, value in infos.items():
            described[key] = np.where(rows, value.reshape(-1), 0)
            described[f"_{key}"] = rows.copy()
        return described

    def _final(self, observations: Float32Array, infos: Infos, over: NDArray[np.bool_]) -> dict[str, Any]:
        final_obs = np.full(self.num_envs, None, object)
        for row in np.flatnonzero(over):
            final_obs[row] = observations[row]
        final_info = self._described(infos, over)
        return {"final_obs": final_obs, "_final_obs": over, "final_info": final_info, "_final_info": over.copy()}


def _autoreset_mode(mode: str | AutoresetMode) -> AutoresetMode:
    for known in AutoresetMode:
        if mode in (known, known.value, known.name.lower()):
            return known
    raise ValueError(
        f"autoreset_mode must be 'same_step', 'next_step', 'disabled' or a gymnasium.vector.AutoresetMode; got {mode!r}"
    )


def require_uniform(batched: BatchedEnv, what: str) -> None:
    """Refuse ragged observations.

    Raises:
        ValueError: naming `what`, which needs uniform observations.
    """
    if not batched.settings.uniform:
        raise ValueError(f"{what} has one space for all rows: it needs uniform=True")


def single_spaces(batched: BatchedEnv) -> tuple[Box, Box]:
    """Observation and action space of one agent, of uniform environments."""
    layout = batched.layouts[0]
    size = int(batched.action_offset[1])
    return Box(layout.low, layout.high, dtype=np.float32), Box(-1.0, 1.0, (size,), np.float32)
