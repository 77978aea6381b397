"""Files that guides show are what they say."""

import re
from pathlib import Path

import pytest

from khop_env import make, scenario

GUIDES = Path(__file__).parents[2] / "docs" / "guides"


@pytest.mark.parametrize("environment", ["consensus_v0", "navigation_v0"])
def test_the_scenario_file_of_the_guide_is_one(environment, tmp_path):
    """It has every table that a file may have, but [theta] and [delta] for all agents alike."""
    page = (GUIDES / "scenario.md").read_text(encoding="utf-8")
    (text,) = re.findall(r"^```toml\n(name = .*?)^```", page, re.MULTILINE | re.DOTALL)
    (tmp_path / "depot.toml").write_text(text, encoding="utf-8")
    depot = scenario(tmp_path / "depot.toml")
    assert not depot.warnings
    assert depot.network is not None
    assert depot.schedule is not None
    env = make(environment, depot)
    env.reset(seed=0)
    env.step({agent: [0.5, 0.5] for agent in env.agents})
