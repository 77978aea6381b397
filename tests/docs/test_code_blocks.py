"""The Python of every page runs, from top to bottom, as a reader would type it.

A block that can't run here has the line `<!-- not run: REASON -->` above it.
"""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGES = [page for page in sorted((ROOT / "docs").rglob("*.md")) if "_build" not in page.parts]
GENERATED = ("changelog.md", "command_line.md")
BLOCK = re.compile(r"(?:<!-- not run: ([^\n]+) -->\n+)?^```python\n(.*?)^```", re.DOTALL | re.MULTILINE)


def blocks(page: Path) -> list[str]:
    """Blocks of a page that are to run."""
    return [code for reason, code in BLOCK.findall(page.read_text(encoding="utf-8")) if not reason]


@pytest.mark.parametrize(
    "page",
    [page for page in PAGES if page.name not in GENERATED and not page.name.endswith("_v0.md") and blocks(page)],
    ids=lambda page: page.relative_to(ROOT / "docs").as_posix(),
)
def test_the_python_of_a_page_runs(page, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # some write below runs/
    names = {"__name__": "__page__"}
    for code in blocks(page):
        exec(compile(code, str(page), "exec"), names)
