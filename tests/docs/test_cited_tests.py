"""Tests that pages cite exist, and pages that Python files cite, with the headings that they name."""

import ast
import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = [page for page in sorted((ROOT / "docs").rglob("*.md")) if "_build" not in page.parts]
SOURCES = [
    path
    for folder in ("khop_env", "agents", "benchmarks", "tests", "examples", "docs")
    for path in sorted((ROOT / folder).rglob("*.py"))
]
CITED = re.compile(r"`(?P<file>(?:tests/)?(?:\w+/)*test_\w+\.py)(?P<names>(?:::\w+)*)`|`(?P<bare>test_\w+)`")
PAGE = re.compile(r'\bdocs/(?:\w+/)*\w+\.md(?:, "(?P<heading>[^"]+)")?')
WRITTEN_BY_THE_BUILD = {"docs/changelog.md", "docs/command_line.md"}


def names_in(path: Path) -> set[tuple[str, ...]]:
    """Functions and classes of a file, and functions of its classes as (class, function)."""
    found: set[tuple[str, ...]] = set()
    for node in ast.parse(path.read_text(encoding="utf-8")).body:
        if isinstance(node, ast.FunctionDef | ast.ClassDef):
            found.add((node.name,))
        if isinstance(node, ast.ClassDef):
            found |= {(node.name, inner.name) for inner in node.body if isinstance(inner, ast.FunctionDef)}
    return found


TESTS = {path: names_in(path) for path in sorted((ROOT / "tests").rglob("test_*.py"))}
ANYWHERE = {names[-1] for found in TESTS.values() for names in found}


def missing(text: str) -> list[str]:
    """Citations without a test, in a page. Behind a file's name "test_..." alone may be in any file of tests."""
    wrong = []
    for cited in CITED.finditer(text):
        if cited["bare"]:
            wrong += [cited[0]] * (cited["bare"] not in ANYWHERE)
            continue
        files = [path for path in TESTS if path.as_posix().endswith("/" + cited["file"])]
        names = tuple(cited["names"].split("::")[1:])
        if not files or (names and not any(names in TESTS[path] for path in files)):
            wrong.append(cited[0])
    return wrong


@pytest.mark.parametrize("page", PAGES, ids=lambda page: page.relative_to(ROOT / "docs").as_posix())
def test_tests_that_a_page_cites_exist(page):
    assert not missing(page.read_text(encoding="utf-8"))


def test_a_test_that_does_not_exist_is_found():
    here = "tests/docs/test_cited_tests.py"
    assert missing(f"`{here}::test_gone`, `tests/docs/test_gone.py`, `test_gone`, `{here}`") == [
        f"`{here}::test_gone`",
        "`tests/docs/test_gone.py`",
        "`test_gone`",
    ]
    assert not missing(f"`{here}::test_tests_that_a_page_cites_exist`, `test_tests_that_a_page_cites_exist`")


def prose(path: Path) -> str:
    """A Python file with its line breaks and comment signs taken out, so that a citation is in one piece."""
    return re.sub(r"\s*\n\s*(?:# )?", " ", path.read_text(encoding="utf-8"))


def titles(page: Path) -> set[str]:
    """Headings of a page without their numbers, and the bold words that begin its paragraphs."""
    text = page.read_text(encoding="utf-8")
    return set(re.findall(r"^#+ (?:\d+\. )?(.+)$", text, re.MULTILINE)) | set(
        re.findall(r"^\*\*([^*]+?)\.?\*\*", text, re.MULTILINE)
    )


def test_pages_that_python_files_cite_exist():
    wrong = []
    for path in SOURCES:
        for cited in PAGE.finditer(prose(path)):
            name = cited[0].partition(",")[0]
            if name in WRITTEN_BY_THE_BUILD:
                continue
            if not (ROOT / name).is_file() or (cited["heading"] and cited["heading"] not in titles(ROOT / name)):
                wrong.append(f"{path.relative_to(ROOT)}: {cited[0]}")
    assert not wrong
