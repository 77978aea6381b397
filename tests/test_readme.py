"""The code in the README runs, and so do the examples."""

import re
import runpy
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[1]


def test_the_readmes_python_runs(capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    snippets = re.findall(r"```python\n(.*?)```", (ROOT / "README.md").read_text(), flags=re.DOTALL)
    assert snippets
    for snippet in snippets:
        exec(compile(snippet, "README.md", "exec"), {})
    assert "bound.x1" in capsys.readouterr().out


@pytest.mark.parametrize("path", sorted((ROOT / "examples").glob("*.py")), ids=lambda path: path.name)
def test_example_runs(path, capsys, tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)  # they write below runs/
    monkeypatch.setattr("sys.argv", [str(path)])
    runpy.run_path(str(path), run_name="__main__")
    assert capsys.readouterr().out


def test_the_replay_refuses_a_folder_without_a_run(tmp_path, monkeypatch):
    path = ROOT / "examples" / "07_observer_on_a_robot.py"
    monkeypatch.setattr("sys.argv", [str(path), str(tmp_path / "nofolder")])
    with pytest.raises(SystemExit, match=r"nofolder isn't the folder of a khop run: it has no summary\.json and no st"):
        runpy.run_path(str(path), run_name="__main__")


def test_the_readme_is_short():
    lines = (ROOT / "README.md").read_text(encoding="utf-8").splitlines()
    assert len(lines) <= 130, "what a newcomer needs within a minute; everything else is in docs"


def test_ci_calls_the_readmes_test_command():
    assert "\nmake test" in (ROOT / "README.md").read_text()
    assert "\nmake test" in (ROOT / ".ci" / "run").read_text()
