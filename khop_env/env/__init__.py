"""Environments: PettingZoo, Gymnasium and Stable-Baselines3 interfaces to one batched environment."""

from khop_env.env.actuators import ACTUATORS, Actuator, Direct, Hold, Lag, SlewLimit
from khop_env.env.batched import BatchedEnv
from khop_env.env.costs import CostsApart
from khop_env.env.joint import JointEnv
from khop_env.env.layout import Field, ObservationLayout, Slot
from khop_env.env.parallel import KHopEnv
from khop_env.env.settings import Settings, SettingsArguments
from khop_env.env.state import SHARED_INFOS, EnvState
from khop_env.env.vector import KHopVectorEnv

__all__ = [
    "ACTUATORS",
    "SHARED_INFOS",
    "Actuator",
    "BatchedEnv",
    "CostsApart",
    "Direct",
    "EnvState",
    "Field",
    "Hold",
    "JointEnv",
    "KHopEnv",
    "KHopVectorEnv",
    "Lag",
    "ObservationLayout",
    "Settings",
    "SettingsArguments",
    "SlewLimit",
    "Slot",
]
