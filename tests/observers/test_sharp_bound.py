"""The sharp bound |x_tilde| < M^-1 rho of every observer, and the design rule that makes the most of it."""

from fractions import Fraction

import networkx as nx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from khop_env.observers import DesignError, Exponential, ObserverDesign, Proximal, TargetObservers
from khop_env.physics import Fleet, SingleIntegrator, random_geometric_graph
from khop_env.registry import scenario
from khop_env.results import design_report
from tests.strategies import SEEDS, connected_graphs, definition_of_m, hops, observers_of

DELTA = Exponential(2.0, 0.5, 1.0)
RULES = st.sampled_from(["paper", "sharp"])


def design_of(graph, about, rule, delta=DELTA):
    """Observers of one component each, without input observers."""
    k, relay = about
    agents = len(graph)
    options = [TargetObservers(input_observer=False)] * agents
    return ObserverDesign(Fleet([SingleIntegrator(dim=1)] * agents), graph, k, delta, None, relay, options, rule)


def exact_solution(m: np.ndarray) -> list[Fraction]:
    """M^-1 1 in rational numbers; M has integer entries."""
    rows = [[*(Fraction(int(value)) for value in row), Fraction(1)] for row in m]
    for p in range(len(rows)):
        rows[p] = [value / rows[p][p] for value in rows[p]]
        for q in range(len(rows)):
            if q != p:
                rows[q] = [a - rows[q][p] * b for a, b in zip(rows[q], rows[p], strict=True)]
    return [row[-1] for row in rows]


@given(graph=connected_graphs(smallest=2, largest=12), about=hops(), rule=RULES, t=st.floats(0.0, 5.0))
def test_own_bounds_are_m_inverse_rho_and_the_sharp_rule_is_the_widest(graph, about, rule, t):
    """[M^-1 rho]_a <= delta for every observer; under the sharp rule one of them reaches delta, so that wider funnels
    would break it.
    """
    states = design_of(graph, about, rule).states
    layout, times = states.layout, np.array([t])
    rho, delta = (bank.evaluate(times, np.empty((layout.rows, 1))) for bank in (states.rho, states.delta))
    own = states.error_bounds(delta, np.empty((layout.size, 1)))[:, 0]
    assert np.all(own <= delta[layout.column_row, 0])
    for index, block in enumerate(layout.blocks):
        m = definition_of_m(graph, observers_of(layout, index), block.agent, about[1])
        expected = np.array([float(sum_) for sum_ in exact_solution(m)]) * rho[index]
        np.testing.assert_allclose(own[block.columns], expected, rtol=1e-12)
        if rule == "sharp":
            assert own[block.columns].max() == pytest.approx(delta[index, 0], rel=1e-12)


@given(graph=connected_graphs(largest=9), about=hops(), rule=RULES, seed=SEEDS)
def test_the_bound_holds_inside_the_funnels_and_is_attained_at_their_corner(graph, about, rule, seed):
    """|xi| < rho gives |x_tilde_a| < [M^-1 rho]_a, since M^-1 >= 0; xi -> rho gives equality for all at once."""
    states = design_of(graph, about, rule).states
    rng = np.random.default_rng(seed)
    at_start = np.full((states.layout.rows, 1), DELTA.initial)
    own = states.error_bounds(at_start, np.empty((states.layout.size, 1)))[:, 0]
    for index, block in enumerate(states.layout.blocks):
        m = definition_of_m(graph, observers_of(states.layout, index), block.agent, about[1])
        rho = DELTA.initial * states.gain[index]
        xi = rho * rng.uniform(-1.0, 1.0, (200, len(m)))
        xi[:100] = rho * (1.0 - 1e-9) * np.sign(xi[:100])
        assert np.all(np.abs(np.linalg.solve(m, xi.T).T) < own[block.columns])
        np.testing.assert_allclose(np.linalg.solve(m, np.full(len(m), rho)), own[block.columns], rtol=1e-9)


def test_sharp_funnels_on_random_geometric_graphs_are_several_times_wider():
    """As wide for a single observer; otherwise, on graphs of 6 to 30 agents with k = 3, 1.2 to more than 4 times."""
    rng = np.random.default_rng(0)
    ratios, etas = [], []
    for _ in range(150):
        graph, _ = random_geometric_graph(int(rng.integers(6, 31)), 5.0, rng)
        paper, sharp = (design_of(graph, (3, True), rule).states for rule in ("paper", "sharp"))
        ratios.append(sharp.gain / paper.gain)
        etas.append(sharp.layout.arrays.observers)
    ratios, alone = np.concatenate(ratios), np.concatenate(etas) == 1
    low, median, high = np.quantile(ratios[~alone], (0.0, 0.5, 1.0))
    print(f"sharp rho / paper's rho over {len(ratios)} targets: {low:.3f} to {high:.3f}, median {median:.3f}")
    np.testing.assert_allclose(ratios[alone], 1.0, rtol=1e-12)
    assert low == pytest.approx(1.207, abs=1e-3)
    assert 2.1 < median < 2.7
    assert 3.5 < high < 5.0


def test_on_the_paper_s_tree():
    """Sharp funnels are 1.23 to 1.95 times as wide; with the paper's, own bounds are 0.13 to 0.81 of delta."""
    paper = scenario("paper")
    sharp = paper.replace(design_rule="sharp")
    ratios = sharp.design.states.gain / paper.design.states.gain
    assert [ratios.min(), ratios.max()] == pytest.approx([1.234, 1.951], abs=1e-3)
    share = paper.design.states.share
    assert [share.min(), share.max()] == pytest.approx([0.134, 0.810], abs=1e-3)
    for block in sharp.design.states.layout.blocks:
        assert sharp.design.states.share[block.pairs].max() == pytest.approx(1.0, rel=1e-15)


@pytest.mark.parametrize("rule", ["paper", "sharp"])
def test_the_simulator_guarantees_and_reports_own_bounds(rule):
    """`error_bounds`, and `Extremes.relative` as the largest error over them, in closed loop at every step."""
    simulator = scenario("paper").replace(design_rule=rule).build(observers=Proximal(), num_envs=3)
    states = simulator.design.states
    rng, largest = np.random.default_rng(0), np.zeros(3)
    for step in range(60):
        if step:
            simulator.step(0.05, 6.0 * rng.choice((-1.0, 1.0), (3, simulator.fleet.m)))
        own = simulator.error_bounds().bound.T
        for index, block in enumerate(states.layout.blocks):
            m = np.kron(states.layout.matrix(index), np.eye(block.components))
            rho = np.stack([states.rho.functions[row](simulator.t) for row in range(*block.rows.indices(10**9))])
            expected = np.linalg.solve(m, np.tile(rho, (block.observers, 1)))
            np.testing.assert_allclose(own[:, block.columns], expected.T, rtol=1e-12)
        largest = np.maximum(largest, (np.abs(simulator.errors()) / own).max(axis=1))
        assert np.all(largest < 1.0)
    np.testing.assert_allclose(simulator.extremes.relative, largest, rtol=1e-12)


def test_feasibility_and_sizes_follow_the_rule():
    """Wider funnels hold a larger initial set: bounds may start lower by the ratio of the gains."""
    paper, sharp = (scenario("paper").replace(design_rule=rule) for rule in ("paper", "sharp"))
    wider = sharp.design.states.gain / paper.design.states.gain
    radius = paper.initial.radius
    for method, factor in (("feasible_at_start", 1.0 / wider), ("smallest_initial_bound", 1.0 / wider)):
        found = [getattr(each.design.states, method)(radius) for each in (paper, sharp)]
        np.testing.assert_allclose(found[1], factor * found[0], rtol=1e-12)
    sizes = [each.sized().delta.initial for each in (paper, sharp)]
    assert sizes[1] < sizes[0]
    assert sharp.sized().design.design_rule == "sharp"
    assert sharp.sized().design.states.feasible_at_start(radius).max() == pytest.approx(0.8, rel=1e-9)
    with pytest.raises(DesignError, match="take delta"):
        sharp.replace(delta=Exponential(0.5 * sizes[1], 0.1, 5.0)).build()


def test_the_report_has_the_rule_and_the_own_bounds():
    """`khop check`: smallest and largest own bound over delta, target by target."""
    report = design_report(scenario("paper"))
    assert report["design_rule"] == "paper"
    assert report["targets"][2]["own_bound"] == pytest.approx([0.134, 0.536], abs=1e-3)
    report = design_report(scenario("paper").replace(design_rule="sharp"))
    assert report["design_rule"] == "sharp"
    assert [target["own_bound"][1] for target in report["targets"]] == pytest.approx([1.0] * 8, rel=1e-15)


def test_unknown_rules_are_refused():
    with pytest.raises(ValueError, match="scenario 'paper': design_rule must be one of paper, sharp; got 'blunt'"):
        scenario("paper").replace(design_rule="blunt")
    with pytest.raises(ValueError, match=r"design_rule must be one of paper, sharp; got \['sharp'\]"):
        design_of(nx.path_graph(3), (2, True), ["sharp"])
