"""A safety filter round any policy, with certified estimates (docs/theory/safety.md)."""

from agents.safety.columns import Margin
from agents.safety.environments import ShieldedEnv
from agents.safety.filter import SafetyFilter, as_margin

__all__ = ["Margin", "SafetyFilter", "ShieldedEnv", "as_margin"]
