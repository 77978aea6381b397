"""Learning: training of policies on estimates, and the trained policies."""

from agents.learning.config import ALGORITHMS, TrainingConfig
from agents.learning.learned import PRETRAINED, LearnedPolicy, PretrainedPolicy, pretrained_name
from agents.learning.policy_file import PolicyFileError
from agents.learning.scaling import ObservationScaler

__all__ = [
    "ALGORITHMS",
    "PRETRAINED",
    "LearnedPolicy",
    "ObservationScaler",
    "PolicyFileError",
    "PretrainedPolicy",
    "TrainingConfig",
    "pretrained_name",
]
