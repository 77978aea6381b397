"""The tests that PettingZoo, Gymnasium and Stable-Baselines3 bring, over every environment, scenario and view."""

import warnings
from functools import partial
from types import SimpleNamespace

import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check
from playing import CROSS, IDS, aec, built, joint, parallel
from stable_baselines3.common.env_checker import check_env as sb3_check

from khop_env.env.rendering import canvas

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


@pytest.fixture
def no_screen(monkeypatch):
    """A window that isn't there, and doesn't wait for its 25 frames a second."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setattr(canvas, "FRAMES_PER_SECOND", 0)


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


@cross
def test_max_cycles(environment, name, observe, uniform):
    made = [partial(make, environment, name, observe=observe, uniform=uniform) for make in (parallel, aec)]
    max_cycles_test(SimpleNamespace(parallel_env=made[0], env=made[1]))


@cross
def test_rendering(environment, name, observe, uniform, no_screen):
    """Both modes, to a window that isn't there."""
    render_test(partial(aec, environment, name, observe=observe, uniform=uniform))


@pytest.mark.filterwarnings(PADDING)
@cross
def test_centralised_view(environment, name, observe, uniform, no_screen):
    """Gymnasium's and SB3's checks, those of render() included."""
    arguments = {"scenario": built(name), "observe": observe, "uniform": uniform, "max_cycles": 3}
    env = joint(IDS[environment], **arguments, render_mode="rgb_array")
    gymnasium_check(env.unwrapped)
    sb3_check(env)
    env.close()
