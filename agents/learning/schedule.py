"""What changes in the course of a training: exploration ends, and the unit of rewards follows the returns."""

from __future__ import annotations

import torch
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.on_policy_algorithm import OnPolicyAlgorithm
from stable_baselines3.common.vec_env import VecNormalize

from agents.learning.config import TrainingConfig


def follow_schedule(model: BaseAlgorithm, env: VecNormalize, config: TrainingConfig) -> None:
    """Set what depends on the progress of the training; called before each collection of samples.

    The policy's logarithmic standard deviation is limited to a value that falls linearly, and the entropy bonus, which
    works against the limit, falls with it. Rewards are divided by a running standard deviation of returns, to which
    each sample counts 1 / count: with the count limited it forgets exponentially.

    Args:
        model: of Stable-Baselines3; changed.
        env: the environment that it trains on; changed.
        config: its `log_std`, `log_std_end`, `explore`, `entropy` and `reward_memory`.
    """
    if config.reward_memory:
        env.ret_rms.count = min(env.ret_rms.count, config.reward_memory)
    if config.log_std_end > config.log_std or not isinstance(model, OnPolicyAlgorithm):
        return
    left = min(1.0, max(0.0, 1.0 - model.num_timesteps / config.timesteps) / (1.0 - config.explore))
    limit = config.log_std_end + left * (config.log_std - config.log_std_end)
    with torch.no_grad():
        model.policy.log_std.clamp_(max=limit)
    model.ent_coef = left * config.entropy
