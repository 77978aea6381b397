"""A Stable-Baselines3 model as a policy."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from agents.policy import EnvDescription, Observations, Policy, require_description, require_reset
from khop_env.env.layout import Float32Array

if TYPE_CHECKING:
    from stable_baselines3.common.base_class import BaseAlgorithm


def sb3_policy(model: BaseAlgorithm) -> Policy:
    """The deterministic policy of a model trained on the observations of `make_sb3_vec`, one row per agent.

        model = PPO("MlpPolicy", khop_env.make_sb3_vec("consensus_v0", num_envs=16)).learn(200_000)
        evaluate(env, {"ppo": sb3_policy(model), "tanh": make_policy("tanh")}, range(100))

    If the model's environment is a `VecNormalize`, observations are normalised as in training; a model loaded from a
    file needs that environment for it (`PPO.load(path, env=...)`).

    Args:
        model: any model with `predict`, recurrent or not.

    Raises:
        TypeError: if `model` has no `predict`.
    """
    if not callable(getattr(model, "predict", None)) or not hasattr(model, "observation_space"):
        raise TypeError(f"expected a Stable-Baselines3 model with predict(); got {type(model).__name__}")
    return _SB3Policy(model)


class _SB3Policy:
    def __init__(self, model: Any) -> None:
        self._model = model

    def reset(self, env: EnvDescription, seeds: Sequence[int]) -> None:
        """Check that the spaces fit.

        Raises:
            ValueError: if observations or actions have another shape than the model's.
        """
        require_description(env)
        expected = self._model.observation_space.shape, self._model.action_space.shape
        for agent, layout in env.layouts.items():
            if ((len(layout),), (env.action_sizes[agent],)) != expected:
                raise ValueError(
                    f"the model takes observations of shape {expected[0]} and gives actions of shape {expected[1]}, "
                    f"those of {agent!r} have {(len(layout),)} and {(env.action_sizes[agent],)}: train it on "
                    "make_sb3_vec with the same scenario and arguments, and evaluate it with uniform observations"
                )
        self._state: Any = None  # of a recurrent model
        self._begins = True

    def act(self, observations: Observations) -> dict[str, Float32Array]:
        """The model's actions."""
        require_reset(self, "_state")
        stacked = np.stack([np.asarray(observations[agent]) for agent in observations])
        rows = stacked.reshape(-1, stacked.shape[-1])
        normalised = self._model.get_vec_normalize_env()
        if normalised is not None:
            rows = normalised.normalize_obs(rows)
        begins = np.full(len(rows), self._begins)
        actions, self._state = self._model.predict(rows, self._state, begins, deterministic=True)
        self._begins = False
        return dict(zip(observations, np.reshape(actions, (*stacked.shape[:-1], -1)), strict=True))
