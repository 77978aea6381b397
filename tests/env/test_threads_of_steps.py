"""Threads share the environments of a batch: the same bits with any number of them, in every part of a step."""

import os
import re
from dataclasses import dataclass

import numpy as np
import pytest

from khop_env import threads as module
from khop_env.env import Hold, Lag, Settings, SlewLimit
from khop_env.env.settings import FEWEST
from khop_env.physics.velocity import VELOCITY_CONTROLLERS
from khop_env.tasks import base
from khop_env.threads import Threads, processors
from tests.env.playing import batched, same

CASES = {
    "consensus_v0": ("paper", {"reward": "team", "success_radius": 2.0, "limit": 1.0}),
    "formation_v0": ("mixed_fleet", {"network": "wifi", "bounds": True, "actuator": "lag", "dt": 0.025}),
    "leader_following_v0": ("mixed_fleet", {"uniform": False, "bounds": True}),
    "navigation_v0": ("corridor", {"end_at_collision": True, "dt": 0.025, "message_size": 1}),
}
SIZES = (1, 5, 64, 200)


def play(environment, name, copies, **arguments):
    """All that a batch returns in some steps, in which environments end and begin again."""
    env = batched(environment, name, num_envs=copies, max_cycles=3, **arguments)
    rng = np.random.default_rng(0)
    seen = [env.reset(seed=4)]
    for _ in range(5):
        seen.append(env.step(rng.uniform(-1.2, 1.2, (copies, env.action_offset[-1]))))
        if env.over.any():
            seen.append(env.reset(env_ids=np.flatnonzero(env.over)))
    return [*seen, env.observations(), env.state(), env.world.inputs.copy()]


@pytest.mark.parametrize("copies", SIZES)
@pytest.mark.parametrize("environment", CASES)
def test_results_do_not_depend_on_threads(environment, copies, monkeypatch):
    """1, 2 and 3 of them, which share every part from two environments on."""
    name, arguments = CASES[environment]
    expected = play(environment, name, copies, **arguments)
    monkeypatch.setattr(module, "WORTH_A_START", 1)
    parts, each = [], base.World.each

    def counted(world, function, numbers):
        ranges = []
        each(world, lambda low, high: (ranges.append((low, high)), function(low, high)), numbers)
        parts.append(len(ranges))

    monkeypatch.setattr(base.World, "each", counted)
    for threads in (2, 3):
        parts.clear()
        assert same(play(environment, name, copies, threads=threads, **arguments), expected)
        assert set(parts) == {min(copies, threads)}


def test_small_batches_are_left_to_one_thread(monkeypatch):
    """Where a thread would cost more than it brings."""
    env = batched("consensus_v0", num_envs=4, threads=2)
    monkeypatch.setattr(Threads, "run", None)
    seen = []
    env.world.each(lambda low, high: seen.append((low, high)), 100)
    assert seen == [(0, 4)]


def test_as_many_threads_as_processors():
    """threads="auto": at most one for 64 environments, and at least one."""
    most = processors()
    assert most == len(os.sched_getaffinity(0)) if hasattr(os, "sched_getaffinity") else most >= 1
    settings = Settings(threads="auto")
    assert [settings.threads_for(size) for size in (1, 2 * FEWEST - 1, FEWEST * most, 10**6)] == [1, 1, most, most]
    assert Settings(threads=3).threads_for(1) == 3
    env = batched("consensus_v0", num_envs=FEWEST * most, threads="auto")
    assert env.world.threads.count == env.simulator.observers.threads == most


@pytest.mark.parametrize("threads", ["all", "2", 0, 2.5, True, None])
def test_other_threads_are_refused(threads):
    message = f"threads must be a positive integer or 'auto'; got {threads!r}"
    with pytest.raises(ValueError, match=f"^{re.escape(message)}$"):
        Settings(threads=threads)


@dataclass(frozen=True)
class OwnLag(Lag):
    """Python's arithmetic instead of the compiled loop's; likewise the others."""


@dataclass(frozen=True)
class OwnSlewLimit(SlewLimit):
    """See above."""


@dataclass(frozen=True)
class OwnHold(Hold):
    """See above."""


@pytest.mark.parametrize(
    ("actuator", "own"), [(Lag(0.13), OwnLag(0.13)), (SlewLimit(7.0), OwnSlewLimit(7.0)), (Hold(), OwnHold())]
)
def test_compiled_actuators_have_the_bits_of_their_formula(actuator, own):
    found, expected = (play("leader_following_v0", "convoy", 3, actuator=each, dt=0.0125) for each in (actuator, own))
    assert same(found, expected)


def test_compiled_leaders_have_the_bits_of_the_controllers(monkeypatch):
    """`convoy`'s leaders command velocities, in the compiled loop unless the controller isn't the library's own."""
    expected = play("leader_following_v0", "convoy", 3)
    monkeypatch.setitem(VELOCITY_CONTROLLERS, "drifter", lambda model, x, velocity: velocity)
    env = batched("leader_following_v0", "convoy")
    assert len(env.task._others) == len(env.task.leader_indices)
    assert same(play("leader_following_v0", "convoy", 3), expected)
