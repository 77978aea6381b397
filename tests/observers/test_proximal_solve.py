"""The proximal solve: one solution, inside the funnel, found from any start, lane by lane."""

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from khop_env.observers import PairLayout
from khop_env.observers.solve import LANES, MAX_ITERATIONS, solve
from khop_env.physics import Links, k_hop_neighbors
from tests.strategies import SEEDS, connected_graphs, digraphs, hops


def layout_of(graph, k, relay, dimensions=None, changing=False):
    """A layout over all agents, of one component each by default."""
    dimensions = dimensions or [1] * len(graph)
    offsets = np.concatenate([[0], np.cumsum(dimensions)])
    return PairLayout.build(
        Links.of(graph),
        k_hop_neighbors(graph, k, relay=relay),
        dimensions,
        offsets,
        relay=relay,
        changing=changing,
    )


def run(layout, tau, predictor, source, rho, eps=None, batch=None, targets=None, weights=None):
    """`solve` on copies: the estimates, eps, slope and what it returned."""
    eps = np.zeros_like(predictor) if eps is None else eps.copy()
    estimate, slope = np.full_like(predictor, np.nan), np.full_like(predictor, np.nan)
    result = solve(
        layout.arrays,
        tau,
        predictor,
        source,
        rho,
        eps,
        estimate,
        slope,
        batch or (0, predictor.shape[1]),
        targets or (0, len(layout.blocks)),
        *([] if weights is None else [weights]),
    )
    return estimate, eps, slope, result


def problem(layout, rng, batch=1, hard=True):
    """Random data of one solve; hard ones reach a million units outside and span all sizes of rho and tau."""
    reach = 10.0 ** rng.uniform(-3, 6 if hard else 1)
    rho = 10.0 ** (rng.uniform(-4, 2, (layout.rows, batch)) if hard else rng.uniform(-1, 1, (layout.rows, batch)))
    tau = 10.0 ** (rng.uniform(-6, 1) if hard else rng.uniform(-3, 0))
    source = reach * rng.uniform(-1, 1, (int(layout.column_source.max(initial=0)) + 1, batch))
    predictor = reach * rng.uniform(-1, 1, (layout.size, batch))
    return tau, predictor, source, rho


def matrix_of(layout, index, weights=None):
    """M of a target; with weights that of the first environment."""
    if weights is None:
        return layout.matrix(index)
    block, arrays = layout.blocks[index], layout.arrays
    m = np.diag(weights[0][block.pairs, 0])
    for a, pair in enumerate(range(block.pairs.start, block.pairs.stop)):
        for entry in range(arrays.entry_start[pair], arrays.entry_start[pair + 1]):
            m[a, arrays.entry[entry]] = -weights[2][entry, 0]
    return m


def full_matrix(layout, weights=None):
    """M of all targets and components at once, and the weight of the true state in each disagreement."""
    m, h = np.zeros((layout.size, layout.size)), np.zeros(layout.size)
    for index, block in enumerate(layout.blocks):
        part, n = block.columns, block.components
        m[part, part] = np.kron(matrix_of(layout, index, weights), np.eye(n))
        relay = layout.arrays.relay if weights is None else weights[1][:, 0]
        h[part] = np.repeat(relay[block.pairs], n)
    return m, h


def check_solution(layout, tau, predictor, source, rho, estimate, eps, slope, weights=None):
    """y+ = y* - tau P^-1 phi'(e+), |e+| < 1, and xi recomputed from y+ is rho e+; each to its rounding."""
    rows = rho[layout.column_row]
    z = eps * (1.0 + np.cosh(eps))  # phi'(e) in terms of eps = T(e)
    np.testing.assert_array_equal(estimate, predictor + tau * slope)
    assert np.all(np.abs(rows * slope + z) <= 1e-8 * np.abs(z) + 1e-9)  # eps is good to the square of its tolerance
    e = np.tanh(0.5 * eps)
    assert np.all(np.isfinite(eps))
    assert np.all(np.abs(e) <= 1.0)  # = 1 only where 1 - |e| = 2 exp(-|eps|) is below a float's spacing
    m, h = full_matrix(layout, weights)
    truth = source[layout.column_source]
    xi = m @ estimate - h[:, None] * truth
    rounding = 4e-16 * (np.abs(m) @ (np.abs(estimate) + np.abs(predictor)) + h[:, None] * np.abs(truth))
    assert np.all(np.abs(xi - rows * e) <= 4 * rounding + 1e-9 * rows * (1 - e**2) + 4e-16 * rows)
    strict = np.abs(xi) < rows
    assert np.all(strict | (np.abs(xi) - rows <= 4 * rounding))
    return strict


@settings(max_examples=200)
@given(graph=connected_graphs(smallest=2, largest=13) | digraphs(smallest=2, largest=13), about=hops(), seed=SEEDS)
def test_stress_one_component_converges_from_anywhere(graph, about, seed):
    """A solution for every tau > 0, every predictor and every jump, and Newton finds it.

    Over 33 000 random targets with eta up to 12, rho in 1e-4..1e2, tau in 1e-6..10 and predictors and states up to 1e6
    away, 26 iterations were the most from eps = 0 (median 4).
    """
    layout = layout_of(graph, *about)
    rng = np.random.default_rng(seed)
    for _ in range(5):
        tau, predictor, source, rho = problem(layout, rng)
        for index, block in enumerate(layout.blocks):
            eta = block.observers
            alone = run(layout, tau, predictor, source, rho, targets=(index, index + 1))
            evaluations, env, line = alone[3]
            assert (env, line) == (-1, -1)
            assert evaluations % eta == 0
            assert evaluations // eta <= MAX_ITERATIONS // 2
            assert np.all(np.isfinite(alone[0][block.columns]))
        estimate, eps, slope, _ = run(layout, tau, predictor, source, rho)
        check_solution(layout, tau, predictor, source, rho, estimate, eps, slope)


@given(
    graph=connected_graphs() | digraphs(),
    about=hops(),
    dimensions=st.lists(st.integers(1, 6), min_size=9, max_size=9),
    seed=SEEDS,
)
def test_moderate_jumps_end_strictly_inside(graph, about, dimensions, seed):
    """The open funnel |xi+| < rho holds for xi recomputed from the estimates, up to rounding; any n_i."""
    layout = layout_of(graph, *about, dimensions[: len(graph)])
    tau, predictor, source, rho = problem(layout, np.random.default_rng(seed), batch=3, hard=False)
    estimate, eps, slope, (_, env, _) = run(layout, tau, predictor, source, rho)
    assert env == -1
    assert np.all(check_solution(layout, tau, predictor, source, rho, estimate, eps, slope))


@given(graph=connected_graphs() | digraphs(), about=hops(), seed=SEEDS, spread=st.sampled_from([0.1, 3.0, 20.0]))
def test_solution_does_not_depend_on_the_warm_start(graph, about, seed, spread):
    """The objective is strictly convex, or the equation that of an M-function: one solution, whichever feasible point
    Newton starts from; |eps| = 20 is a disagreement within 4e-9 of the wall.
    """
    layout = layout_of(graph, *about)
    rng = np.random.default_rng(seed)
    tau, predictor, source, rho = problem(layout, rng)
    cold = run(layout, tau, predictor, source, rho)
    warm = run(layout, tau, predictor, source, rho, eps=rng.uniform(-spread, spread, predictor.shape))
    assert warm[3][1] == -1
    np.testing.assert_allclose(warm[1], cold[1], rtol=1e-8, atol=1e-8)
    m, h = full_matrix(layout)
    size = np.abs(m) @ (np.abs(cold[0]) + np.abs(predictor)) + h[:, None] * np.abs(source[layout.column_source])
    slack = np.abs(np.linalg.inv(m)) if layout.size else m
    assert np.all(np.abs(warm[0] - cold[0]) <= slack @ (2e-14 * size + 1e-8 * rho[layout.column_row]))


@settings(max_examples=15)
@given(graph=connected_graphs(largest=7) | digraphs(largest=7), about=hops(), seed=SEEDS)
def test_a_loose_tolerance_is_inaccurate_but_keeps_the_funnel(graph, about, seed):
    """Newton's last step is linear in z, so the estimates end inside after any step below 1 in eps: run in Python,
    where the tolerance can be changed.
    """
    layout = layout_of(graph, *about)
    tau, predictor, source, rho = problem(layout, np.random.default_rng(seed), 2, hard=False)
    eps, slope, estimate = np.zeros_like(predictor), np.empty_like(predictor), np.empty_like(predictor)
    in_python = getattr(solve, "py_func", solve)
    with pytest.MonkeyPatch.context() as patch:
        patch.setitem(in_python.__globals__, "TOLERANCE", 0.99)
        result = in_python(
            layout.packed, tau, predictor, source, rho, eps, estimate, slope, (0, 2), (0, len(layout.blocks))
        )
    assert result[1] == -1
    m, h = full_matrix(layout)
    xi = m @ estimate - h[:, None] * source[layout.column_source]
    assert np.all(np.abs(xi) < rho[layout.column_row])


@settings(max_examples=40)
@given(
    graph=connected_graphs(largest=7) | digraphs(largest=7),
    about=hops(),
    dimensions=st.lists(st.integers(1, 6), min_size=7, max_size=7),
    batch=st.sampled_from([1, 2, 3, LANES - 1, LANES + 1, 2 * LANES + 3]),
    seed=SEEDS,
)
def test_every_environment_and_target_is_solved_as_if_alone(graph, about, dimensions, batch, seed):
    """Row b of a batch, and any split into ranges of environments and targets, have the bits of the single solve."""
    layout = layout_of(graph, *about, dimensions[: len(graph)])
    rng = np.random.default_rng(seed)
    tau, predictor, source, rho = problem(layout, rng, batch)
    start = rng.normal(size=predictor.shape)
    whole = run(layout, tau, predictor, source, rho, start)
    for b in sorted({0, batch // 2, batch - 1}):
        one = [np.ascontiguousarray(array[:, b : b + 1]) for array in (predictor, source, rho, start)]
        for ours, alone in zip(whole[:3], run(layout, tau, *one)[:3], strict=True):
            np.testing.assert_array_equal(ours[:, b], alone[:, 0])

    cut, line = int(rng.integers(0, batch + 1)), int(rng.integers(0, len(layout.blocks) + 1))
    joined = [start.copy(), np.full_like(predictor, np.nan), np.full_like(predictor, np.nan)]
    for environments in ((0, cut), (cut, batch)):
        for targets in ((0, line), (line, len(layout.blocks))):
            solve(layout.arrays, tau, predictor, source, rho, *joined, environments, targets)
    for ours, split in zip(whole[:3], (joined[1], joined[0], joined[2]), strict=True):
        np.testing.assert_array_equal(ours, split)


@given(graph=connected_graphs() | digraphs(), about=hops(), seed=SEEDS)
def test_the_predictor_may_be_overwritten(graph, about, seed):
    """Estimates written over the predictor are those written elsewhere: the simulator steps in place."""
    layout = layout_of(graph, *about)
    tau, predictor, source, rho = problem(layout, np.random.default_rng(seed), 3, hard=False)
    expected = run(layout, tau, predictor, source, rho)
    eps, slope, estimate = np.zeros_like(predictor), np.empty_like(predictor), predictor.copy()
    solve(layout.arrays, tau, estimate, source, rho, eps, estimate, slope, (0, 3), (0, len(layout.blocks)))
    np.testing.assert_array_equal(estimate, expected[0])
    np.testing.assert_array_equal(eps, expected[1])


def test_one_observer_against_the_scalar_equation():
    """eta = 1, M = [1]: y + (tau / rho) phi'((y - x) / rho) = y*, solved by bisection."""
    layout = layout_of(nx.path_graph(3), 2, True)
    tau, x, rho, start = 0.3, 1.25, 0.05, 4.0
    low, high = -1.0, 1.0
    for _ in range(200):
        e = 0.5 * (low + high)
        excess = x + rho * e + tau / rho * (2 / (1 - e * e)) * np.log((1 + e) / (1 - e)) - start
        low, high = (low, e) if excess > 0 else (e, high)
    source = np.array([[x], [0.0], [0.0]])
    estimate, eps, _, _ = run(layout, tau, np.array([[start], [0.0]]), source, np.full((2, 1), rho))
    assert np.tanh(0.5 * eps[0, 0]) == pytest.approx(e, rel=1e-13)
    assert estimate[0, 0] == pytest.approx(x + rho * e, rel=1e-13)


@pytest.mark.parametrize("batch", [1, LANES + 6])
@pytest.mark.parametrize("bad", [np.nan, -np.inf])
@pytest.mark.parametrize(
    ("which", "relay"), [("predictor", True), ("predictor", False), ("source", True), ("eps", True), ("eps", False)]
)
def test_numbers_that_are_not_finite_are_reported_not_looped_over(which, relay, bad, batch):
    """The solve fails at the environment and the target that got them, after a bounded number of iterations.

    Without relay on a star M is the identity for the targets in the middle: one observer's NaN is nobody else's.
    """
    layout = layout_of(nx.path_graph(6), 3, True) if relay else layout_of(nx.star_graph(4), 1, False)
    tau, predictor, source, rho = problem(layout, np.random.default_rng(0), batch, hard=False)
    data = {"predictor": predictor, "source": source, "rho": rho, "eps": np.zeros_like(predictor)}
    target = 2 if relay else 0
    block = layout.blocks[target]
    index = (block.sources if which == "source" else block.columns).start
    data[which][index, batch - 1] = bad
    evaluations, env, line = run(layout, tau, **data)[3]
    assert (env, line) == (batch - 1, target)
    assert evaluations <= MAX_ITERATIONS * layout.size * batch


def test_a_funnel_that_is_not_a_number_is_reported():
    """As above for rho, which FunnelBank checks for users' functions already."""
    layout = layout_of(nx.path_graph(6), 3, True)
    tau, predictor, source, rho = problem(layout, np.random.default_rng(0), 5, hard=False)
    rho[2, 3] = np.nan
    assert run(layout, tau, predictor, source, rho)[3][1:] == (3, 2)


def test_nothing_to_solve():
    """No targets or no environments: nothing happens."""
    layout = layout_of(nx.complete_graph(4), 2, True)
    assert layout.size == 0
    empty = np.zeros((0, 2))
    assert run(layout, 0.1, empty, np.zeros((4, 2)), empty)[3] == (0, -1, -1)
