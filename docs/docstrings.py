"""Docstrings for Sphinx: they are plain text with names and code between backquotes, not reStructuredText."""

import importlib
import re
import sys
from itertools import groupby
from typing import Any

import numpy as np
from docutils import nodes
from sphinx import addnodes
from sphinx.ext.napoleon import GoogleDocstring
from sphinx.pycode import ModuleAnalyzer

PACKAGES = (
    "khop_env",
    "khop_env.physics",
    "khop_env.network",
    "khop_env.observers",
    "khop_env.simulation",
    "khop_env.tasks",
    "khop_env.env",
    "khop_env.scenarios",
    "khop_env.results",
    "khop_env.testing",
    "agents",
    "agents.learning",
    "agents.safety",
)
"""Packages with public names. A name that several of them have is documented as that of the first."""

_SPAN = re.compile(r"`([^`]+)`", re.DOTALL)
_MARKUP = re.compile(r"\*\w+\*|[|*\\](?=\S)|(?<=\w)_(?=\W|$)")  # *emphasis* is meant
_PAGE = re.compile(r"\bdocs/(\w+/\w+)\.md\b")
_ARRAY = r"~?(?:numpy\.)?ndarray\[~?tuple\[~?(?:typing\.)?Any, \.\.\.\], ~?(?:numpy\.)?dtype\["
_HINTS = (
    (r"TypeAliasForwardRef\('(\w+)'\)", r"\1"),
    (_ARRAY + r"~?(?:typing\.)?Any\]\]", "NDArray[Any]"),
    (_ARRAY + r"~?(?:numpy\.)?(\w+)\]\]", r"NDArray[np.\1]"),
    ("<factory>", "..."),
)
_CLASS = re.compile(r"(?:khop_env|agents)(?:\.\w+)*\.(\w+)")
_BACK = re.compile(r'(id="([\w.]+)">\n<a class="viewcode-back" href="[^"#]*#)([\w.]+)')
_NO_PAGE = '<li><a href="builtins.html">builtins</a></li>\n'
_known: dict[str, str] = {}


def public_names() -> dict[str, str]:
    """Where each public name is documented, e.g. "Fleet": "khop_env.Fleet"."""
    if not _known:
        for package in PACKAGES:
            for name in importlib.import_module(package).__all__:
                _known.setdefault(name, f"{package}.{name}")
    return _known


def markup(app: Any, what: str, name: str, obj: Any, options: Any, docstring: list[str]) -> None:
    """Handler of autodoc's event for docstrings: changes its lines before napoleon reads their sections."""
    if what == "data":
        docstring[:] = _below(name.rpartition(".")[2], obj)
    if isinstance(obj, type) and (bases := _bases(obj)):
        end = docstring.index("") if "" in docstring else len(docstring)  # of the first paragraph, which overviews show
        docstring[end:end] = ["", bases]
    section, kinds = False, []
    for line in docstring:
        if line and not line.startswith(" "):
            section = bool(re.fullmatch(r"[A-Z][A-Za-z ]*:", line))
        if line:
            kinds.append(line.startswith("    ") and not section)
        else:
            kinds.append(bool(kinds) and kinds[-1])  # an empty line belongs to what is above it
    # fields of reStructuredText: napoleon would take what stands before a colon for a type
    lines = [re.sub(r"^(Returns|Yields):$", lambda found: f":{found[1]}:", line) for line in docstring]
    changed: list[str] = []
    for is_code, group in groupby(zip(kinds, lines, strict=True), key=lambda pair: pair[0]):
        block = [line for _, line in group]
        changed += ["", "::", "", *block, ""] if is_code else _text("\n".join(block), name).split("\n")
    if what in ("property", "data"):  # there napoleon reads no sections, and takes what is before a colon for a type
        changed = GoogleDocstring(changed, app.config, app, "method", name, obj, options).lines()
        if ":" in "".join(changed[:1]):
            changed[:0] = ["..", ""]
    docstring[:] = changed


def signature(app: Any, what: str, name: str, obj: Any, options: Any, given: str, returned: str) -> tuple[str, str]:
    """Handler of autodoc's event for signatures: types as they stand in the code, classes where they are documented."""
    if getattr(obj, "_is_protocol", False):  # never constructed
        return "", ""
    return _short(given), _short(returned)


def skip(app: Any, what: str, name: str, obj: Any, skipped: bool, options: Any) -> bool | None:
    """Handler of autodoc's event for members: none that only the class of their value describes."""
    return True if type(obj).__name__ == "_tuplegetter" or isinstance(obj, np.ndarray) else None


def other_types(app: Any, doctree: Any, page: str) -> None:
    """Handler of the event for finished pages: types of properties and aliases, for which there is no other event."""
    for kind in (addnodes.desc_annotation, nodes.paragraph):
        for node in doctree.findall(kind):
            text = node.astext()
            if (kind is addnodes.desc_annotation or text.startswith("alias of ")) and _short(text) != text:
                node[:] = [nodes.Text(_short(text))]


def back_links(app: Any, page: str, template: str, context: dict[str, Any], doctree: Any) -> None:
    """Handler of the event for pages to be written: links from source code back to what is documented of it.

    viewcode takes all names of a module for those of one package, and lists modules without a page.
    """
    module = page.removeprefix("_modules/").replace("/", ".")
    objects = app.env.get_domain("py").objects

    def corrected(found: re.Match[str]) -> str:
        places = (f"{package}.{found[2]}" for package in (*PACKAGES, module, "khop_env.registry"))
        return found[1] + next((place for place in places if place in objects), found[3])

    if page.startswith("_modules/"):
        context["body"] = _BACK.sub(corrected, context["body"]).replace(_NO_PAGE, "")


def _below(name: str, obj: Any) -> list[str]:
    """The string below a constant, in the module that defines it."""
    for place, module in list(sys.modules.items()):
        if place.partition(".")[0] in ("khop_env", "agents") and getattr(module, name, None) is obj:
            documented = ModuleAnalyzer.for_module(place).find_attr_docs()
            if ("", name) in documented:
                return list(documented["", name])
    return []


def _bases(obj: type) -> str:
    """The base classes that say something to a user, e.g. "Bases: `Task`"."""
    bases = [base for base in obj.__bases__ if base.__name__ not in ("object", "ABC", "Generic")]
    return f"Bases: {', '.join(f'`{base.__name__}`' for base in bases)}" if bases else ""


def _short(hint: str | None) -> str | None:
    for pattern, instead in _HINTS:
        hint = hint and re.sub(pattern, instead, hint)
    return hint and _CLASS.sub(lambda found: public_names().get(found[1], found[0]), hint)


def _text(text: str, name: str) -> str:
    """Text in which only backquotes mean something, and names of pages and public names are links."""
    parts = _SPAN.split(text)
    for k, part in enumerate(parts):
        if k % 2:
            place = _place(part, name)
            parts[k] = f":py:obj:`{part} <{place}>`" if place else f"`{part}`"
        else:
            literal = _MARKUP.sub(lambda found: found[0] if len(found[0]) > 1 else f"\\{found[0]}", part)
            parts[k] = _PAGE.sub(r":doc:`/\1`", literal)
    return "".join(parts)


def _place(text: str, name: str) -> str | None:
    """The entry that `text` in the docstring of `name` means: a public name, or a method; None for other text."""
    words = text.removesuffix("()").split(".")
    if not all(word.isidentifier() for word in words):
        return None
    packages = {word for package in PACKAGES for word in package.split(".")}
    known, certain = public_names(), text.endswith("()") or words[0] in packages
    owner = name if isinstance(_found(name), type) else name.rpartition(".")[0]
    if len(words) == 1 and isinstance(_found(owner), type) and callable(_found(f"{owner}.{words[0]}")):
        return f"{owner}.{words[0]}"
    while len(words) > 1 and words[0] in packages:
        del words[0]
    # a common word in lower case may also be an argument's name
    if words[0] not in known or not (certain or words[0] != words[0].lower() or "_" in words[0]):
        return None
    place = ".".join([known[words[0]], *words[1:]])
    return place if place != name and _found(place) is not None else None


def _found(place: str) -> Any:
    """The object there; None if there is none."""
    package = max((each for each in PACKAGES if place.startswith(f"{each}.")), key=len, default=None)
    if package is None:
        return None
    found: Any = importlib.import_module(package)
    for word in place.removeprefix(f"{package}.").split("."):
        found = getattr(found, word, None)
    return found
