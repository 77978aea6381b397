"""Learning: training of policies on estimates, and the trained policies.

`train`, `Training` and `SlotAttention` are imported when they are first asked for: they need PyTorch and
Stable-Baselines3 (the extra `rl`), which policies that were trained don't.
"""

from typing import TYPE_CHECKING, Any

from agents.learning.config import ALGORITHMS, TrainingConfig
from agents.learning.learned import PRETRAINED, LearnedPolicy, PretrainedPolicy, pretrained_name
from agents.learning.policy_file import PolicyFileError
from agents.learning.scaling import ObservationScaler
from agents.learning.slots import SlotScaler

if TYPE_CHECKING:
    from agents.learning.attention import SlotAttention
    from agents.learning.training import Training, train

__all__ = [
    "ALGORITHMS",
    "PRETRAINED",
    "LearnedPolicy",
    "ObservationScaler",
    "PolicyFileError",
    "PretrainedPolicy",
    "SlotAttention",
    "SlotScaler",
    "Training",
    "TrainingConfig",
    "pretrained_name",
    "train",
]

if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        """Import what needs PyTorch only then."""
        if name in ("Training", "train"):
            from agents.learning import training

            return getattr(training, name)
        if name == "SlotAttention":
            from agents.learning.attention import SlotAttention

            return SlotAttention
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
