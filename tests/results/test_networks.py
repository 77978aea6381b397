"""Estimators over networks, measured."""

import dataclasses

import networkx as nx
import numpy as np
import pytest

from agents import make_law
from khop_env.network import Network
from khop_env.observers import Exponential, Message, Networked
from khop_env.physics import SingleIntegrator
from khop_env.results import measure_networks, network_figure
from khop_env.results.curves import _largest_error
from khop_env.results.metrics import violations
from khop_env.results.network_report import expected_age, network_report
from khop_env.results.networks import SWEPT_LOSSES, SWEPT_PERIODS, sweeps
from khop_env.scenarios import Scenario, paper


def measured(networks, *arguments, scenario=None, **options):
    scenario = scenario or paper()
    rows = measure_networks(
        scenario, make_law(scenario.law), networks, *arguments, **{"episodes": 3, "duration": 1.0, **options}
    )
    return list(rows)


def line(agents: int = 5, **changes) -> Scenario:
    """Integrators on a line: one path from each to each."""
    return Scenario(
        name="line",
        description="a line",
        models=(SingleIntegrator(),) * agents,
        communication=nx.path_graph(agents),
        task=nx.path_graph(agents),
        k=max(2, agents - 1),
        delta=Exponential(5.0, 0.5, 1.0),
        theta=Exponential(5.0, 1.0, 1.0),
        radius=0.1,
        **changes,
    ).sized()


def test_a_row_is_what_a_simulator_says():
    """Every number again, by hand, from a simulation of the same episodes."""
    (row,) = measured(["wifi:period=0.1,loss=0.3"], ["ppso"], seed=4)
    scenario, network = paper(), Network.of("wifi:period=0.1,loss=0.3")
    simulator = scenario.build(law=make_law(scenario.law), observers=Networked(network, "ppso"), num_envs=3).reset(4)
    layout, fleet = simulator.observers.layout, simulator.fleet
    where = [c for c in range(layout.size) if layout.column_source[c] in fleet.position_index]
    errors, bounds, ratios = [], [], []
    for step in range(1, 101):
        simulator.step(0.01)
        error, bound = np.abs(simulator.errors()).T, simulator.error_bounds().bound
        if step > 25:
            errors.append(error[where])
            bounds.append(bound[where])
            if step % 11 == 0:
                limit = simulator.observers.limits(simulator.state, np.zeros_like(bound))
                ratios.append((bound[where].sum(), limit[where].sum()))
    assert row.mean_error == pytest.approx(np.mean(errors))
    assert row.max_error == pytest.approx(np.max(errors))
    assert row.mean_bound == pytest.approx(np.mean(bounds))
    assert row.bound_to_limit == pytest.approx(np.divide(*np.sum(ratios, axis=0)))
    assert row.violations == 0
    assert row.pair_steps == layout.pairs * 3 * 100
    assert (row.network, row.estimator, row.period, row.loss) == ("wifi:period=0.1,loss=0.3", "ppso", 0.1, 0.3)
    assert row.messages_per_s == pytest.approx(10.0)
    sizes = [Message.size(scenario.design, agent, "ppso", "float32") for agent in range(8)]
    assert row.bytes_per_message == max(sizes) > min(sizes)


def test_rows_are_in_order_of_network_estimator_and_period():
    rows = measured(["ideal", "espnow"], ["relay", "ppso"], [0.05, 0.1], duration=0.2)
    assert [(row.network, row.estimator, row.period) for row in rows] == [
        (network, estimator, period)
        for network in ("ideal", "espnow")
        for estimator in ("relay", "ppso")
        for period in (0.05, 0.1)
    ]


def test_periods_are_divided_at_least_by_four_so_that_errors_between_messages_count():
    """Neighbours' estimates are exact at rounds of an ideal network only."""
    (row,) = measured([Network(period=0.01)], ["relay"], scenario=line(2), duration=0.5)
    assert row.pair_steps == 2 * 3 * 200
    assert row.mean_error > 0.0
    assert row.network == "a message every 10 ms, none lost"


def test_relayed_states_are_within_half_again_the_information_limit_on_every_profile():
    profiles = ["ideal", "urllc", "factory", "wifi", "lossy", "saturation", "espnow", "crazyradio"]
    for row in measured(profiles, ["relay"], duration=4.0):
        assert 1.0 <= row.bound_to_limit <= 1.5, row.network
        assert row.violations == 0


def test_continuous_exchange_is_a_row_without_messages():
    """Errors of neighbours count as 0 there, so that means are over the same pairs."""
    (row,) = measured([None])
    scenario = paper()
    simulator = scenario.build(law=make_law(scenario.law), num_envs=3).reset(0)
    errors = []
    for step in range(1, 101):
        simulator.step(0.01)
        if step > 25:
            errors.append(np.abs(simulator.errors()).sum())
    assert row.mean_error == pytest.approx(sum(errors) / (75 * 3 * scenario.design.knowledge.size))
    assert (row.network, row.period, row.messages_per_s, row.bound_to_limit) == ("continuous", None, None, None)
    assert row.mean_error < measured(["ideal"], ["relay"])[0].mean_error


def test_oracle_gives_all_rows_the_same_motion():
    """Twice the noise of what is sent, the same bits of the true states: the rows differ in estimates only."""
    shares = [measured([f"ideal:noise={noise}"], ["relay"], observe="oracle")[0] for noise in (0.1, 0.2)]
    assert shares[0].mean_error < shares[1].mean_error < 2.0 * shares[0].mean_error


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ((["wify"],), "no network 'wify'; did you mean 'wifi'"),
        ((["wifi"], ["rely"]), "no estimator 'rely'; did you mean 'relay'"),
        ((["wifi"], ["relay"], [0.0]), "period must be positive"),
        ((["ideal"], ["relay"], [1e-8]), "steps"),
    ],
)
def test_mistakes_are_refused_before_anything_is_measured(arguments, message):
    with pytest.raises(ValueError, match=message):
        measure_networks(paper(), make_law("tanh"), *arguments)


def test_who_knows_of_nobody_is_told():
    alone = line(1)
    with pytest.raises(ValueError, match="nothing is estimated"):
        measure_networks(alone, make_law("tanh"), ["wifi"])


def test_violations_are_counted_per_pair_and_environment():
    layout = paper().design.knowledge
    bound, x = np.ones((layout.size, 2)), np.zeros((paper().fleet.n, 2))
    error = np.zeros((layout.size, 2))
    assert violations(error, bound, x, layout) == 0
    error[:2, 0] = 1.1  # both components of the first pair
    assert violations(error, bound, x, layout) == 1
    error[2, 1] = np.nan
    assert violations(error, bound, x, layout) == 2
    assert violations(np.full_like(error, 1.0 + 1e-12), bound, x, layout) == 0  # rounding
    assert violations(error, np.full_like(bound, np.inf), x, layout) == 1  # not certified; nan is wrong anyway


def test_the_figure_shows_both_estimators_at_all_periods_and_losses(tmp_path):
    by_period, by_loss = sweeps(Network())
    assert [network.period for network in by_period] == list(SWEPT_PERIODS)
    assert [network.loss for network in by_loss] == list(SWEPT_LOSSES)
    assert [network.loss for network in sweeps(Network(burst=2.0))[1]] == [0.01, 0.03, 0.1, 0.3, 0.6]
    assert [network.loss for network in sweeps(Network(burst=(1.0, 9.0)))[1]] == [0.01, 0.03, 0.1, 0.3]
    row = measured(["ideal"], ["relay"], duration=0.2)[0]
    rows = [dataclasses.replace(row, period=period) for period in SWEPT_PERIODS]
    rows += [dataclasses.replace(row, estimator="ppso", mean_bound=None, bound_to_limit=None) for row in rows]
    losses = [dataclasses.replace(row, loss=loss) for loss in SWEPT_LOSSES]
    path = network_figure(rows, losses, row, tmp_path / "network.png", "a title")
    assert path.stat().st_size > 20_000


def test_a_largest_error_above_the_mean_bound_is_no_violation():
    (row,) = measured(["wifi"], ["relay"], duration=0.2)
    uncertified = dataclasses.replace(row, mean_bound=None)
    assert "no error is\nabove its own bound" in _largest_error([row, uncertified])
    assert _largest_error([uncertified]) == "largest error"
    wrong = _largest_error([row, dataclasses.replace(row, violations=3)])
    assert "(3 errors\nare above their own bounds)" in wrong


class TestReport:
    @pytest.mark.parametrize(
        "text",
        [
            *("ideal", "wifi", "ideal:loss=0.5", "espnow", "ideal:loss=0.3,burst=5"),
            *("ideal:loss=0..0.8", "ideal:loss=0.1..0.5,burst=2..6,latency=0.02..0.12"),
        ],
    )
    def test_the_expected_age_is_the_mean_age_over_a_path(self, text):
        """Agents on a line hear of each other over one path."""
        scenario, network = line(), Network.of(text)
        episodes = 400 if network.ranges else 100
        simulator = scenario.build(observers=Networked(network, "relay"), num_envs=episodes).reset(0)
        for _ in range(300):
            simulator.step(0.01)
        ages = np.zeros(scenario.design.knowledge.pairs)
        for _ in range(500):
            simulator.step(0.01)
            ages += simulator.observers.information(simulator.state).age.mean(axis=1) / 500
        pairs = {pair: number for number, pair in enumerate(scenario.design.knowledge.slot)}
        for hops in (1, 2, 4):
            expected = expected_age(network, hops)
            mean = np.mean([ages[number] for (a, i), number in pairs.items() if abs(a - i) == hops])
            assert mean == pytest.approx(expected, rel=0.05, abs=0.006), hops  # grid times, not all times

    def test_bounds_beside_the_ideal_ones(self):
        report = network_report(paper(), Network.of("wifi"))
        assert report["types"] == [{"type": "drifter", "certified": True, "reason": None}]
        assert [row["hops"] for row in report["bounds"]] == [1, 2, 3]
        assert report["bounds"][0]["ideal"] == 0.0
        states = paper().design.states
        largest = max(row["ideal"] for row in report["bounds"])
        assert largest == pytest.approx(states.share.max() * states.delta.infimum().max())
        certified = [row["certified"] for row in report["bounds"]]
        assert certified == sorted(certified)
        assert certified[0] > largest

    def test_what_never_arrives_has_no_bound(self):
        report = network_report(paper(), Network(loss=1.0))
        assert all(row["expected_age"] is None and row["certified"] is None for row in report["bounds"])

    def test_a_type_without_growth_says_why(self):
        class Silent(SingleIntegrator):
            def drift_growth(self, region=None):
                return None

        scenario = line().replace(models=(Silent(),) * 5)
        report = network_report(scenario, Network())
        assert not report["types"][0]["certified"]
        assert report["types"][0]["reason"].startswith("not certified: Silent.drift_growth()")
        assert all(row["certified"] is None for row in report["bounds"])
        (row,) = measured(["ideal"], ["relay"], scenario=scenario, duration=0.2)
        assert (row.mean_bound, row.bound_to_limit, row.violations) == (None, None, 0)
