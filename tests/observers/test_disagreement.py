"""Section III of the paper: the matrices M_i and the disagreements, against their definitions written out from the
graph.
"""

import networkx as nx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from khop_env.observers import PairLayout, Proximal
from khop_env.observers.disagreement import disagreement
from khop_env.physics import Fleet, Links, k_hop_neighbors, validate_graph
from tests.strategies import (
    PLANAR,
    SEEDS,
    connected_graphs,
    definition_of_m,
    digraphs,
    heard,
    hops,
    k_hop_sets,
    observers_of,
    relays,
    systems,
)


@st.composite
def layouts(draw):
    """A layout over a random graph with agents of different dimensions, all of them or some being targets."""
    graph = draw(connected_graphs() | digraphs())
    graph = validate_graph(graph, len(graph), directed=True)
    k, relay = draw(hops())
    fleet = Fleet([draw(st.sampled_from(PLANAR)) for _ in graph])
    targets = draw(st.none() | st.sets(st.sampled_from(sorted(graph))))
    layout = PairLayout.build(
        Links.of(graph),
        k_hop_neighbors(graph, k, relay=relay),
        [model.n for model in fleet.models],
        fleet.state_offset,
        relay=relay,
        targets=targets,
    )
    return graph, k, relay, fleet, targets, layout


@given(drawn=layouts())
def test_pairs_are_the_k_hop_neighbors_of_every_target(drawn):
    """N_i^{k-hop} of Section II, by networkx; agents with no such neighbour, or that aren't targets, are absent."""
    graph, k, relay, _, targets, layout = drawn
    sets = k_hop_sets(graph, k, relay)
    wanted = [i for i in sorted(graph) if sets[i] and (targets is None or i in targets)]
    assert layout.target.tolist() == wanted
    for index, target in enumerate(wanted):
        members = observers_of(layout, index)
        assert set(members) == sets[target]
        assert len(members) == len(sets[target]) == layout.blocks[index].observers
        for observer in members:
            assert (observer, target) in layout.slot
    assert len(layout.slot) == layout.pairs == sum(len(sets[i]) for i in wanted)


@given(drawn=layouts())
def test_lemma_1_the_matrices_are_positive_definite(drawn):
    """Lemma 1 and its remark: M_i = L_i + H_i > 0 on every connected graph, with relay and without.

    On directed graphs they aren't symmetric, and `test_directed.py` has the extension.
    """
    graph, _, relay, _, _, layout = drawn
    for index, target in enumerate(layout.target.tolist()):
        defined = definition_of_m(graph, observers_of(layout, index), target, relay)
        np.testing.assert_array_equal(layout.matrix(index), defined)
        if graph.is_directed():
            continue
        spectrum = np.linalg.eigvalsh(defined)
        assert spectrum[0] > 1e-3  # integer matrices of this size with det >= 1 can't come closer to singular
        np.testing.assert_allclose(layout.eigenvalues[index], spectrum[[0, -1]], rtol=1e-12)


def test_lemma_1_needs_a_connected_graph():
    """Two agents without other neighbours have no path to the target: M would be singular; they are no observers."""
    graph = nx.Graph([(0, 1), (1, 2), (3, 4)])
    layout = PairLayout.build(Links.of(graph), k_hop_neighbors(graph, 4), [1] * 5, range(5), relay=True)
    assert layout.target.tolist() == [0, 2]


def by_definition(graph, k, relay, fleet, layout, estimate, source):
    """xi by the paper's equation (eq: disagreement vector on the estimate of agent i), sum by sum; and its scale."""
    xi, scale = np.zeros_like(estimate), np.zeros_like(estimate)
    sets = k_hop_sets(graph, k, relay)
    for (observer, target), slot in layout.slot.items():
        for c in range(fleet.models[target].n):
            mine = estimate[slot + c]
            terms = [mine - estimate[layout.slot[other, target] + c] for other in heard(graph, observer) & sets[target]]
            truth = source[fleet.state_offset[target] + c]
            terms.append(relays(graph, observer, target, relay) * (mine - truth))
            xi[slot + c] = sum(terms)
            scale[slot + c] = sum(np.abs(term) for term in terms) + len(terms) * np.abs(mine)
    return xi, scale


@given(drawn=layouts(), seed=SEEDS, batch=st.integers(1, 5))
def test_disagreement_is_the_sum_over_neighbors_and_m_times_the_error(drawn, seed, batch):
    """xi_i^a = sum_l (x_hat_i^a - x_hat_i^l) + |N_a cap N_i| (x_hat_i^a - x_i), and xi_i = M_i x_tilde_i."""
    graph, k, relay, fleet, _, layout = drawn
    rng = np.random.default_rng(seed)
    scale = 10.0 ** rng.uniform(-3, 3)
    estimate = scale * rng.normal(size=(layout.size, batch))
    source = scale * rng.normal(size=(fleet.n, batch))
    out = np.full_like(estimate, np.nan)
    disagreement(layout.arrays, estimate, source, out)

    xi, scale = by_definition(graph, k, relay, fleet, layout, estimate, source)
    assert np.all(np.abs(out - xi) <= 1e-14 * scale)

    error = estimate - source[layout.column_source]
    for index, block in enumerate(layout.blocks):
        part = block.columns
        m = definition_of_m(graph, observers_of(layout, index), block.agent, relay)
        product = np.kron(m, np.eye(block.components)) @ error[part]  # "by appropriate use of the Kronecker product"
        np.testing.assert_allclose(out[part], product, atol=1e-13 * scale.max(), rtol=0)


@given(system=systems())
def test_simulator_reports_disagreements_and_errors_of_both_observers(system):
    """xi = M x_tilde and mu = M g_tilde (the equations of Sections III and V) in the results of `Simulator`."""
    simulator = system.simulator(Proximal(), num_envs=2)
    simulator.step(0.05)
    for funnels, error, difference, estimates, truth in (
        (system.design.states, simulator.errors(), simulator.disagreements(), simulator.estimates, simulator.x),
        (
            system.design.inputs,
            simulator.input_errors(),
            simulator.input_disagreements(),
            simulator.input_estimates,
            simulator.g,
        ),
    ):
        layout = funnels.layout
        for (observer, target), slot in layout.slot.items():
            n = system.design.fleet.models[target].n
            own = estimates[:, slot : slot + n]
            np.testing.assert_array_equal(
                error[:, slot : slot + n], own - truth[:, system.design.fleet.state_slice(target)]
            )
            members = system.design.neighborhoods[target]
            graph = system.design.communication
            others = [layout.slot[other, target] for other in graph[observer] if other in members]
            h = relays(graph, observer, target, system.design.relay)
            xi = h * error[:, slot : slot + n] + sum(own - estimates[:, o : o + n] for o in others)
            np.testing.assert_allclose(difference[:, slot : slot + n], xi, rtol=1e-9, atol=1e-11)


@given(graph=connected_graphs(), k=st.integers(1, 4))
def test_without_relay_nobody_reads_a_state_it_does_not_hear(graph, k):
    """Remark on Assumption 4: x_i enters the disagreement of observers that are its neighbours, and no other's."""
    layout = PairLayout.build(
        Links.of(graph), k_hop_neighbors(graph, k, relay=False), [1] * len(graph), range(len(graph)), relay=False
    )
    estimate = np.zeros((layout.size, 1))
    for target in layout.target.tolist():
        source = np.zeros((len(graph), 1))
        source[target] = np.nan
        out = np.zeros((layout.size, 1))
        disagreement(layout.arrays, estimate, source, out)
        affected = {pair for pair, slot in layout.slot.items() if np.isnan(out[slot, 0])}
        assert affected == {(neighbor, target) for neighbor in graph[target]}


def test_the_paper_s_tree_has_the_published_constant():
    """rho(inf) / delta(inf) = 0.02 / 0.117 of agent 4 (here 3): lambda_min / sqrt(5) = (3 - sqrt 5) / 2 / sqrt 5."""
    graph = nx.Graph([*((i, i + 1) for i in range(6)), (4, 7)])
    layout = PairLayout.build(Links.of(graph), k_hop_neighbors(graph, 3), [2] * 8, range(0, 16, 2), relay=True)
    smallest = layout.eigenvalues[layout.target.tolist().index(3), 0]
    assert smallest == pytest.approx((3 - np.sqrt(5)) / 2, rel=1e-14)
    assert smallest / np.sqrt(5) == pytest.approx(0.02 / 0.117, rel=1e-3)
