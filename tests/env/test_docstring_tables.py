"""The table of spaces at the top of each environment's module is that of its default environment."""

import importlib
import re

import pettingzoo
import pytest

from tests.env.playing import ENVIRONMENTS, IDS


@pytest.mark.parametrize("environment", ENVIRONMENTS)
def test_the_table_is_true(environment):
    module = importlib.import_module(f"khop_env.{environment}")
    env = module.parallel_env()
    rows = re.findall(r"^\| (\w[\w ]*\w) +\| (.*?) +\|$", module.__doc__, re.MULTILINE)
    table = {name: text for name, text in rows if name != "Agents"}
    agents = [text for name, text in rows if name == "Agents"]
    observations, actions = env.observation_spaces.values(), env.action_spaces.values()
    assert table["Creation"] == f'`make("aec", "{IDS[environment]}")`'
    assert not hasattr(pettingzoo, "register") or IDS[environment] in pettingzoo.aec_registry
    named = re.findall(r"'(\w+)'", agents[0])
    assert named == [agent for agent in env.possible_agents if agent in named]  # in their order
    assert named[0] == env.possible_agents[0]
    assert agents[1] == str(len(env.possible_agents))
    for name, spaces in (("Observation", observations), ("Action", actions), ("State", [env.state_space])):
        (shape,) = {space.shape for space in spaces}
        low, high = min(space.low.min() for space in spaces), max(space.high.max() for space in spaces)
        assert table[f"{name} Shape"].partition(";")[0] == str(shape)
        assert table[f"{name} Values"].partition(";")[0] == f"[{low:g}, {high:g}]"
