"""Pages of the site that are made from the library: environments, the command line, the changelog."""

import re
from pathlib import Path


def all_pages(docs: Path) -> None:
    """Write every generated page; git ignores them."""
    for maker in (environments, command_line, changelog):
        maker(docs)


def environments(docs: Path) -> None:
    """A page for each environment."""
    from environment_page import environment_page

    from khop_env.catalog import ENVIRONMENTS

    for name in ENVIRONMENTS:
        _write(docs / "environments" / f"{name}.md", environment_page(name))


def command_line(docs: Path) -> None:
    """The commands with their arguments and options."""
    import generate_cli

    _write(docs / "command_line.md", generate_cli.page())


def changelog(docs: Path) -> None:
    """The changelog of the repository, with links to pages."""
    text = (docs.parent / "CHANGELOG.md").read_text(encoding="utf-8")
    _write(docs / "changelog.md", re.sub(r"(?<![\w/])(?<!\]\()docs/([\w/]+\.md)", r"[](\1)", text))


def _write(page: Path, text: str) -> None:
    """Write a page if it differs, so that Sphinx reads again only what has changed."""
    if not page.exists() or page.read_text(encoding="utf-8") != text:
        page.parent.mkdir(parents=True, exist_ok=True)
        page.write_text(text, encoding="utf-8")
