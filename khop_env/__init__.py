"""Decentralised k-hop prescribed performance observers, and multi-agent environments under partial communication."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium
import pettingzoo

if TYPE_CHECKING:
    from khop_env.registry import environments, make_sb3_vec, make_vec, scenario

__version__ = "0.1.0"

# `scenarios()` stays in `khop_env.registry`: here its name belongs to the package `khop_env.scenarios`
__all__ = ["__version__", "environments", "make_sb3_vec", "make_vec", "scenario"]


def __getattr__(name: str) -> Any:
    """Import what is asked for only then, so that `import khop_env` is quick."""
    if name in __all__:
        from khop_env import registry

        return getattr(registry, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])


def _register() -> None:
    """Tell Gymnasium and PettingZoo (1.26 and newer) what there is; nothing is built or compiled by that."""
    for module, name in (
        ("consensus_v0", "Consensus-v0"),
        ("formation_v0", "Formation-v0"),
        ("leader_following_v0", "LeaderFollowing-v0"),
    ):
        if f"khop/{name}" not in gymnasium.registry:
            gymnasium.register(f"khop/{name}", "khop_env.registry:make_joint", kwargs={"environment": module})
        if hasattr(pettingzoo, "register") and f"khop/{name}" not in pettingzoo.aec_registry:
            pettingzoo.register("aec", f"khop/{name}", f"khop_env.{module}:env")
            pettingzoo.register("parallel", f"khop/{name}", f"khop_env.{module}:parallel_env")


_register()
