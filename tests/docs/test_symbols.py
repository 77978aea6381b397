"""Every name in the code columns of the table of symbols can be imported."""

import importlib
import inspect
import re
from pathlib import Path

import pytest

PAGE = Path(__file__).parents[2] / "docs" / "concepts" / "symbols.md"
TABLES = "".join(line for line in PAGE.read_text(encoding="utf-8").splitlines(keepends=True) if line.startswith("|"))
NAMES = [
    name if name.startswith("agents.") else f"khop_env.{name}" for name in sorted(set(re.findall(r"`([^`]+)`", TABLES)))
]


def has(found: object, name: str) -> bool:
    """True for an attribute, a field of a dataclass, or an attribute that the docstring of a class lists."""
    if hasattr(found, name):
        return True
    if not inspect.isclass(found):
        return False
    declared = any(name in vars(base).get("__annotations__", {}) for base in found.__mro__)
    return declared or re.search(rf"^\s+{name}: ", inspect.getdoc(found) or "", re.MULTILINE) is not None


def resolves(name: str) -> bool:
    """True if modules, then attributes lead to a name."""
    parts = name.split(".")
    found: object = importlib.import_module(parts[0])
    for place, part in enumerate(parts[1:], 1):
        if not has(found, part):
            try:
                found = importlib.import_module(".".join(parts[: place + 1]))
            except ImportError:
                return False
        elif place < len(parts) - 1:
            found = getattr(found, part)
    return True


@pytest.mark.parametrize("name", NAMES)
def test_names_can_be_imported(name):
    assert resolves(name)


def test_a_name_that_does_not_exist_is_found():
    assert len(NAMES) > 60
    assert not resolves("khop_env.Simulator.nothing")
    assert not resolves("khop_env.nothing.at_all")
