"""The API reference has an entry for every public name, and one only."""

import importlib
import pkgutil
import re
from collections import Counter
from pathlib import Path

import pytest

import agents
import khop_env

ROOT = Path(__file__).parents[2]
TEXT = "\n".join(page.read_text(encoding="utf-8") for page in sorted((ROOT / "docs" / "api").glob("*.md")))
ENTRY = re.compile(r"^\.\. (?:auto(?:class|exception|function|data)|py:(?:data|type|module)):: (\S+)$", re.MULTILINE)
ENTRIES = Counter(ENTRY.findall(TEXT))
MODULES = [
    module
    for package in (khop_env, agents)
    for name in [
        package.__name__,
        *(f"{package.__name__}.{each.name}" for each in pkgutil.iter_modules(package.__path__) if each.ispkg),
    ]
    if hasattr(module := importlib.import_module(name), "__all__")
]
"""`khop_env`, `agents`, and the packages in them that say what is public."""


def test_there_is_something_to_document():
    assert {"khop_env.physics", "khop_env.env", "agents.learning"} <= {module.__name__ for module in MODULES}


def test_no_name_is_listed_twice():
    assert [name for name, count in ENTRIES.items() if count > 1] == []


@pytest.mark.parametrize("module", MODULES, ids=lambda module: module.__name__)
def test_every_public_name_has_one_entry(module):
    """Under one of its public places, where it is the same object."""
    for name in module.__all__:
        places = [f"{other.__name__}.{name}" for other in MODULES if name in other.__all__]
        same = [place for place in places if found(place) == getattr(module, name)]
        assert sum(place in ENTRIES for place in same) == 1, (f"{module.__name__}.{name}", same)


def test_every_entry_exists():
    for place in ENTRIES:
        found(place)


def test_the_overview_has_all_names_of_the_package():
    """Those of `khop_env`, once each; environments and the version aside, which are no entries of its tables."""
    overview = (ROOT / "docs" / "api" / "khop_env.md").read_text(encoding="utf-8")
    named = Counter(re.findall(r"^   ~khop_env\.(\w+)$", overview, re.MULTILINE))
    assert named == Counter(name for name in khop_env.__all__ if name != "__version__" and not name.endswith("_v0"))


def found(place: str):
    """The object at a dotted place."""
    module, _, name = place.rpartition(".")
    try:
        return getattr(importlib.import_module(module), name)
    except AttributeError:
        return importlib.import_module(place)  # a module that nothing has imported yet
