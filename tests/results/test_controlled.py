"""Recordings in steps of controlled size: samples within steps, as accurate as the steps, and inside the funnels."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents import make_law
from khop_env.network import Outage
from khop_env.observers import Proximal, SolveError
from khop_env.registry import scenario
from khop_env.results import estimates_table, record, record_controlled, states_table, summarize
from khop_env.scenarios import paper
from khop_env.terminal import print_summary
from tests.simulation.test_step_control import TOLERANCES, changing_systems
from tests.strategies import SmoothSignals


def simulator(chosen, order=3, **options):
    return chosen.build(law=make_law(chosen.law), observers=Proximal(order), **options).reset(3)


@pytest.fixture(scope="module")
def recording():
    return record_controlled(simulator(paper()), 2.0, 1e-3)


def test_times_are_those_of_a_fixed_step(recording):
    assert recording.time.tolist() == [round(0.01 * k, 12) for k in range(201)]
    assert recording.completed
    assert recording.steps < 150 < len(recording.time)
    assert recording.rejected is not None
    assert record(simulator(paper()), 0.1, 0.01).rejected is None


@pytest.mark.parametrize("order", [2, 3])
@pytest.mark.parametrize("name", ["paper", "mixed_fleet"])
def test_samples_are_as_accurate_as_steps(name, order):
    """Within three times the tolerance of a fine fixed step: states, inputs and all estimates, at every sample."""
    chosen = scenario(name)
    true = record(simulator(chosen), 1.0, 5e-4)
    errors = []
    for tolerance in (1e-2, 1e-3):
        found = record_controlled(simulator(chosen, order), 1.0, tolerance)
        pairs = [(found.x, true.x), (found.states.estimate, true.states.estimate)]
        errors.append(max(np.abs(one - other).max() for one, other in pairs))
        assert errors[-1] < 3.0 * tolerance
        if name == "paper":
            assert np.abs(found.u - true.u).max() < 10.0 * tolerance
    assert errors[1] < 0.3 * errors[0]


def test_a_sample_is_one_state_of_the_closed_loop(recording):
    """Inputs are the law's at its state and estimates, and g is theirs: all of one instant."""
    sim = simulator(paper())
    for sample in range(0, 201, 7):
        state = sim.state
        state.t[...], state.x[:, 0] = recording.time[sample], recording.x[sample]
        state.memory["estimate"][:, 0] = recording.states.estimate[sample]
        sim.plant.actuate(state)
        assert np.array_equal(sim.u[0], recording.u[sample])
        assert np.array_equal(sim.g[0], recording.inputs.truth[sample])
        assert np.array_equal(sim.disagreements()[0], recording.states.disagreement[sample])


def test_the_last_sample_is_the_last_state():
    sim = simulator(paper())
    found = record_controlled(sim, 0.5, 1e-3)
    assert np.array_equal(found.x[-1], sim.x[0])
    assert found.states.estimate[-1] == pytest.approx(sim.estimates[0], abs=1e-14)
    assert found.inputs.estimate[-1] == pytest.approx(sim.input_estimates[0], abs=1e-13)
    assert found.u[-1] == pytest.approx(sim.u[0], abs=1e-12)


@settings(max_examples=40)
@given(system=changing_systems(), tolerance=TOLERANCES, order=st.sampled_from([2, 3]))
def test_every_sample_keeps_the_guarantee(system, tolerance, order):
    """Random systems, graphs that change, any tolerance; steps are much longer than samples are apart."""
    sim = system.simulator(Proximal(order), law=SmoothSignals(system.design.fleet, system.seed))
    found = record_controlled(sim, 0.5, tolerance, samples_per_second=400.0)
    assert found.completed
    for kind in (found.states, found.inputs):
        assert np.all(np.abs(kind.disagreement) < kind.rho)
        assert np.all(np.abs(kind.error) < kind.bound)


def test_a_failure_keeps_earlier_samples():
    """A law that returns nan from 0.305 s on: the samples until then, and the last state before it."""
    chosen, law = paper(), make_law(paper().law)

    def failing(t, view):
        return np.where(t[:, None] < 0.305, law(t, view), np.nan)

    found = record_controlled(chosen.build(law=failing, observers=Proximal(3)).reset(3), 1.0, 1e-2)
    assert isinstance(found.error, SolveError)
    assert found.time[:-1].tolist() == [round(0.01 * k, 12) for k in range(31)]
    assert 0.305 - 1e-6 < found.time[-1] < 0.305
    assert np.isfinite(found.x).all()
    assert np.isfinite(found.u).all()


def test_tables_and_summary(recording, capsys):
    assert states_table(recording)["time"].n_unique() == 201
    assert estimates_table(recording)["time"].n_unique() == 201
    found = summarize(
        recording,
        paper(),
        seed=3,
        dt=None,
        observers=Proximal(3),
        controller="tanh",
        observe="estimate",
        tolerance=1e-3,
    )
    assert (found["dt"], found["tolerance"], found["rejected_steps"]) == (None, 1e-3, recording.rejected)
    assert found["funnel_kept"]
    print_summary(found, {})
    printed = " ".join(capsys.readouterr().out.split())
    assert "2 s in steps of controlled size, tolerance 0.001 (" in printed
    print_summary({**found, "steps": 9, "rejected_steps": 2, "diverged": True}, {})
    printed = " ".join(capsys.readouterr().out.split())
    assert "for 9 steps, and 2 that were taken back" in printed
    assert "try a smaller --tolerance" in printed


def test_changing_links_are_recorded():
    """During an outage, at its ends and after it; a sample at its beginning has the new links."""
    chosen = paper().replace(schedule=Outage(0.3, 0.2, agent=3))
    found = record_controlled(simulator(chosen), 0.8, 1e-2)
    down = ~found.states.up.all(axis=1)
    assert found.time[down].tolist() == [round(0.01 * k, 12) for k in range(30, 50)]


def test_a_large_fleet_is_sampled_less_often(monkeypatch):
    monkeypatch.setattr("khop_env.results.recording.MOST_ROWS", 52 * 20)
    found = record_controlled(simulator(paper()), 1.0, 1e-2)
    assert 10 < len(found.time) <= 21
    assert found.time[-1] == 1.0


@pytest.mark.parametrize(
    ("changes", "expected"),
    [
        ({"duration": 0.0}, "duration must be positive and finite"),
        ({"tolerance": 2.0}, "tolerance must be a number from 1e-09 to 1"),
        ({"samples_per_second": 0.0}, "samples_per_second must be positive and finite"),
    ],
)
def test_bad_arguments_are_refused(changes, expected):
    arguments = {"duration": 1.0, "tolerance": 1e-3} | changes
    with pytest.raises(ValueError, match=expected):
        record_controlled(simulator(paper()), **arguments)


def test_more_steps_than_can_be_taken_are_refused():
    """Of a drift that takes short ones only."""
    stiff = simulator(paper())
    stiff.longest_step = 1e-6
    with pytest.raises(ValueError, match="until = 1000 s is too far away"):
        record_controlled(stiff, 1000.0, 1e-3)


def test_one_environment_only():
    with pytest.raises(ValueError, match="expected a simulator of one environment; got num_envs=2"):
        record_controlled(simulator(paper(), num_envs=2), 1.0, 1e-3)
