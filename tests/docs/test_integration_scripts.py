"""The table of integrations, the Makefile and the scripts tell of the same things."""

import re
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
MAKEFILE = (ROOT / "Makefile").read_text(encoding="utf-8").replace("\\\n", " ")
PAGE = (ROOT / "docs" / "guides" / "integrations.md").read_text(encoding="utf-8")
ROWS = {
    match[1]: line for line in PAGE.splitlines() if (match := re.match(r"\|.*`make integration-([a-z0-9]+)`", line))
}
SCRIPTS = {
    path.relative_to(ROOT).as_posix()
    for folder in ("integrations", "learning")
    for path in (ROOT / "examples" / folder).glob("*.py")
}


def variable(name: str) -> list[str]:
    """Words of a variable of the Makefile."""
    (value,) = re.findall(rf"^{name} :?= (.*)$", MAKEFILE, re.MULTILINE)
    return value.replace("'", "").split()


NAMES = variable("INTEGRATIONS")


def test_every_target_has_a_row():
    assert set(ROWS) == set(NAMES)


def test_every_script_has_a_target():
    run = {f"examples/{words.split(',')[0]}" for name in NAMES for words in variable(f"runs_{name}")}
    assert run == SCRIPTS


@pytest.mark.parametrize("name", NAMES)
def test_a_row_names_scripts_and_versions(name):
    """Every script that the target runs, and every version that it pins."""
    scripts = {f"examples/{words.split(',')[0]}" for words in variable(f"runs_{name}")}
    assert scripts == set(re.findall(r"\.\./\.\./(examples/\w+/\w+\.py)", ROWS[name]))
    for package, version in re.findall(r"([\w-]+)(?:\[\w+\])?==([\w.]+)", " ".join(variable(f"packages_{name}"))):
        assert f"{package} {version}" in ROWS[name].lower(), f"{package} {version} isn't in the row of {name}"


def test_targets_named_elsewhere_exist():
    for page in [
        *(ROOT / "docs").rglob("*.md"),
        ROOT / "README.md",
        ROOT / "CONTRIBUTING.md",
        *map(ROOT.joinpath, SCRIPTS),
    ]:
        for name in re.findall(r"make integration-([a-z]\w*)", page.read_text(encoding="utf-8")):
            assert name in NAMES, f"{page} names `make integration-{name}`"
