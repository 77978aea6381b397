"""Every public name says what it is, and every public function what its arguments are."""

import functools
import importlib
import inspect
import pkgutil
import re
import types
from pathlib import Path
from typing import Protocol

import pytest

import agents
import khop_env

ROOT = Path(__file__).parents[1]
PACKAGES = ["agents", "khop_env"] + [
    f"{package.__name__}.{found.name}"
    for package in (agents, khop_env)
    for found in pkgutil.iter_modules(package.__path__)
    if found.ispkg
]


def public_names() -> dict[str, object]:
    """Names in __all__ of each package, classes and functions only: aliases and tables can't have a docstring."""
    found = {}
    for name in PACKAGES:
        package = importlib.import_module(name)
        for public in getattr(package, "__all__", ()):
            member = getattr(package, public)
            if inspect.isclass(member) or inspect.isroutine(member) or hasattr(member, "py_func"):
                found[f"{name}.{public}"] = member
    return found


NAMES = public_names()
CLASSES = {name: member for name, member in NAMES.items() if inspect.isclass(member)}


def members(cls: type) -> dict[str, object]:
    """Public methods and properties that a class of ours defines itself, and __call__."""
    kinds = (property, functools.cached_property, types.FunctionType)
    return {
        name: member
        for name, member in vars(cls).items()
        if (not name.startswith("_") or name == "__call__") and isinstance(getattr(member, "__func__", member), kinds)
    }


def documentation(cls: type) -> str:
    """Docstrings of a class and of its bases, which explain what they declare."""
    return " ".join(inspect.cleandoc(base.__doc__ or "") for base in cls.__mro__ if base is not object)


def mentions(text: str, argument: str) -> bool:
    """True if a docstring has the argument's name as a word."""
    return re.search(rf"(?<![\w.]){re.escape(argument)}(?!\w)", text) is not None


def arguments(function: object) -> list[str]:
    """Named parameters without self, cls, and catch-alls."""
    function = getattr(function, "py_func", function)
    parameters = inspect.signature(function).parameters.values()
    return [
        p.name for p in parameters if p.name not in ("self", "cls") and p.kind not in (p.VAR_POSITIONAL, p.VAR_KEYWORD)
    ]


def lacking(text: str, names: list[str], few: int = 1) -> list[str]:
    """Arguments that a docstring doesn't explain.

    A section on arguments has a line for each. Without one, half of the arguments named in a sentence tell the others,
    and few need not be named at all.
    """
    if "Args:" in text:
        return [name for name in names if not re.search(rf"^\s+{re.escape(name)}: ", text, re.MULTILINE)]
    missing = [name for name in names if not mentions(text, name)]
    return [] if len(names) <= few or 2 * len(missing) <= len(names) else missing


@pytest.mark.parametrize("package", PACKAGES)
def test_packages_say_what_they_are(package: str) -> None:
    assert (importlib.import_module(package).__doc__ or "").strip()


@pytest.mark.parametrize("name", NAMES)
def test_public_names_have_a_docstring_of_their_own(name: str) -> None:
    """Not one inherited, nor the signature that dataclass writes when there is none."""
    member = NAMES[name]
    text = vars(member).get("__doc__") if inspect.isclass(member) else member.__doc__
    assert text
    assert text.strip()
    if inspect.isclass(member):
        assert not text.startswith(f"{member.__name__}(")


@pytest.mark.parametrize("name", CLASSES)
def test_public_methods_and_properties_have_a_docstring(name: str) -> None:
    without = [
        method for method, member in members(CLASSES[name]).items() if not (inspect.getdoc(member) or "").strip()
    ]
    assert not without


@pytest.mark.parametrize("name", [name for name in NAMES if name not in CLASSES])
def test_functions_explain_their_arguments(name: str) -> None:
    assert not lacking(NAMES[name].__doc__, arguments(NAMES[name]))


@pytest.mark.parametrize("name", CLASSES)
def test_classes_explain_what_they_are_built_from(name: str) -> None:
    """Each constructor argument, in the docstring of the class or of a base that declares it."""
    cls = CLASSES[name]
    if Protocol in cls.__mro__ and getattr(cls, "_is_protocol", False):
        return
    if issubclass(cls, BaseException) or cls.__init__ is object.__init__:
        return
    assert not lacking(documentation(cls), arguments(cls.__init__))


@pytest.mark.parametrize("name", CLASSES)
def test_methods_explain_their_arguments(name: str) -> None:
    """In their own docstring or in that of the method they implement; few arguments may speak for themselves."""
    cls = CLASSES[name]
    poor = {}
    for method, member in members(cls).items():
        function = getattr(member, "__func__", member)
        if not isinstance(function, types.FunctionType):
            continue
        texts = [inspect.getdoc(vars(base)[method]) or "" for base in cls.__mro__ if method in vars(base)]
        if missing := lacking(" ".join(texts), arguments(function), few=3):
            poor[method] = missing
    assert not poor


@pytest.mark.parametrize(
    "page", [ROOT / "README.md", *sorted((ROOT / "docs").rglob("*.md"))], ids=lambda page: page.name
)
def test_pages_have_no_placeholders(page):
    found = re.findall(r"@[A-Z]+@", page.read_text(encoding="utf-8"))
    assert not found, f"{page.name}: {found} were to be replaced by what was measured"
