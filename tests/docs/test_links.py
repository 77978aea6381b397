"""Links and images of all pages lead somewhere, and no image is left over."""

import json
import posixpath
import re
import shutil
import sys
from pathlib import Path
from urllib.parse import unquote

import pytest

ROOT = Path(__file__).parents[2]
DOCS = ROOT / "docs"
sys.path.append(str(DOCS))

import generate  # noqa: E402  (docs/generate.py)

FENCE = re.compile(r"^(`{3,})(?!\{(?:figure|image)\})[^\n]*\n.*?^\1`*[ ]*$", re.DOTALL | re.MULTILINE)
LINKS = (
    re.compile(
        r"!?\[(?:[^\[\]]|\[[^\]]*\]|!\[[^\]]*\]\([^)]*\))*\]\(<?([^)\s>]+)>?(?:\s+\"[^\"]*\")?\)"
    ),  # [text](target)
    re.compile(r"!\[[^\]]*\]\(([^)\s]+)\)"),  # an image in a link, too
    re.compile(r"<(?:img|a|video|source)\b[^>]*?\b(?:src|href)=\"([^\"]+)\""),
    re.compile(r"^[`:]{3,}\{(?:figure|image)\} +(\S+)", re.MULTILINE),
    re.compile(r"^:(?:img-top|img-bottom|img-background): +(\S+)", re.MULTILINE),
)
LABEL = re.compile(r"^\(([\w-]+)\)=$|\{#([\w-]+)\}|\b(?:id|name)=\"([\w-]+)\"", re.MULTILINE)
ELSEWHERE = re.compile(r"[a-z][a-z+.-]*:")  # https:, mailto:


def all_pages(folder: Path) -> dict[str, str]:
    """Text of all pages by path from the root, those that docs/generate.py makes included."""
    shutil.copy(ROOT / "CHANGELOG.md", folder)
    (folder / "docs").mkdir()
    generate.all_pages(folder / "docs")
    made = {page.relative_to(folder).as_posix(): page for page in (folder / "docs").rglob("*.md")}
    written = [ROOT / name for name in ("README.md", "CONTRIBUTING.md", "CHANGELOG.md")]
    written += [page for kind in ("md", "ipynb") for page in DOCS.rglob(f"*.{kind}")]
    written = [page for page in written if not {"_build", ".ipynb_checkpoints"} & set(page.parts)]
    pages = {page.relative_to(ROOT).as_posix(): page for page in written} | made
    return {name: text_of(page) for name, page in pages.items()}


def text_of(page: Path) -> str:
    """A page without code; of a notebook the cells that are Markdown."""
    text = page.read_text(encoding="utf-8")
    if page.suffix == ".ipynb":
        cells = [cell for cell in json.loads(text)["cells"] if cell["cell_type"] == "markdown"]
        text = "\n\n".join("".join(cell["source"]) for cell in cells)
    return FENCE.sub("", text)


def without_code(text: str) -> str:
    return re.sub(r"(`+)(?!`)[^\n]*?(?<!`)\1(?!`)", "", text)


def targets(text: str) -> set[str]:
    """Targets of links and images."""
    return {unquote(found) for pattern in LINKS for found in pattern.findall(without_code(text))}


def anchors(text: str) -> set[str]:
    """Anchors of headings, as GitHub and MyST make them, and labels."""
    found: set[str] = {name for names in LABEL.findall(text) for name in names if name}
    for heading in re.findall(r"^#{1,6} +(.*?)(?: +#+)?$", text, re.MULTILINE):
        heading = re.sub(r"!?\[([^\]]*)\]\([^)]*\)|\{#[\w-]+\}", r"\1", heading).strip()
        slug = re.sub(r"[^\w\- ]", "", heading.lower()).replace(" ", "-")
        found.add(next(name for n in range(len(found) + 1) if (name := f"{slug}-{n}" if n else slug) not in found))
    return found


def broken(pages: dict[str, str]) -> list[str]:
    """Links that lead nowhere."""
    faults = []
    labels = {name for text in pages.values() for names in LABEL.findall(text) for name in names if name}
    for page, text in pages.items():
        for target in sorted(targets(text)):
            path, _, anchor = target.partition("#")
            name = posixpath.normpath(posixpath.join(posixpath.dirname(page), path)) if path else page
            if ELSEWHERE.match(target) or (target in labels and not anchor):  # MyST finds labels on any page
                continue
            if name not in pages and not (ROOT / name).exists():
                faults.append(f"{page}: there is no {target}")
            elif anchor and name in pages and anchor not in anchors(pages[name]):
                faults.append(f"{page}: {name} has no heading #{anchor}")
    return faults


@pytest.fixture(scope="module")
def pages(tmp_path_factory):
    return all_pages(tmp_path_factory.mktemp("pages"))


def test_every_link_leads_somewhere(pages):
    faults = broken(pages)
    assert not faults, "\n".join(faults)


def test_pages_that_the_changelog_names_are_links(pages):
    assert re.search(r"docs/\w+/\w+\.md", pages["CHANGELOG.md"])
    assert re.findall(r"docs/\w+/\w+\.md", pages["docs/changelog.md"]) == []


def test_no_image_is_left_over(pages):
    shown = {
        posixpath.normpath(posixpath.join(posixpath.dirname(page), target))
        for page, text in pages.items()
        for target in targets(text)
    }
    images = {path.relative_to(ROOT).as_posix() for path in (DOCS / "images").iterdir()}
    assert not images - shown, "images that no page shows"


@pytest.mark.parametrize(
    ("link", "fault"),
    [
        ("[text](other.md)", None),
        ("[text](other.md#the-second-one)", None),
        ("[text](other.md#the-second-one-1)", None),
        ("[text](other.md#label)", None),
        ("[text](../README.md)", None),
        ("[text](https://example.org/nothing)", None),
        ("`[text](nothing.md)`", None),
        ("```\n[text](nothing.md)\n```", None),
        ("[text](nothing.md)", "there is no nothing.md"),
        ("![text](nothing.png)", "there is no nothing.png"),
        ("[![text](nothing.png)](other.md)", "there is no nothing.png"),
        ("[several `words` of\ntext](nothing.md)", "there is no nothing.md"),
        ('<img src="nothing.png">', "there is no nothing.png"),
        (":img-top: nothing.png", "there is no nothing.png"),
        ("```{figure} nothing.png\n```", "there is no nothing.png"),
        ("[text](other.md#third)", "site/other.md has no heading #third"),
        ("[text](#third)", "site/page.md has no heading #third"),
    ],
)
def test_faults_are_found(link, fault):
    other = "# One\n\n## The `second`, one!\n\n(label)=\n## The second one\n"
    pages = {"site/page.md": FENCE.sub("", f"# Page\n\n{link}\n"), "site/other.md": other}
    assert broken(pages) == ([] if fault is None else [f"site/page.md: {fault}"])
