"""Decentralised k-hop prescribed performance observers, and multi-agent environments under partial communication."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

import gymnasium
import pettingzoo

from khop_env.catalog import ENVIRONMENTS, gymnasium_id

if TYPE_CHECKING:
    from khop_env.registry import environments, make, make_sb3_vec, make_vec, scenario

__version__ = "0.1.0"

# `scenarios()` stays in `khop_env.registry`: here its name belongs to the package `khop_env.scenarios`
__all__ = ["__version__", "environments", "make", "make_sb3_vec", "make_vec", "scenario"]


def __getattr__(name: str) -> Any:
    """Import what is asked for only then, so that `import khop_env` is quick."""
    if name in __all__:
        from khop_env import registry

        return getattr(registry, name)
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])


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
