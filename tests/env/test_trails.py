"""Frames of environments: trails are those of the running episode, all of it; and no step fails by drawing."""

import contextlib
import copy
import sys

import numpy as np
import pytest

from khop_env.env import KHopEnv
from khop_env.env.rendering import canvas
from khop_env.registry import make_joint
from tests.env.playing import built, parallel, play, same

FRAMES = {"render_mode": "rgb_array", "max_cycles": 20}


def team(environment="consensus_v0"):
    return parallel(environment, **FRAMES)


def one_agent():
    return make_joint("consensus_v0", scenario=built("paper"), **FRAMES)


def to_the_end(env, seed):
    """An episode whose only frame is the last."""
    env.reset(seed=seed)
    if isinstance(env, KHopEnv):
        play(env, 20)
    else:
        for action in np.random.default_rng(0).uniform(-1.0, 1.0, (20, *env.action_space.shape)):
            env.step(action)
    return env.render()


@pytest.mark.parametrize("make", [team, one_agent])
def test_episodes_are_not_joined(make):
    """Both last frames are of the same time; the second is that of an environment which never saw the first."""
    env = make()
    first, second = to_the_end(env, 1), to_the_end(env, 2)
    assert np.array_equal(second, to_the_end(make(), 2))
    assert not np.array_equal(first, second)


@pytest.mark.parametrize("later", [True, False])
def test_a_restored_state_begins_new_trails(later):
    """Of an earlier time or a later one, in the middle of an episode or after its end."""
    other = team()
    other.reset(seed=2)
    play(other, 20 if later else 1)
    env, fresh = team(), team()
    env.reset(seed=1)
    play(env, 5)
    env.render()
    for one in (env, fresh):
        one.set_state(other.get_state())
    assert np.array_equal(env.render(), fresh.render())


def test_seldom_rendered_paths_are_whole():
    """The path is drawn through where the agents were at each step, not from frame to frame."""
    often, seldom, view = team(), team(), one_agent()
    for env in (often, seldom):
        env.reset(seed=1)
    view.reset(seed=1)
    for _ in range(15):
        actions = {agent: np.full(2, 0.5, np.float32) for agent in often.agents}
        often.step(actions)
        often.render()
        seldom.step(actions)
        view.step(np.full(16, 0.5))
    frames = seldom.render(), view.render()
    assert np.array_equal(*frames)
    trails = [env._renderer._trails.points for env in (often, seldom)]
    assert [len(trail) for trail in trails] == [16, 16]
    for (t, positions), (other_t, other_positions) in zip(*trails, strict=True):
        assert t == other_t
        assert np.array_equal(positions, other_positions)


def test_a_copy_goes_on_with_the_same_frames():
    env = team("formation_v0")
    env.reset(seed=1)
    play(env, 3)
    env.render()
    twin = copy.deepcopy(env)
    for one in (env, twin):
        play(one, 3)
    assert np.array_equal(env.render(), twin.render())


@pytest.mark.parametrize("mode", ["rgb_array", "human"])
def test_without_pygame_only_rendering_fails(monkeypatch, mode):
    """Libraries ask for a render mode that nobody needs (Stable-Baselines3's make_vec_env); steps are those without."""
    canvas.load_pygame.cache_clear()
    monkeypatch.setitem(sys.modules, "pygame", None)
    env, plain = parallel("consensus_v0", render_mode=mode), parallel("consensus_v0")
    missing = pytest.warns(RuntimeWarning, match=r"the window isn't drawn: rendering needs pygame-ce: in a clone")
    with missing if mode == "human" else contextlib.nullcontext():
        assert same(env.reset(seed=0), plain.reset(seed=0))
        assert same(play(env, 2), play(plain, 2))
    with pytest.raises(ModuleNotFoundError, match=r"pip install -c constraints.txt -e '\.\[render\]'"):
        env.render()
    env.close()


def test_a_failed_drawing_fails_no_step(monkeypatch):
    """The results of the step arrive, the environment goes on, and so does its window when drawing works again."""
    monkeypatch.setenv("SDL_VIDEODRIVER", "dummy")
    env, plain = parallel("consensus_v0", render_mode="human"), parallel("consensus_v0")
    assert same(env.reset(seed=0), plain.reset(seed=0))
    window = env._renderer._window
    with monkeypatch.context() as broken:
        broken.setattr(window, "show", lambda picture: window.nothing)
        with pytest.warns(RuntimeWarning, match="the window isn't drawn: 'Window' object has no attribute 'nothing'"):
            assert same(play(env, 2), play(plain, 2))
        with pytest.raises(AttributeError, match="nothing"):
            env.render()
    assert same(play(env, 2), play(plain, 2))
    env.close()


@pytest.mark.parametrize(("period", "rate"), [(0.05, 20.0), (0.3, 1.0 / 0.3), (2.0, 0.5), (10.0, 0.1)])
def test_the_frame_rate_is_that_of_actions(period, rate):
    """Positive for slow control, too, and not rounded; the same in the centralised view."""
    env = parallel("consensus_v0", control_period=period, render_mode="rgb_array")
    assert env.metadata["render_fps"] == rate
    assert make_joint("consensus_v0", scenario=built("paper"), control_period=period).metadata["render_fps"] == rate
