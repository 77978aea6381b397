"""The tests that PettingZoo, Gymnasium and Stable-Baselines3 bring, over every environment, scenario and view."""

import warnings
from functools import partial
from types import SimpleNamespace

import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check
from playing import CROSS, EVERY, IDS, aec, joint, parallel
from stable_baselines3.common.env_checker import check_env as sb3_check

with warnings.catch_warnings():  # the import makes example environments in a way that PettingZoo itself deprecates
    warnings.filterwarnings("ignore", "The old environment creation API", DeprecationWarning)
    from pettingzoo.test import (
        api_test,
        max_cycles_test,
        parallel_api_test,
        parallel_seed_test,
        render_test,
        seed_test,
        state_test,
    )

FOREIGN_OPTION = "ignore:reset\\(\\) ignores the option 'options':UserWarning"  # PettingZoo's tests give one
RAGGED = "ignore:(Agents have different observation space sizes|Observations are different shapes):UserWarning"
# padding is always zero
PADDING = "ignore:(.*A Box observation space|Agent's) maximum and minimum .*values are equal:UserWarning"

cross = pytest.mark.parametrize(("environment", "name", "observe", "uniform"), CROSS)


@pytest.mark.filterwarnings(FOREIGN_OPTION)
@cross
def test_parallel_api(environment, name, observe, uniform):
    parallel_api_test(parallel(environment, name, observe=observe, uniform=uniform, max_cycles=4), num_cycles=6)


@pytest.mark.filterwarnings(FOREIGN_OPTION, RAGGED, PADDING)
@cross
def test_aec_api(environment, name, observe, uniform):
    api_test(aec(environment, name, observe=observe, uniform=uniform, max_cycles=4), num_cycles=6)


@cross
def test_seeds(environment, name, observe, uniform):
    arguments = {"observe": observe, "uniform": uniform, "max_cycles": 20}
    parallel_seed_test(partial(parallel, environment, name, **arguments), num_cycles=3)
    seed_test(partial(aec, environment, name, **arguments), num_cycles=3)


@cross
def test_state(environment, name, observe, uniform):
    arguments = {"observe": observe, "uniform": uniform}
    state_test(aec(environment, name, **arguments), parallel(environment, name, **arguments), num_cycles=3)


@pytest.mark.parametrize(("environment", "name"), EVERY)
def test_max_cycles(environment, name):
    max_cycles_test(
        SimpleNamespace(parallel_env=partial(parallel, environment, name), env=partial(aec, environment, name))
    )


@pytest.mark.filterwarnings(PADDING)
@pytest.mark.parametrize("uniform", [True, False])
@pytest.mark.parametrize(("environment", "name"), EVERY)
def test_centralised_view(environment, name, uniform):
    env = joint(IDS[environment], scenario=name, uniform=uniform, max_cycles=5)
    gymnasium_check(env.unwrapped, skip_render_check=True)
    sb3_check(env, skip_render_check=True)


@pytest.mark.parametrize(("environment", "name"), EVERY)
def test_rendering(environment, name, monkeypatch):
    """Both modes, to a window that isn't there."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    render_test(partial(aec, environment, name))


@pytest.mark.parametrize("environment", IDS)
def test_centralised_view_with_frames(environment, monkeypatch):
    """Gymnasium's and SB3's checks of render(), too."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env = joint(IDS[environment], scenario="convoy", max_cycles=3, render_mode="rgb_array")
    gymnasium_check(env.unwrapped)
    sb3_check(env)
    env.close()
