"""The check of leaks, and that of restored states: each hole is found, also past a network."""

import re
from functools import partial

import numpy as np
import pytest

from khop_env import consensus_v0
from khop_env.env import BatchedEnv
from khop_env.observers import Networked
from khop_env.testing import check_environment
from tests.testing.test_checking import statuses


def observing(part):
    """BatchedEnv._observe with inaccessible information added to every agent's first column."""
    original = BatchedEnv._observe

    def observe(self):
        observations, clipped = original(self)
        observations[..., 0] += 1e-3 * part(self)[:, None].astype(np.float32)
        return observations, clipped

    return observe


@pytest.mark.parametrize(
    ("part", "message"),
    [
        (
            lambda env: env.simulator.x[:, -1],
            r"the true state of 'drifter_7' changes the observation of 'drifter_\d', .*; only drifter.* may see it",
        ),
        (lambda env: env.simulator.estimates[:, 0], r"an estimate that '.*' makes changes the observation of "),
        (lambda env: env.simulator.u[:, 0], r"the simulator's u changes the observation of '.*; nobody may see it"),
    ],
    ids=["state", "estimate", "input"],
)
def test_a_leak_is_found_where_all_views_have_it(part, message, monkeypatch):
    monkeypatch.setattr(BatchedEnv, "_observe", observing(part))
    report = check_environment(partial(consensus_v0.parallel_env, "paper", max_cycles=10), steps=20)
    assert statuses(report, "failed") == ["leak"], str(report)
    assert re.match(message, report["leak"].detail), report["leak"].detail
    assert "entry 0 (own." in report["leak"].detail


LOSSY = partial(consensus_v0.parallel_env, "paper", network="lossy:loss=0.5,burst=3", bounds=True, max_cycles=10)


@pytest.mark.parametrize(
    ("part", "message"),
    [
        (
            lambda env: env.simulator.x[:, 1],
            r"the true state of 'drifter_0' changes the observation of 'drifter_\d', .*; only drifter.* may see it",
        ),
        (lambda env: env.simulator.state.memory["stamp"][0], r"'.*'s stamp changes the observation of '.*"),
        (lambda env: env.simulator.state.memory["channel.sent"][0, 1], r"the simulator's channel.sent changes"),
        (lambda env: env.simulator.state.memory["channel.newest"][0], r"the simulator's channel.newest changes"),
    ],
    ids=["state", "stamp", "message", "link"],
)
def test_a_leak_past_the_network_is_found(part, message, monkeypatch):
    """Neighbours' states, too, and everything that is on its way."""
    monkeypatch.setattr(BatchedEnv, "_observe", observing(part))
    report = check_environment(LOSSY, steps=20)
    assert statuses(report, "failed") == ["leak"], str(report)
    assert re.match(message, report["leak"].detail), report["leak"].detail


def test_messages_that_are_overheard_are_found(monkeypatch):
    """Estimates of what hasn't arrived, which at any one instant are like all others."""
    original = Networked.advance

    def advance(self, plant, before, state, dt):
        original(self, plant, before, state, dt)
        state.memory["estimate"] += 0.1 * (state.x[self.layout.column_source] - state.memory["estimate"])

    monkeypatch.setattr(Networked, "advance", advance)
    report = check_environment(LOSSY, steps=20)
    assert statuses(report, "failed") == ["leak"], str(report)
    said = r"the true state of 'drifter_0' changes the next observation of '.*', although no message of it has arrived"
    assert re.match(said, report["leak"].detail), report["leak"].detail


def test_states_that_are_not_restored_as_a_whole_are_found(monkeypatch):
    """Here a link forgets that it was in a burst of losses."""
    original = BatchedEnv.set_state

    def set_state(self, state):
        original(self, state)
        self.simulator.state.memory["channel.bad"][...] = False

    monkeypatch.setattr(BatchedEnv, "set_state", set_state)
    report = check_environment(LOSSY, steps=20)
    assert "restore" in statuses(report, "failed")
    assert re.match(r"copied after 4 steps, original and copy differ: call \d, step", report["restore"].detail)
