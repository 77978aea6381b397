"""Everything that the next update of a training depends on, for its checkpoint."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.vec_env import VecNormalize

from agents.learning.checkpoint import model_state, restore_model, restored
from agents.learning.environment import TrainingVecEnv

_RUNNING = ("mean", "var", "count")  # statistics of the discounted return, which normalise rewards

FAULTS = (ValueError, TypeError, KeyError, AttributeError, IndexError, OverflowError, RuntimeError)
"""What `restore_run` raises for values that aren't such a state."""


def run_state(algorithm: BaseAlgorithm, env: VecNormalize) -> dict[str, Any]:
    """The state of model and environment, for `write_checkpoint`."""
    learner: TrainingVecEnv = env.venv  # type: ignore[assignment]
    return {
        "model": model_state(algorithm),
        "environment": learner.batched.get_state(),
        "rewards": {name: getattr(env.ret_rms, name) for name in _RUNNING} | {"returns": env.returns},
        "before": learner.before,
        "shield": None if learner.shield is None else learner.shield.get_state(),
        "script": learner.script and learner.script.get_state(),
    }


def restore_run(algorithm: BaseAlgorithm, env: VecNormalize, saved: Mapping[str, Any]) -> None:
    """Restore the saved state in a new model and environment with the same settings.

    Raises:
        Exception: one of `FAULTS` if `saved` isn't such a state.
    """
    learner: TrainingVecEnv = env.venv  # type: ignore[assignment]
    env.reset()
    learner.batched.set_state(restored(learner.batched.get_state(), saved["environment"], "environment"))
    learner.before = restored(learner.before, saved["before"], "before")
    if (shield := learner.shield) is not None:
        shield.set_state(restored(shield.get_state(), saved["shield"], "shield"))
    if script := learner.script:
        script.set_state(restored(script.get_state(), saved["script"], "script"))
    rewards, running = saved["rewards"], env.ret_rms
    if not all(np.shape(rewards[name]) == () and np.isfinite(rewards[name]) for name in _RUNNING):
        raise ValueError("the running statistics of the rewards aren't finite")
    running.mean, running.var, running.count = (rewards[name] for name in _RUNNING)
    env.returns = restored(env.returns, rewards["returns"], "returns")
    restore_model(algorithm, saved["model"])
