"""Decentralised k-hop prescribed performance observers, and multi-agent environments under partial communication.

All names below are attributes of this package: `khop_env.Scenario`, `khop_env.make_vec`, `khop_env.consensus_v0`. They
are imported when they are first asked for. Policies and feedback laws are in the package `agents`.
"""

from __future__ import annotations

import importlib
from typing import TYPE_CHECKING, Any

import gymnasium
import pettingzoo

from khop_env.catalog import ENVIRONMENTS, gymnasium_id

if TYPE_CHECKING:
    from khop_env import consensus_v0, formation_v0, leader_following_v0, navigation_v0
    from khop_env.env import (
        Actuator,
        BatchedEnv,
        CostsApart,
        Direct,
        Hold,
        JointEnv,
        KHopEnv,
        KHopVectorEnv,
        Lag,
        ObservationLayout,
        SlewLimit,
    )
    from khop_env.observers import (
        DesignError,
        Explicit,
        Exponential,
        FunnelError,
        ObserverDesign,
        PerformanceFunction,
        Proximal,
        SolveError,
        TargetObservers,
    )
    from khop_env.physics import (
        VELOCITY_CONTROLLERS,
        AgentModel,
        BandLimitedNoise,
        Coupling,
        Disturbance,
        DoubleIntegrator,
        DriftingIntegrator,
        Fleet,
        Gust,
        SingleIntegrator,
        Sinusoid,
        SurfaceVessel,
        Unicycle,
    )
    from khop_env.registry import (
        environments,
        make,
        make_aec,
        make_batched,
        make_joint,
        make_sb3_vec,
        make_vec,
        scenario,
    )
    from khop_env.results import Recording, paper_figure, record, summarize
    from khop_env.scenarios import LawChoice, Scenario
    from khop_env.simulation import Arena, InitialSet, Law, Obstacle, Simulator, View
    from khop_env.tasks import (
        Column,
        Consensus,
        EdgeTask,
        Formation,
        LeaderFollowing,
        Navigation,
        Outcome,
        Task,
        World,
    )
    from khop_env.testing import check_environment

__version__ = "0.1.0"

# `registry.scenarios()` isn't among them: here that name belongs to the package `khop_env.scenarios`
__all__ = [
    "VELOCITY_CONTROLLERS",
    "Actuator",
    "AgentModel",
    "Arena",
    "BandLimitedNoise",
    "BatchedEnv",
    "Column",
    "Consensus",
    "CostsApart",
    "Coupling",
    "DesignError",
    "Direct",
    "Disturbance",
    "DoubleIntegrator",
    "DriftingIntegrator",
    "EdgeTask",
    "Explicit",
    "Exponential",
    "Fleet",
    "Formation",
    "FunnelError",
    "Gust",
    "Hold",
    "InitialSet",
    "JointEnv",
    "KHopEnv",
    "KHopVectorEnv",
    "Lag",
    "Law",
    "LawChoice",
    "LeaderFollowing",
    "Navigation",
    "ObservationLayout",
    "ObserverDesign",
    "Obstacle",
    "Outcome",
    "PerformanceFunction",
    "Proximal",
    "Recording",
    "Scenario",
    "Simulator",
    "SingleIntegrator",
    "Sinusoid",
    "SlewLimit",
    "SolveError",
    "SurfaceVessel",
    "TargetObservers",
    "Task",
    "Unicycle",
    "View",
    "World",
    "__version__",
    "check_environment",
    "consensus_v0",
    "environments",
    "formation_v0",
    "leader_following_v0",
    "make",
    "make_aec",
    "make_batched",
    "make_joint",
    "make_sb3_vec",
    "make_vec",
    "navigation_v0",
    "paper_figure",
    "record",
    "scenario",
    "summarize",
]

# where these names are, in the order of imports: what stands before a name's place is needed by it anyway
_PLACES = ("physics", "observers", "simulation", "tasks", "env", "scenarios", "registry", "testing", "results")


if not TYPE_CHECKING:  # a type checker knows the names from above, and finds misspelt ones

    def __getattr__(name: str) -> Any:
        """Import what is asked for only then, so that `import khop_env` is quick."""
        if name in ENVIRONMENTS:
            return importlib.import_module(f"khop_env.{name}")
        if name in __all__:
            for place in _PLACES:
                module = importlib.import_module(f"khop_env.{place}")
                if name in module.__all__:
                    globals()[name] = found = getattr(module, name)
                    return found
        raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return list(__all__)


def _register() -> None:
    """Register all environments with Gymnasium and PettingZoo (1.26 and newer), without building anything."""
    for module in ENVIRONMENTS:
        name = gymnasium_id(module)
        if name not in gymnasium.registry:
            gymnasium.register(name, "khop_env.registry:make_joint", kwargs={"environment": module})
        if hasattr(pettingzoo, "register") and name not in pettingzoo.aec_registry:
            pettingzoo.register("aec", name, f"khop_env.{module}:env")
            pettingzoo.register("parallel", name, f"khop_env.{module}:parallel_env")


_register()
