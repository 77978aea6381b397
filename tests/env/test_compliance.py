"""The tests that PettingZoo, Gymnasium and Stable-Baselines3 bring, over every environment, scenario and view."""

import warnings
from functools import partial
from types import SimpleNamespace

import pytest
from gymnasium.utils.env_checker import check_env as gymnasium_check
from stable_baselines3.common.env_checker import check_env as sb3_check

from khop_env.env.rendering import canvas
from tests.env.playing import CROSS, IDS, aec, built, joint, parallel, require_contract

with warnings.catch_warnings():  # the import makes example environments in a way that PettingZoo itself deprecates
    warnings.filterwarnings("ignore", "The old environment creation API", DeprecationWarning)
    from pettingzoo.test import max_cycles_test, render_test, state_test

# padding is always zero
PADDING = "ignore:(.*A Box observation space|Agent's) maximum and minimum .*values are equal:UserWarning"


@pytest.fixture
def no_screen(monkeypatch):
    """A window that isn't there, and doesn't wait for its 25 frames a second."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    monkeypatch.setattr(canvas, "FRAMES_PER_SECOND", 0)


cross = pytest.mark.parametrize(("environment", "name", "observe", "uniform"), CROSS)


@cross
def test_pettingzoo(environment, name, observe, uniform):
    """Its tests of both forms, and of seeds."""
    make = partial(parallel, environment, name, observe=observe, uniform=uniform, max_cycles=4)
    require_contract(make, "pettingzoo", "pettingzoo_seeds", steps=6)


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
