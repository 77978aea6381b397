"""The page on installation agrees with pyproject.toml, and quotes messages as they are."""

import re
import tomllib
from pathlib import Path

import pytest

ROOT = Path(__file__).parents[2]
PAGE = (ROOT / "docs" / "install.md").read_text(encoding="utf-8")
PROJECT = tomllib.loads((ROOT / "pyproject.toml").read_text(encoding="utf-8"))["project"]


def test_every_extra_is_explained():
    table = PAGE.partition("| Extra |")[2].partition("\n\n")[0]
    assert set(re.findall(r"(?m)^\| `(\w+)` \|", table)) == set(PROJECT["optional-dependencies"])


def test_extras_of_commands_exist():
    named = {name for names in re.findall(r"\[([a-z,]+)\]'", PAGE) for name in names.split(",")}
    assert named
    assert named <= set(PROJECT["optional-dependencies"])


def test_the_oldest_python():
    assert PROJECT["requires-python"] == ">=3.11"
    assert set(re.findall(r"Python (3\.\d+) or newer", PAGE)) == {"3.11"}


@pytest.mark.parametrize(
    "message",
    [
        "khop_env needs Python 3.11 or newer",
        "make_sb3_vec needs Stable-Baselines3",
        "rendering needs pygame-ce",
        "there is no display to show frames on",
        "videos in .mp4 need ffmpeg",
        "compiling what is used for the first time on this machine",
        "KHOP_ENV_PLAIN",
        ".kernel",
    ],
)
def test_what_is_quoted_is_said(message):
    assert message in PAGE
    sources = [*(ROOT / "khop_env").rglob("*.py"), ROOT / "Makefile"]
    assert any(message in path.read_text(encoding="utf-8") for path in sources)
