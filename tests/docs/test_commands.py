"""Every `khop` command that the documentation prints exists: its name, its options, and their choices of values.

The command line's own parser reads them; nothing is run.
"""

import ast
import importlib
import json
import re
import shlex
from pathlib import Path

import pytest
import typer

from khop_env.cli import app
from khop_env.registry import SCENARIOS, environments

ROOT = Path(__file__).parents[2]
GENERATED = {"changelog.md", "command_line.md"}  # what was once true, and what comes from the parser itself
PAGES = [ROOT / "README.md", ROOT / "CONTRIBUTING.md"] + [
    page
    for kind in ("md", "ipynb")
    for page in sorted((ROOT / "docs").rglob(f"*.{kind}"))
    if not {"_build", ".ipynb_checkpoints"} & set(page.parts) and page.name not in GENERATED
]
EXAMPLES = sorted((ROOT / "examples").rglob("*.py"))
COMMANDS = typer.main.get_command(app)

LINE = re.compile(r"^[ \t$!>]*(?:\.venv/bin/)?(?:khop|python3? -m khop_env) (?!is\b)(.+)$", re.MULTILINE)
INLINE = re.compile(r"`(?:\.venv/bin/)?khop ([^`]+)`")


def text_of(page: Path) -> str:
    """The text of a page, the cells of a notebook, or the documentation string of an example."""
    text = page.read_text(encoding="utf-8")
    if page.suffix == ".ipynb":
        return "\n\n".join("".join(cell["source"]) for cell in json.loads(text)["cells"])
    return ast.get_docstring(ast.parse(text)) or "" if page.suffix == ".py" else text


def commands(text: str) -> list[tuple[list[str], bool]]:
    """Arguments of each command, and whether it is named in a sentence, where arguments may be left out."""
    text = text.replace("\\\n", " ")
    found = [(line, False) for line in LINE.findall(text)] + [(line, True) for line in INLINE.findall(text)]
    split = [(shlex.split(re.split(r"[|;>]|&&", line)[0], comments=True), named) for line, named in found]
    return [(arguments, named) for arguments, named in split if arguments and arguments[0] != "COMMAND"]


def fault(arguments: list[str], named: bool) -> str | None:
    """What the parser has against a command; None for nothing."""
    name, *rest = arguments
    if name.startswith("-"):
        command, rest = COMMANDS, arguments
    elif name in COMMANDS.commands:
        command = COMMANDS.commands[name]
    else:
        return f"no command {name!r}"
    try:
        parsed = command.make_context(name, list(rest)).params
    except Exception as error:  # of click, which some releases of Typer bring along under another name
        kind = type(error).__name__
        missing = kind == "MissingParameter" or (kind == "BadParameter" and any(map(str.isupper, rest)))  # --skew S
        return None if kind == "Exit" or (named and missing) else f"{kind}: {error}"
    for key in ("name", "environment"):
        value = parsed.get(key) or "ENV"
        if not value.isupper() and not re.search(r"[.:/]", value) and value not in {*SCENARIOS, *environments()}:
            return f"no scenario or environment {value!r}"
    return None


@pytest.mark.parametrize("page", PAGES + EXAMPLES, ids=lambda page: page.relative_to(ROOT).as_posix())
def test_commands_on_a_page_exist(page):
    faults = {shlex.join(["khop", *each]): fault(each, named) for each, named in commands(text_of(page))}
    assert not {command: why for command, why in faults.items() if why}


@pytest.mark.parametrize(
    ("text", "why"),
    [
        ("khop runs paper", "no command"),
        ("    $ khop run paper --durations 3", "NoSuchOption"),
        ("khop run paper --order 4", "BadParameter"),
        ("khop run paper --seed -1", "BadParameter"),
        ("khop run", "MissingParameter"),
        ("khop run papers   # comment", "no scenario"),
        ("khop check paper mixed_fleet", "UsageError"),
        ("See `khop evaluate consensus --csv`.", "no scenario"),
        ("`khop run --speed`", "NoSuchOption"),
        (".venv/bin/khop list --all", "NoSuchOption"),
        ("python -m khop_env bench --fast", "NoSuchOption"),
    ],
)
def test_a_wrong_command_is_found(text, why):
    [(arguments, named)] = commands(f"Text.\n\n{text}\n\nText.")
    assert why in fault(arguments, named)


@pytest.mark.parametrize(
    "text",
    ["khop run my_file.py:mine \\\n    --order 2 > out", "`khop run`", "`khop train --resume`", "`khop --version`"],
)
def test_a_right_command_is_not(text):
    [(arguments, named)] = commands(text)
    assert fault(arguments, named) is None


def test_the_page_of_the_command_line_has_every_command_and_option(monkeypatch):
    monkeypatch.syspath_prepend(str(ROOT / "docs"))
    page = importlib.import_module("generate_cli").page()
    sections = dict(re.findall(r"^## khop (\w+)\n(.*?)(?=^## |\Z)", page, re.MULTILINE | re.DOTALL))
    assert list(sections) == list(COMMANDS.commands)
    for name, command in COMMANDS.commands.items():
        for parameter in command.params:
            shown = parameter.opts[0] if parameter.opts[0].startswith("-") else parameter.metavar
            assert f"\n**`{shown}" in sections[name], (name, shown)
