"""The set-ISS inequality with the analytical gain, and Theorem 4 measured."""

import math

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents import ComparisonGain, LinearConsensus, TanhConsensus, analytical_gain, injected_errors, swept_bounds
from agents.set_iss import PerturbedLaw, slope, with_final_bounds
from khop_env.observers import Exponential
from khop_env.physics import SingleIntegrator
from khop_env.results import consensus_error
from khop_env.scenarios import LawChoice, mixed_fleet, paper, random_geometric


def estimated_edges(scenario):
    edges = sorted([*scenario.task.edges, *((j, i) for i, j in scenario.task.edges)])
    return np.array([not scenario.communication.has_edge(i, j) for i, j in edges])


@settings(max_examples=15)
@given(
    law=st.sampled_from([TanhConsensus(2.0), TanhConsensus(1.5), LinearConsensus(2.0)]),
    size=st.floats(0.0, 0.3),
    radius=st.floats(0.01, 0.15),
    seed=st.integers(0, 1000),
    drifting=st.booleans(),
)
def test_set_iss_inequality_along_runs(law, size, radius, seed, drifting):
    """|e(t)| stays below the solution of the comparison equation, for all errors of that norm."""
    scenario = paper().replace(disturbance=None, radius=radius, duration=2.0)
    if not drifting:
        scenario = scenario.replace(models=(SingleIntegrator(input_limit=20.0),) * 8)
    gain = law.set_iss_gain(scenario)
    assert gain is not None
    batch = 6
    seen = PerturbedLaw(law, size, estimated_edges(scenario), np.random.default_rng(seed), batch, 2)
    simulator = scenario.build(law=seen, observe="oracle", num_envs=batch)
    simulator.reset(seed)
    limit = consensus_error(simulator.fleet, simulator.x)
    inside = limit <= gain.region(size)
    for _ in range(200):
        simulator.step(0.01)
        limit = gain.step(limit, np.full(batch, size), 0.01)
        assert np.all(consensus_error(simulator.fleet, simulator.x)[inside] <= limit[inside] * (1.0 + 1e-6) + 1e-9)
    finite = limit[np.isfinite(limit)]
    if finite.size and math.isfinite(gain.ultimate(size)):
        assert np.all(finite <= max(gain.ultimate(size) * 1.01 + 1e-6, radius * 10))


@given(
    coupling=st.floats(0.2, 50.0),
    share=st.floats(0.0, 1.2),
    weight=st.floats(0.1, 20.0),
    error=st.floats(0.0, 5.0),
    bounded=st.booleans(),
)
def test_ultimate_distance_solves_its_equation(coupling, share, weight, error, bounded):
    gain = ComparisonGain(coupling, share * coupling, weight, bounded, most_pull=2.0 * coupling, limit=100.0)
    ultimate = gain.ultimate(error)
    if math.isfinite(ultimate):
        assert gain.decrease(ultimate) == pytest.approx(weight * error, rel=1e-6, abs=1e-9)
        assert ultimate <= gain.region(error) * (1.0 + 1e-9)
        assert gain.ultimate(0.5 * error) <= ultimate  # of class K
    if share >= 1.0:
        assert gain.region() == 0.0
        assert ultimate == math.inf


def test_gain_of_the_paper():
    """k_c lambda_2(L_T), l_f and k_c sqrt(most task edges to non-neighbours), worked out by hand from the graphs."""
    scenario = paper()
    gain = analytical_gain(scenario)
    laplacian = np.zeros((8, 8))
    for i, j in scenario.task.edges:
        laplacian[[i, j], [i, j]] += 1.0
        laplacian[[i, j], [j, i]] -= 1.0
    assert gain.coupling == pytest.approx(2.0 * np.sort(np.linalg.eigvalsh(laplacian))[1])
    assert gain.lipschitz == 1.0
    assert gain.error_weight == pytest.approx(2.0 * math.sqrt(3.0))
    assert gain.ultimate(0.0) == 0.0
    assert gain.ultimate(1.0) == math.inf


@pytest.mark.parametrize(
    "scenario",
    [
        mixed_fleet(),  # other models
        paper().replace(law=LawChoice("tanh", {"gain": 5.0})),  # commands beyond the limits
        paper().replace(law=LawChoice("linear", {"cancel_drift": True})),
        paper().replace(law=LawChoice("formation")),
    ],
)
def test_no_gain_where_there_is_no_argument(scenario):
    assert analytical_gain(scenario) is None


def test_injected_errors_stay_below_the_analytical_gain():
    rows = injected_errors(paper(), sizes=(0.01, 0.05, 0.1), episodes=2)
    assert [row["pattern"] for row in rows[:3]] == ["constant", "swinging", "adversarial"]
    assert all(row["distance"] < row["bound"] and row["holds"] for row in rows)
    adversarial = [row for row in rows if row["pattern"] == "adversarial"]
    assert all(row["distance"] > 0.3 * row["bound"] for row in adversarial)  # the bound isn't idle
    assert slope(adversarial, "error", "distance") == pytest.approx(1.0, abs=0.1)


@pytest.mark.parametrize("scenario", [paper(), random_geometric(agents=12)], ids=["paper", "random_geometric"])
def test_tighter_bounds_bring_the_team_nearer(scenario, capsys):
    """Theorem 4: the excess over the oracle falls with delta(inf), and so does the distance without disturbance."""
    rows = swept_bounds(scenario, factors=(10.0, 1.0, 0.1), episodes=4)
    assert all(row["normalized"] < 1.0 for row in rows)
    assert all(row["holds"] is not False for row in rows)
    for kind in ("as designed", "bare"):
        disturbed = [row for row in rows if row["observers"] == kind and row["disturbed"]]
        found = slope(disturbed, "delta", "excess")
        with capsys.disabled():
            print(f" {scenario.name}, {kind}: excess ~ delta(inf)^{found:.2f}", end="")
        assert found > 1.5
        assert disturbed[-1]["excess"] < 0.01 * disturbed[0]["excess"]
        assert all(row["floor"] > 10.0 * row["excess"] for row in disturbed[1:])
    calm = [row["distance"] for row in rows if row["observers"] == "bare" and not row["disturbed"]]
    assert calm[0] > 3.0 * calm[1] > 3.0 * calm[2] or scenario.name != "paper"
    errors = [row["error"] for row in rows if row["observers"] == "bare" and row["disturbed"]]
    assert errors[0] > 10.0 * errors[1] > 100.0 * errors[2]


def test_final_bounds_alone_change():
    for scenario in (paper(), mixed_fleet()):
        bounds, scaled = (list(each.design.states.bounds) for each in (scenario, with_final_bounds(scenario, 0.1)))
        for before, after in zip(bounds, scaled, strict=True):
            assert isinstance(after, Exponential)
            assert after.final == pytest.approx(0.1 * before.final)
            assert after.initial - after.final == pytest.approx(before.initial - before.final)
            assert after.rate == before.rate
