"""Files that guides show are what they say."""

import itertools
import re
from dataclasses import fields
from pathlib import Path

import numpy as np
import pytest

from khop_env import make, scenario
from khop_env.physics import MODELS

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


def row_of(model):
    """The line about an agent model in the table of the scenario guide."""

    def named(units):
        groups = [(unit, list(names)) for unit, names in itertools.groupby(units, units.get)]
        return ", ".join(f"{', '.join(f'`{name}`' for name in names)} in {unit}" for unit, names in groups)

    values = {each.name: getattr(model, each.name) for each in fields(model) if each.init}
    listed = {name: np.asarray(value).tolist() for name, value in values.items()}
    if len(set(listed["input_limit"])) == 1:
        listed["input_limit"] = listed["input_limit"][0]
    defaults = ", ".join(f"`{name} = {value}`" for name, value in listed.items())
    return f"| `{model.type}` | {named(model.states)} | {named(model.inputs)} | {defaults} |"


def test_the_models_of_scenario_files_are_what_the_guide_says():
    page = (GUIDES / "scenario.md").read_text(encoding="utf-8")
    for model in MODELS.values():
        assert row_of(model()) in page
