"""Policies for khop_env, from observation to action: feedback laws, learned policies, and their evaluation."""

from agents.comparison import Comparison, Row, compare, interval95
from agents.consensus import LinearConsensus, TanhConsensus
from agents.evaluation import Episodes, evaluate, play
from agents.formation import FormationLaw
from agents.laws import LAWS, LawError, make_law
from agents.leader_following import LeaderFollowingLaw
from agents.lyapunov import ComparisonGain
from agents.policies import POLICIES, make_policy, shielded
from agents.policy import EnvDescription, Policy, describe
from agents.safety import SafetyFilter, ShieldedEnv
from agents.scripted import LawPolicy, RandomPolicy, ZeroPolicy
from agents.set_iss import analytical_gain, injected_errors, swept_bounds
from agents.stable_baselines import sb3_policy
from agents.tuning import Tuned, tune
from agents.velocity_law import VelocityLaw

__all__ = [
    "LAWS",
    "POLICIES",
    "Comparison",
    "ComparisonGain",
    "EnvDescription",
    "Episodes",
    "FormationLaw",
    "LawError",
    "LawPolicy",
    "LeaderFollowingLaw",
    "LinearConsensus",
    "Policy",
    "RandomPolicy",
    "Row",
    "SafetyFilter",
    "ShieldedEnv",
    "TanhConsensus",
    "Tuned",
    "VelocityLaw",
    "ZeroPolicy",
    "analytical_gain",
    "compare",
    "describe",
    "evaluate",
    "injected_errors",
    "interval95",
    "make_law",
    "make_policy",
    "play",
    "sb3_policy",
    "shielded",
    "swept_bounds",
    "tune",
]
