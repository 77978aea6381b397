"""A training that is small enough for tests."""

from agents.learning import TrainingConfig

SMALL = TrainingConfig("consensus_v0", "mixed_fleet", timesteps=15_000, num_envs=16, evaluations=3, batch_size=512)
