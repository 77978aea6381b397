import json
from dataclasses import replace

import numpy as np
import pytest

from agents import make_law
from khop_env.observers import Explicit, Extremes, Proximal, TargetObservers
from khop_env.results import consensus_error, record, summarize
from khop_env.scenarios import Scenario, paper

KEYS = {
    "scenario", "controller", "observe", "seed", "dt", "integrator", "order", "duration", "wall_time_s",
    "max_normalized_disagreement", "max_error_to_bound", "max_normalized_disagreement_input",
    "max_error_to_bound_input", "final_consensus_error", "funnel_kept", "versions",
}  # fmt: skip


def summary(scenario: Scenario, dt: float = 0.01, duration: float = 1.0, **options):
    sim = scenario.build(law=make_law(scenario.law), **options).reset(2)
    recording = record(sim, duration, dt)
    return recording, summarize(
        recording, scenario, seed=2, dt=dt, observers=sim.observers, controller="tanh", observe="estimate"
    )


def test_plain_json_with_all_keys():
    recording, found = summary(paper())
    assert found.keys() >= KEYS
    assert json.loads(json.dumps(found, allow_nan=False)) == found
    assert found["funnel_kept"] is True
    assert found["max_normalized_disagreement"] == recording.extremes.normalized[0]
    assert found["max_error_to_bound_input"] == recording.extremes.input_relative[0]
    assert found["wall_time_s"] > 0.0


def test_ratios_are_at_least_those_of_the_samples():
    recording, found = summary(paper())
    sampled = np.max(np.abs(recording.states.disagreement) / recording.states.rho)
    assert found["max_normalized_disagreement"] == pytest.approx(sampled, rel=1e-9)  # every step is sampled here


def test_null_without_input_observers():
    scenario = paper().replace(observers=(TargetObservers(input_observer=False),) * 8, theta=None)
    _, found = summary(scenario)
    assert found["max_normalized_disagreement_input"] is None
    assert found["max_error_to_bound_input"] is None
    assert found["funnel_kept"] is True


def test_a_run_that_stopped_early_kept_nothing():
    _, found = summary(paper(), dt=1e-3, duration=2.0, observers=Explicit())
    assert found["funnel_kept"] is False
    assert "left the funnel" in found["error"]
    assert found["duration"] < 2.0


def test_consensus_error_against_the_projection_matrix():
    fleet = paper().fleet
    x = np.random.default_rng(0).normal(size=(3, fleet.n))
    projection = np.eye(16) - np.kron(np.ones((8, 8)), np.eye(2)) / 8.0
    assert consensus_error(fleet, x) == pytest.approx(np.linalg.norm(x @ projection, axis=1))
    assert consensus_error(fleet, np.tile([1.0, 2.0], 8)) == 0.0


def test_numbers_that_are_not_finite_are_null():
    """`funnel_kept` is False then, whatever the ratios are."""
    recording, _ = summary(paper(), duration=0.1)
    x = recording.x.copy()
    x[-1, 0] = np.nan
    nan = np.full(1, np.nan)
    inside = np.full(1, 0.5)
    for changes, null in (
        ({"x": x}, "final_consensus_error"),
        ({"extremes": Extremes(nan, inside, inside, inside)}, "max_normalized_disagreement"),
        ({"extremes": Extremes(inside, inside, inside, nan)}, "max_error_to_bound_input"),
    ):
        found = summarize(
            replace(recording, **changes),
            paper(),
            seed=2,
            dt=0.01,
            observers=Proximal(),
            controller="tanh",
            observe="estimate",
        )
        assert found[null] is None
        assert found["funnel_kept"] is False
        assert found["diverged"] is ("x" in changes)
        json.dumps(found, allow_nan=False)


def test_states_that_ran_away_are_told():
    recording, found = summary(paper(), duration=0.1)
    assert found["diverged"] is False
    for size, expected in ((1e5, False), (1e7, True), (1e300, True)):
        far = replace(recording, x=recording.x * np.linspace(1.0, size, len(recording.x))[:, None])
        again = summarize(far, paper(), seed=2, dt=0.01, observers=Proximal(), controller="tanh", observe="estimate")
        assert again["diverged"] is expected
