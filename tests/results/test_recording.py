import numpy as np
import pytest

from agents import make_law
from khop_env.observers import Explicit, FunnelError, Proximal, SolveError
from khop_env.results import estimates_table, record, states_table
from khop_env.scenarios import Scenario, paper


def simulator(scenario: Scenario, **options):
    return scenario.build(law=make_law(scenario.law), **options).reset(3)


@pytest.fixture(scope="module")
def recording():
    return record(simulator(paper()), 1.0, 0.01)


def test_samples_are_the_simulators_own_values(recording):
    sim = simulator(paper())
    for sample, time in enumerate(recording.time):
        if sample:
            sim.step(time - sim.t[0])
        assert sim.t[0] == time
        for recorded, live in (
            (recording.x, sim.x),
            (recording.u, sim.u),
            (recording.states.estimate, sim.estimates),
            (recording.states.error, sim.errors()),
            (recording.states.disagreement, sim.disagreements()),
            (recording.inputs.truth, sim.g),
            (recording.inputs.estimate, sim.input_estimates),
            (recording.inputs.error, sim.input_errors()),
            (recording.inputs.disagreement, sim.input_disagreements()),
        ):
            assert np.array_equal(recorded[sample], live[0])
    assert vars_equal(recording.extremes, sim.extremes)


def vars_equal(first, second) -> bool:
    return all(np.array_equal(a, b) for a, b in zip(first, second, strict=True))


@pytest.mark.parametrize(
    ("duration", "dt", "steps", "times"),
    [
        (0.05, 0.01, 5, [0.0, 0.01, 0.02, 0.03, 0.04, 0.05]),
        (0.05, 0.02, 3, [0.0, 0.02, 0.04, 0.05]),  # the last step is shortened
        (0.05, 1.0, 1, [0.0, 0.05]),
        (0.03, 0.001, 30, [0.0, 0.01, 0.02, 0.03]),  # at most a hundred samples a second
        (0.025, 0.001, 25, [0.0, 0.01, 0.02, 0.025]),  # and the end
    ],
)
def test_grid(duration, dt, steps, times):
    recording = record(simulator(paper()), duration, dt)
    assert recording.steps == steps
    assert recording.time.tolist() == times
    assert recording.completed


@pytest.mark.parametrize("dt", [0.003, 0.007, 0.01, 0.0333])
def test_never_more_than_a_hundred_samples_a_second(dt):
    recording = record(simulator(paper()), 2.0, dt)
    assert np.diff(recording.time)[:-1].min() >= 0.01 - 1e-12
    assert recording.time[-1] == 2.0
    assert len(recording.time) <= 2 + 2.0 * 100


def test_times_do_not_drift():
    recording = record(simulator(paper()), 20.0, 0.01)
    assert recording.time.tolist() == [round(0.01 * k, 12) for k in range(2001)]


def test_a_large_fleet_is_sampled_less_often(monkeypatch):
    monkeypatch.setattr("khop_env.results.recording.MOST_ROWS", 52 * 20)
    recording = record(simulator(paper()), 1.0, 0.01)
    assert 10 < len(recording.time) <= 21
    assert recording.time[-1] == 1.0


def test_extremes_cover_steps_between_samples():
    fine, coarse = (record(simulator(paper()), 1.0, 0.01, samples_per_second=rate).extremes for rate in (100.0, 2.0))
    assert vars_equal(fine, coarse)


def test_the_guarantee_in_the_samples(recording):
    for kind in (recording.states, recording.inputs):
        assert np.all(np.abs(kind.disagreement) < kind.rho)
        assert np.all(np.abs(kind.error) < kind.delta)


def test_progress_is_told_and_ends_at_one():
    fractions: list[float] = []
    record(simulator(paper()), 0.1, 0.01, progress=fractions.append)
    assert fractions[-1] == 1.0
    assert fractions == sorted(fractions)


def test_leaving_the_funnel_loses_nothing():
    recording = record(simulator(paper(), observers=Explicit()), 10.0, 1e-3)
    assert isinstance(recording.error, FunnelError)
    assert not recording.completed
    assert 0.0 < recording.time[-1] < 10.0
    assert recording.time[-1] == pytest.approx(recording.steps * 1e-3)  # the last state inside, not the last sample
    assert np.all(np.abs(recording.states.disagreement) < recording.states.rho)
    assert estimates_table(recording)["time"].max() == recording.time[-1]


def test_a_failed_solve_loses_nothing_before_it():
    scenario = paper()
    law = make_law(scenario.law)

    def breaks_down(t, view):
        return law(t, view) * (1.0 if t[0] < 0.3 else np.nan)

    recording = record(scenario.build(law=breaks_down, observers=Proximal(2)).reset(0), 1.0, 0.01)
    assert isinstance(recording.error, SolveError)
    assert 0.28 < recording.time[-1] <= 0.3
    assert np.isfinite(recording.states.estimate).all()
    assert not states_table(recording)["x"].is_nan().any()


@pytest.mark.parametrize(
    "changes", [{"duration": 0.0}, {"duration": np.inf}, {"dt": -1.0}, {"samples_per_second": 0.0}]
)
def test_refusals(changes):
    (name,) = changes
    with pytest.raises(ValueError, match=f"{name} must be positive and finite"):
        record(simulator(paper()), **({"duration": 1.0, "dt": 0.01} | changes))


def test_more_than_one_environment_is_refused():
    with pytest.raises(ValueError, match="num_envs=2"):
        record(simulator(paper(), num_envs=2), 1.0, 0.01)
