"""Tuning finds what a fine grid finds, and what is shipped was found by it."""

import math
import tomllib
from pathlib import Path

import numpy as np
import pytest

import agents
from agents import LAWS, LawPolicy, make_law, play, tune
from khop_env.scenarios import LawChoice
from tests.env.playing import EVERY, batched


def test_the_search_ends_near_the_best_of_a_grid():
    env = batched("consensus_v0", "paper", num_envs=16)
    seeds = range(10_000, 10_016)
    found = tune(env, "tanh", seeds)
    grid = {
        gain: play(env, LawPolicy("tanh", {"gain": gain}), seeds).returns.mean() for gain in np.geomspace(0.5, 32.0, 25)
    }
    assert found.mean_return > 1.02 * max(grid.values())
    assert found.mean_return > found.default_return
    assert math.isclose(found.mean_return, play(env, LawPolicy("tanh", found.parameters), seeds).returns.mean())


def test_every_shipped_parameter_set_makes_a_law():
    table = tomllib.loads((Path(agents.__file__).parent / "tuned.toml").read_text())
    found = {(environment, scenario.partition(":")[0]) for environment, laws in table.items() for scenario in laws}
    assert found == {(environment, scenario.partition(":")[0]) for environment, scenario in EVERY}
    for scenarios in table.values():
        for laws in scenarios.values():
            assert set(laws) == set(LAWS)
            for law, modes in laws.items():
                assert set(modes) == {"estimate", "local"}
                for parameters in modes.values():
                    make_law(LawChoice(law, parameters))


@pytest.mark.parametrize(("environment", "scenario"), EVERY)
def test_shipped_parameters_are_better_than_the_defaults(environment, scenario):
    """On other episodes than those that they were tuned on."""
    env = batched(environment, scenario, num_envs=32)
    for law in ("linear", "leader_following"):
        default = {name: make_law(law).__dict__[name] for name in make_law(law).__dataclass_fields__}
        assert (
            play(env, LawPolicy(law), range(32)).returns.mean()
            > 1.01 * play(env, LawPolicy(law, default), range(32)).returns.mean()
        )
