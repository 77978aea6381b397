"""The version, the supported Pythons, the extras and the workflows say the same everywhere."""

import re
import tomllib
from pathlib import Path

import pytest
import yaml
from try_wheel import supported

import khop_env

ROOT = Path(__file__).parents[2]
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text())["project"]
WORKFLOWS = sorted((ROOT / ".github" / "workflows").glob("*.yml"))


def test_the_version_is_written_once_and_cited():
    assert PROJECT["dynamic"] == ["version"]
    cited = yaml.safe_load((ROOT / "CITATION.cff").read_text())
    assert cited["version"] == khop_env.__version__
    assert f"\n## {khop_env.__version__} " in (ROOT / "CHANGELOG.md").read_text()


def test_the_same_pythons_are_supported_and_tried():
    assert PROJECT["requires-python"] == f">={supported()[0]}"
    tests, wheel = (yaml.safe_load(path.read_text()) for path in WORKFLOWS if path.stem in ("tests", "wheel"))
    assert tests["jobs"]["test"]["strategy"]["matrix"]["python"] == supported()
    settings = [step.get("with", {}) for step in wheel["jobs"]["wheel"]["steps"]]
    (chosen,) = [each["python-version"] for each in settings if "python-version" in each]
    assert set(chosen.split()) == {supported()[0], supported()[-1]}


@pytest.mark.parametrize("extra", PROJECT["optional-dependencies"])
def test_every_extra_is_explained(extra):
    """With the line that installs it."""
    assert re.search(rf"^\| `{extra}` \|", (ROOT / "CONTRIBUTING.md").read_text(), flags=re.MULTILINE)


@pytest.mark.parametrize("path", WORKFLOWS, ids=lambda path: path.stem)
def test_a_workflow_runs_targets_of_the_makefile(path):
    content = yaml.safe_load(path.read_text())
    assert content["permissions"] == {"contents": "read"}
    steps = [step for job in content["jobs"].values() for step in job["steps"]]
    lines = [line for step in steps for line in step.get("run", "").splitlines()]
    assert lines
    targets = re.findall(r"^([\w-]+):(?!=)", (ROOT / "Makefile").read_text(), flags=re.MULTILINE)
    for line in lines:
        assert line.split()[0] == "make"
        assert line.split()[1] in targets, line


def test_ci_runs_what_the_workflows_run_and_the_tests_last():
    lines = (ROOT / ".ci" / "run").read_text().splitlines()
    assert lines[-1] == "make test"
    text = "".join(path.read_text() for path in WORKFLOWS)
    assert {line for line in lines if line.startswith("make ")} == set(re.findall(r"make \w+", text))


@pytest.mark.parametrize(
    "path", sorted((ROOT / ".github" / "ISSUE_TEMPLATE").glob("*.yml")), ids=lambda path: path.stem
)
def test_an_issue_form_has_what_github_asks_for(path):
    form = yaml.safe_load(path.read_text())
    assert {"name", "description", "body"} <= set(form)
    for element in form["body"]:
        assert {"id", "type", "attributes"} <= set(element)
        assert element["attributes"]["label"]
