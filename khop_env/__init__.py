"""Decentralised k-hop prescribed performance observers, and multi-agent environments under partial communication."""

from __future__ import annotations

from typing import TYPE_CHECKING, Any

if TYPE_CHECKING:
    from khop_env.registry import scenario

__version__ = "0.1.0"

# `scenarios()` stays in `khop_env.registry`: here its name belongs to the package `khop_env.scenarios`
__all__ = ["__version__", "scenario"]


def __getattr__(name: str) -> Any:
    """Import what is asked for only then, so that `import khop_env` is quick."""
    if name == "scenario":
        from khop_env.registry import scenario

        return scenario
    raise AttributeError(f"module {__name__!r} has no attribute {name!r}")


def __dir__() -> list[str]:
    return sorted([*globals(), *__all__])
