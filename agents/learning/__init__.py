"""Learning: training of policies on estimates, and the trained policies.

`train`, sweeps, their results and `SlotAttention` are imported when they are first asked for: they need PyTorch and
Stable-Baselines3 (the extra `rl`), which policies that were trained don't.
"""

import importlib
from typing import TYPE_CHECKING, Any

from agents.learning.config import ALGORITHMS, TrainingConfig
from agents.learning.learned import LearnedPolicy
from agents.learning.policy_file import PolicyFileError
from agents.learning.pretrained import PRETRAINED, PretrainedPolicy, Shipped, load_pretrained, shipped
from agents.learning.scaling import ObservationScaler
from agents.learning.slots import SlotScaler

if TYPE_CHECKING:
    from agents.learning.attention import SlotAttention
    from agents.learning.sweep import run_sweep
    from agents.learning.sweep_file import Sweep, SweepRun, read_sweep
    from agents.learning.sweep_results import RunResult, SweepResult
    from agents.learning.training import Training, train

__all__ = [
    "ALGORITHMS",
    "PRETRAINED",
    "LearnedPolicy",
    "ObservationScaler",
    "PolicyFileError",
    "PretrainedPolicy",
    "RunResult",
    "Shipped",
    "SlotAttention",
    "SlotScaler",
    "Sweep",
    "SweepResult",
    "SweepRun",
    "Training",
    "TrainingConfig",
    "load_pretrained",
    "read_sweep",
    "run_sweep",
    "shipped",
    "train",
]

_ON_DEMAND = {
    ("Training", "train"): "training",
    ("SlotAttention",): "attention",
    ("run_sweep",): "sweep",
    ("Sweep", "SweepRun", "read_sweep"): "sweep_file",
    ("RunResult", "SweepResult"): "sweep_results",
}

if not TYPE_CHECKING:

    def __getattr__(name: str) -> Any:
        """Import what needs PyTorch only then."""
        for names, module in _ON_DEMAND.items():
            if name in names:
                return getattr(importlib.import_module(f"agents.learning.{module}"), name)
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")
