"""The Python of every page runs, from top to bottom, as a reader would type it, and prints what the page shows.

A block that can't run here has the line `<!-- not run: REASON -->` above it. A block of ```text right below a block of
Python is what that prints.
"""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = [page for page in sorted((ROOT / "docs").rglob("*.md")) if "_build" not in page.parts]
GENERATED = ("changelog.md", "command_line.md")
BLOCK = re.compile(
    r"(?:<!-- not run: ([^\n]+) -->\n+)?^```python\n(.*?)^```$(?:\n+```text\n(.*?)^```$)?", re.DOTALL | re.MULTILINE
)
NUMBER = re.compile(r"(?<![\w.])[-+]?\d+(?:\.\d+)?(?:[eE][-+]?\d+)?")


def blocks(page: Path) -> list[tuple[str, str]]:
    """Blocks of a page that are to run, and what each prints, "" where the page doesn't say."""
    text = page.read_text(encoding="utf-8")
    return [(code, printed) for reason, code, printed in BLOCK.findall(text) if not reason]


def numbers(text: str) -> list[float]:
    return [float(number) for number in NUMBER.findall(text)]


def words(text: str) -> list[str]:
    return NUMBER.sub("#", text).split()


def same(printed: str, shown: str) -> bool:
    """Whether a page shows what was printed; other processors may round to another last digit."""
    return words(printed) == words(shown) and numbers(printed) == pytest.approx(numbers(shown), rel=0.02, abs=1e-9)


@pytest.mark.parametrize(
    "page",
    [page for page in PAGES if page.name not in GENERATED and not page.name.endswith("_v0.md") and blocks(page)],
    ids=lambda page: page.relative_to(ROOT / "docs").as_posix(),
)
def test_the_python_of_a_page_runs_and_prints_what_it_shows(page, tmp_path, monkeypatch, capsys):
    monkeypatch.chdir(tmp_path)  # some write below runs/
    names = {"__name__": "__page__"}
    for code, shown in blocks(page):
        capsys.readouterr()
        exec(compile(code, str(page), "exec"), names)
        printed = capsys.readouterr().out
        assert not shown or same(printed, shown), f"the page shows\n{shown}\nbut it prints\n{printed}"


def test_other_words_and_numbers_are_found():
    assert same("kept 0.9851, at 1.21e-05 s\n", "kept 0.985, at 1.2e-05 s\n")
    assert not same("kept 0.985", "left 0.985")
    assert not same("kept 0.985", "kept 0.895")
    assert not same("kept 0.985", "kept 0.985, 3")


def test_what_is_shown_belongs_to_the_block_above(tmp_path):
    page = tmp_path / "page.md"
    page.write_text(
        "```python\na()\n```\n\n```text\n1\n```\n\n<!-- not run: no -->\n```python\nb()\n```\n```python\nc()\n```\n"
    )
    assert blocks(page) == [("a()\n", "1\n"), ("c()\n", "")]
