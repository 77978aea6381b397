"""Notebooks are committed as they are run: without outputs, listed, linted, and with links that lead somewhere.

The build of the site runs them.
"""

import json
import re
import subprocess
import sys
from pathlib import Path

import pytest

FOLDER = Path(__file__).parents[2] / "docs" / "notebooks"
NOTEBOOKS = sorted(FOLDER.glob("*.ipynb"))
LINK = re.compile(r"\]\((?!https?://|#)([^)#\s]+)(?:#[^)]*)?\)")


def cells(path: Path, kind: str) -> list[dict]:
    """The cells of a kind in a notebook."""
    return [cell for cell in json.loads(path.read_text(encoding="utf-8"))["cells"] if cell["cell_type"] == kind]


def test_there_are_notebooks():
    assert {path.stem for path in NOTEBOOKS} >= {"paper", "train_and_compare", "your_own_task", "networks", "safety"}


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_a_notebook_has_no_outputs(path):
    for cell in cells(path, "code"):
        assert cell["outputs"] == [], f"{path.name}, cell {cell['id']!r}: clear its outputs"
        assert cell["execution_count"] is None, f"{path.name}, cell {cell['id']!r}: clear its execution count"
    assert json.loads(path.read_text(encoding="utf-8"))["metadata"]["kernelspec"]["name"] == "python3"


@pytest.mark.parametrize("path", NOTEBOOKS, ids=lambda path: path.stem)
def test_links_of_a_notebook_lead_to_files(path):
    for cell in cells(path, "markdown"):
        for link in LINK.findall("".join(cell["source"])):
            assert (FOLDER / link).is_file(), f"{path.name}, cell {cell['id']!r}: there is no {link}"


def test_every_notebook_is_in_the_index():
    text = (FOLDER / "index.md").read_text(encoding="utf-8")
    listed = re.search(r"```\{toctree\}\n(?::\w+:.*\n)*\n(.*?)```", text, re.DOTALL)[1].split()
    assert sorted(listed) == [path.stem for path in NOTEBOOKS]
    for path in NOTEBOOKS:
        assert f"({path.name})" in text, f"{path.name} isn't in the table"


def test_the_code_of_notebooks_is_linted():
    pytest.importorskip("ruff", reason="ruff is in the extra dev; make lint has it, and covers notebooks")
    found = subprocess.run(
        [sys.executable, "-m", "ruff", "check", *NOTEBOOKS], cwd=FOLDER, capture_output=True, text=True
    )
    assert found.returncode == 0, found.stdout + found.stderr
