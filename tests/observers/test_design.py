"""The design rule of Section III: funnels on disagreements that imply bounds on estimation errors."""

import itertools

import networkx as nx
import numpy as np
import pytest
from hypothesis import assume, given, settings
from hypothesis import strategies as st

from khop_env.observers import DesignError, Exponential, ObserverDesign, TargetObservers
from khop_env.observers.disagreement import disagreement
from khop_env.physics import DriftingIntegrator, Fleet, SingleIntegrator, Unicycle
from tests.strategies import SEEDS, connected_graphs, definition_of_m, hops, observers_of, systems

TIMES = np.array([0.0, 0.01, 0.1, 0.5, 1.0, 3.0, 30.0])
ONE = Exponential(1.0, 0.5, 1.0)


def scalar_fleet(agents):
    return Fleet([SingleIntegrator(dim=1)] * agents)


def error_bound_of(bounds, target, t):
    return np.array([(f.initial - f.final) * np.exp(-f.rate * t) + f.final for f in bounds[target]])


@given(system=systems())
def test_design_rule_makes_the_norm_of_rho_what_problem_2_allows(system):
    """Problem 2: |rho_i(t)| <= lambda_min(M_i) min_j delta_i^j(t), for states and inputs; equal for one delta. The
    sharp rule's are never narrower.
    """
    for funnels, bounds in ((system.design.states, system.deltas), (system.design.inputs, system.thetas)):
        layout = funnels.layout
        rho = funnels.rho.evaluate(TIMES, np.empty((layout.rows, TIMES.size)))
        delta = funnels.delta.evaluate(TIMES, np.empty((layout.rows, TIMES.size)))
        for index, block in enumerate(layout.blocks):
            target, rows = block.agent, block.rows
            m = definition_of_m(system.design.communication, observers_of(layout, index), target, system.design.relay)
            smallest = np.linalg.eigvalsh(m)[0]
            expected = np.stack([error_bound_of(bounds, target, t) for t in TIMES], axis=1)
            np.testing.assert_allclose(delta[rows], expected, rtol=1e-12)
            norm = np.linalg.norm(np.broadcast_to(rho[rows], (block.observers, block.components, TIMES.size)), axis=0)
            if system.design.design_rule == "sharp":
                assert np.all(norm >= smallest * expected * (1 - 1e-12))
            else:
                np.testing.assert_allclose(norm, smallest * expected, rtol=1e-12)


@given(graph=connected_graphs(), about=hops(), seed=SEEDS)
def test_disagreement_within_rho_implies_error_within_delta(graph, about, seed):
    """Section III: |x_tilde| <= |M^-1| |xi|, so that |xi_a| < rho for all a gives |x_tilde_a| < delta; corners
    included.
    """
    k, relay = about
    design = ObserverDesign(scalar_fleet(len(graph)), graph, k, ONE, ONE, relay)
    rng = np.random.default_rng(seed)
    rho = design.states.rho.evaluate(np.zeros(1), np.empty((design.states.layout.rows, 1)))[:, 0]
    for index, target in enumerate(design.states.layout.target.tolist()):
        m = definition_of_m(graph, observers_of(design.states.layout, index), target, relay)
        corners = np.array(list(itertools.product((-1.0, 1.0), repeat=len(m))))
        inside = rng.uniform(-1.0, 1.0, (200, len(m)))
        xi = np.concatenate([corners * (1 - 1e-12), inside]) * rho[index]
        error = np.linalg.solve(m, xi.T)
        assert np.all(np.abs(error) < ONE(0.0))
        assert np.all(np.linalg.norm(error, axis=0) < ONE(0.0))


def largest_start(funnels, center, radius, rng):
    """(rows,) the largest |xi(0)| found over corners and random points of the box, observers guessing its centre."""
    layout = funnels.layout
    directions = np.concatenate(
        [np.ones((1, len(center))), -np.ones((1, len(center))), rng.uniform(-1, 1, (50, len(center)))]
    )
    source = np.ascontiguousarray((center + radius * directions).T)
    estimate = np.repeat(center[layout.column_source][:, None], source.shape[1], axis=1)
    xi = np.empty_like(estimate)
    disagreement(layout.arrays, estimate, source, xi)
    largest = np.zeros(layout.rows)
    np.maximum.at(largest, layout.column_row, np.abs(xi).max(axis=1))
    return largest


@given(system=systems())
def test_feasible_at_start_is_the_worst_case_over_the_initial_set(system):
    """xi(0) = H (c - x(0)); every component of a row is largest at a corner of the box."""
    rng = np.random.default_rng(system.seed)
    design, initial = system.design, system.initial
    guess = np.zeros(design.fleet.n)  # of g, which is anything in its bounds
    for funnels, center, radius in (
        (design.states, initial.center, initial.radius),
        (design.inputs, guess, design.fleet.input_map_bound),
    ):
        start = funnels.rho.evaluate(np.zeros(1), np.empty((funnels.layout.rows, 1)))[:, 0]
        found = largest_start(funnels, center, radius, rng) / start
        np.testing.assert_allclose(funnels.feasible_at_start(radius), found, rtol=1e-9, atol=1e-12)


@settings(max_examples=50)
@given(graph=connected_graphs(), about=hops(), radius=st.floats(1e-3, 1e3), pick=SEEDS)
def test_smallest_initial_bound_is_tight_from_both_sides(graph, about, radius, pick):
    """Just above it |xi(0)| < rho(0) holds for the whole initial set, just below it doesn't; for one target and for
    all.
    """
    k, relay = about
    fleet = scalar_fleet(len(graph))

    def design(bounds):
        options = [TargetObservers(input_observer=False)] * len(graph)
        return ObserverDesign(fleet, graph, k, bounds, relay=relay, targets=options)

    probe = design(ONE)
    assume(probe.states.layout.rows)
    radii, none = np.full(fleet.n, radius), np.zeros(fleet.n)
    smallest = dict(zip(probe.states.layout.target.tolist(), probe.states.smallest_initial_bound(radii), strict=True))

    def sized(factors):
        return {i: Exponential(smallest[i] * factors[i], 1e-6 * smallest[i], 1.0) for i in smallest}

    above = design(sized(dict.fromkeys(smallest, 1 + 1e-9)))
    above.require_feasible_start(radii, none)
    assert np.all(above.states.feasible_at_start(radii) < 1.0)
    unlucky = sorted(smallest)[pick % len(smallest)]
    below = design(sized(dict.fromkeys(smallest, 1 + 1e-9) | {unlucky: 1 - 1e-9}))
    with pytest.raises(DesignError, match=f"state observers of 'integrator_{unlucky}' can't start"):
        below.require_feasible_start(radii, none)
    assert np.sum(below.states.feasible_at_start(radii) >= 1.0) == 1


def test_refused_start_names_agent_component_and_numbers():
    """Path of three, one observer per end: M = [1], so rho = delta, the component with the larger share is named."""
    fleet = Fleet([SingleIntegrator(), DriftingIntegrator(), SingleIntegrator()])
    delta = Exponential(2.0, 0.1, 1.0)
    design = ObserverDesign(fleet, nx.path_graph(3), 2, delta, Exponential(9.0, 1.0, 1.0))
    radius = np.array([0.5, 2.5, 0.0, 0.0, 2.25, 0.5])
    with pytest.raises(DesignError) as caught:
        design.require_feasible_start(radius, np.zeros(6))
    assert str(caught.value) == (
        "the state observers of 'integrator_0' can't start inside their funnel: component 'y' may have |xi(0)| = 2.5, "
        "but rho(0) = 2 (from delta(0) = 2); take delta(0) above 2.5, or a smaller initial set"
    )
    with pytest.raises(
        DesignError, match=r"input observers of 'integrator_1'.*'x' may have \|mu\(0\)\| = 12.*theta\(0\)"
    ):
        design.require_feasible_start(np.zeros(6), np.array([0.0, 0.0, 0.0, 0.0, 12.0, 3.0]))
    design.require_feasible_start(np.full(6, 1.999), np.full(6, 8.999))


TREE = nx.path_graph(4)
INTEGRATORS = Fleet([SingleIntegrator()] * 4)
UNBOUNDED = Fleet([SingleIntegrator()] * 3 + [DriftingIntegrator(input_limit=np.inf)])
UNICYCLES = Fleet([SingleIntegrator()] * 3 + [Unicycle()])
PLAIN, NO_INPUT = TargetObservers(), TargetObservers(input_observer=False)


@pytest.mark.parametrize(
    ("fleet", "delta", "theta", "targets", "message"),
    [
        (INTEGRATORS, ONE, ONE, [PLAIN] * 3, "targets has 3 entries, the fleet 4 agents"),
        (UNICYCLES, ONE, ONE, [PLAIN] * 4, "'unicycle_0' can't have an input observer.*depends on its state"),
        (UNBOUNDED, ONE, ONE, [NO_INPUT] * 4, "'drifter_0' can't do without an input observer.*unbounded"),
        (INTEGRATORS, ONE, None, None, "theta is missing: 4 agents have an input observer, the first 'integrator_0'"),
        (INTEGRATORS, {0: ONE, 1: ONE, 2: ONE}, ONE, None, "delta has no bound for agent 'integrator_3'"),
        (INTEGRATORS, ONE, {0: ONE}, None, "theta has no bound for agent 'integrator_1'"),
        (INTEGRATORS, dict.fromkeys(range(4), (ONE,)), ONE, None, "delta of agent 'integrator_0': expected .* of 2"),
        (INTEGRATORS, dict.fromkeys(range(4), 0.1), ONE, None, "delta of agent 'integrator_0': expected .*got 0.1"),
        (INTEGRATORS, {**dict.fromkeys(range(3), ONE), 3: 0.1}, ONE, None, "delta of agent 'integrator_3': .*got 0.1"),
        (INTEGRATORS, ONE, (ONE, 3.0), None, "theta of agent 'integrator_0': expected a performance function"),
    ],
)
def test_designs_that_no_theorem_covers_are_refused(fleet, delta, theta, targets, message):
    """Remark 1 (g(x, u) has no PPIO), Assumption 2-i (no PPIO needs bounded g), and bounds that are missing or
    misshapen.
    """
    with pytest.raises(DesignError, match=message):
        ObserverDesign(fleet, TREE, 2, delta, theta, targets=targets)


@pytest.mark.parametrize(
    ("graph", "k", "message"),
    [
        (nx.Graph([(0, 1), (2, 3)]), 2, "falls into 2 components"),
        (nx.MultiGraph([(0, 1), (1, 2), (2, 3)]), 2, "expected a simple networkx.Graph or DiGraph, got a MultiGraph"),
        (nx.path_graph(5), 2, "integers 0 to 3"),
        (TREE, 1, "k must be at least 2 with relay"),
    ],
)
def test_graphs_that_the_assumptions_exclude_are_refused(graph, k, message):
    """Assumption 3, and Lemma 1's connected graph."""
    with pytest.raises(ValueError, match=message):
        ObserverDesign(INTEGRATORS, graph, k, ONE, ONE)


def test_default_observers_leave_out_the_input_observer_where_g_depends_on_the_state():
    """Remark on Assumption 2: g_i(x_i, u_i) is allowed without PPIO; bounds are one function or one per component."""
    design = ObserverDesign(
        UNICYCLES, TREE, 2, dict.fromkeys(range(3), ONE) | {3: (ONE, ONE, Exponential(2.0, 1.0, 1.0))}, ONE
    )
    assert [option.input_observer for option in design.options] == [True, True, True, False]
    assert design.states.layout.target.tolist() == [0, 1, 2, 3]
    assert design.inputs.layout.target.tolist() == [0, 1, 2]
    assert design.states.bounds[-1] == Exponential(2.0, 1.0, 1.0)


@given(system=systems())
def test_explicit_step_bound_is_where_euler_stops_damping(system):
    """Linearised at e = 0 in steady state, a step multiplies errors by I - dt (4 / rho^2) M: stable iff dt below the
    bound.
    """
    states = system.design.states
    bound = states.explicit_step_bound()
    floor = states.rho.infimum()
    for index in range(len(states.layout.target)):
        m = states.layout.matrix(index)
        rho = floor[states.layout.blocks[index].rows].min()
        for factor, stable in ((0.999, True), (1.001, False)):
            spread = np.linalg.eigvalsh(np.eye(len(m)) - factor * bound[index] * 4.0 / rho**2 * m)
            assert (np.abs(spread).max() < 1.0) == stable


def test_equal_matrices_are_solved_once(monkeypatch):
    """Every leaf of a star is estimated by all the others, with one and the same M_i."""
    solved = []
    eigvalsh = np.linalg.eigvalsh
    monkeypatch.setattr(np.linalg, "eigvalsh", lambda stack: solved.append(len(stack)) or eigvalsh(stack))
    layout = ObserverDesign(scalar_fleet(21), nx.star_graph(20), 2, ONE, ONE).states.layout
    assert layout.eigenvalues.shape == (20, 2)
    assert sum(solved) == 1
    for index in range(20):
        assert layout.eigenvalues[index] == pytest.approx(eigvalsh(layout.matrix(index))[[0, -1]])
