"""Learning: policies trained on estimated observations, and how they act afterwards."""

from agents.learning.config import ALGORITHMS, TrainingConfig
from agents.learning.learned import LearnedPolicy, PolicyFileError, PretrainedPolicy
from agents.learning.scaling import ObservationScaler

__all__ = ["ALGORITHMS", "LearnedPolicy", "ObservationScaler", "PolicyFileError", "PretrainedPolicy", "TrainingConfig"]
