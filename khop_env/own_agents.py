"""The package `agents` that belongs to khop_env, found where khop_env is and not by the order of `sys.path`.

Other projects have a package `agents`, too. In a process of `khop`, and in the workers of one, the name is khop_env's.
"""

from __future__ import annotations

import importlib.abc
import importlib.machinery
import importlib.util
import pickle
import sys
from collections.abc import Sequence
from pathlib import Path
from types import ModuleType
from typing import Any

AGENTS = "agents"
FOLDER = Path(__file__).resolve().parents[1] / AGENTS
"""Beside khop_env, in a clone and where packages are installed alike."""


class _Finder(importlib.abc.MetaPathFinder):
    """Finds `agents` and its modules in FOLDER alone.

    A foreign `__init__.py` that has overwritten ours isn't run: then the package is what its modules are.
    """

    def find_spec(
        self, name: str, path: Sequence[str] | None, target: ModuleType | None = None
    ) -> importlib.machinery.ModuleSpec | None:
        """Where a module of `agents` is; nothing for other names."""
        if name == AGENTS:
            if _is_ours(FOLDER / "__init__.py"):
                return importlib.util.spec_from_file_location(
                    AGENTS, FOLDER / "__init__.py", submodule_search_locations=[str(FOLDER)]
                )
            spec = importlib.machinery.ModuleSpec(AGENTS, None, is_package=True)
            spec.submodule_search_locations = [str(FOLDER)]
            return spec
        if not name.startswith(f"{AGENTS}."):
            return None
        found = importlib.machinery.PathFinder.find_spec(name, path)
        if found is None:
            raise ModuleNotFoundError(
                f"no {name!r}: in khop's processes {AGENTS!r} is khop_env's own package, in {FOLDER}; call another "
                "package of this name something else (or, if one has overwritten khop_env's, install each in an "
                "environment of its own)",
                name=name,
            )
        return found


def claim_agents() -> str | None:
    """Let `agents` be khop_env's from now on, in a process that is khop_env's own.

    Returns:
        What is wrong with it, if something is, in one line; its modules can be imported all the same.
    """
    loaded = sys.modules.get(AGENTS)
    if loaded is not None and FOLDER not in [Path(place).resolve() for place in getattr(loaded, "__path__", ())]:
        for name in [name for name in sys.modules if name.partition(".")[0] == AGENTS]:
            del sys.modules[name]  # whoever imported it keeps what was imported
    if not any(isinstance(finder, _Finder) for finder in sys.meta_path):
        sys.meta_path.insert(0, _Finder())
    if _is_ours(FOLDER / "__init__.py"):
        return None
    return (
        f"{FOLDER / '__init__.py'} isn't khop_env's: another package {AGENTS!r} has overwritten it, and "
        f"`from {AGENTS} import ...` won't find khop_env's names; install khop_env in an environment without that one"
    )


def call_pickled(pickled: bytes, *arguments: Any) -> None:
    """Call a pickled (function, object) as function(object, *arguments): the start of a process that khop_env starts.

    Args:
        pickled: may need `agents`.
        arguments: may not.
    """
    claim_agents()
    function, value = pickle.loads(pickled)
    function(value, *arguments)


def _is_ours(file: Path) -> bool:
    """Whether a file begins with the first line of khop_env's own `agents/__init__.py`."""
    try:
        with file.open(encoding="utf-8", errors="replace") as lines:
            return "khop_env" in lines.readline(500)
    except OSError:
        return False
