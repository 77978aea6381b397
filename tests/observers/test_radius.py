"""The radius of certified boxes: the exact solution, rounded up and hardly more."""

import math

import mpmath
import numpy as np
import pytest
from hypothesis import given, settings

from khop_env.observers import Certificate
from khop_env.observers.radius import FIRST, KNOTS, OCTAVES, RadiusTable, exponential
from khop_env.physics import DoubleIntegrator, DriftingIntegrator, Growth, SingleIntegrator
from tests.strategies import SEEDS


def system(seed: int) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
    """Lambda, c and r(0), of rates from 0.01 to 30 1/s."""
    rng = np.random.default_rng(seed)
    n = int(rng.integers(1, 5))
    matrix = rng.random((n, n)) * (rng.random((n, n)) < 0.7) * 10 ** rng.uniform(-2, 1.5)
    matrix[np.diag_indices(n)] *= rng.choice([-3.0, 1.0], n)
    return matrix, rng.random(n) * rng.choice([0.0, 1.0], n), rng.random(n) * rng.choice([0.0, 1.0])


def exact(matrix: np.ndarray, c: np.ndarray, start: np.ndarray, t: float) -> np.ndarray:
    """r(t) with 60 digits."""
    n = len(c)
    whole = np.zeros((n + 1, n + 1))
    whole[:n, :n], whole[:n, n] = matrix, c
    with mpmath.workdps(60):
        found = mpmath.expm(mpmath.matrix(whole.tolist()) * mpmath.mpf(t), method="taylor") * mpmath.matrix(
            [*start, 1.0]
        )
        return np.array([float(value) for value in found[:n]])


@settings(max_examples=40)
@given(SEEDS)
def test_never_below_the_exact_solution_and_hardly_above(seed: int) -> None:
    matrix, c, start = system(seed)
    rng, table = np.random.default_rng(seed), RadiusTable(Growth(matrix), c, start)
    fastest = max(np.abs(matrix).sum(axis=1).max(), 1e-3)
    for age in [0.0, FIRST, *(min(20.0 / fastest, 100.0) * 10 ** rng.uniform(-4, 0, 3))]:
        found, wanted = table.at(np.array(age)), exact(matrix, c, start, age)
        assert (found >= wanted).all()
        # The chord's error: s (1 - s) h^2 / 2 |r''| with h at most age / KNOTS, or FIRST / KNOTS.
        h = max(age, FIRST) / KNOTS
        second = math.exp(fastest * (age + h)) * np.abs(matrix @ (matrix @ start + c)).max()
        assert (found <= wanted * (1.0 + 1e-6) + h * h / 4.0 * second + 1e-300).all()


def test_closed_forms() -> None:
    ages = np.array([0.0, 1e-5, 0.003, 0.02, 0.1, 0.5, 3.0, 20.0, 1000.0])
    cart = Certificate(DoubleIntegrator(0.5, 2.0), disturbance=np.array([0.1, 0.1, 0, 0])).radius(ages)
    speed = 2.0 / 0.5 * -np.expm1(-0.5 * ages)
    distance = 0.1 * ages + (2.0 * ages - speed) / 0.5
    for found, wanted in ((cart[2], speed), (cart[0], distance)):
        np.testing.assert_allclose(found, wanted, rtol=1e-3, atol=1e-8)
        assert (found >= wanted * (1 - 1e-12)).all()
    integrator = Certificate(SingleIntegrator(1, 2.0), start=0.1).radius(ages)[0]
    np.testing.assert_allclose(integrator, 0.1 + 2.0 * ages, rtol=1e-6)
    drifter = Certificate(DriftingIntegrator(3.0)).radius(ages)[0]
    np.testing.assert_allclose(drifter, np.minimum(3.0 * np.expm1(np.minimum(ages, 50)), 5.0 * ages), rtol=1e-3)


@given(SEEDS)
def test_ages_of_any_shape_and_order(seed: int) -> None:
    table = RadiusTable(Growth(*system(seed)[:1]), *system(seed)[1:])
    ages = 10 ** np.random.default_rng(seed).uniform(-6, 5, (3, 4))
    found = table.at(ages)
    assert found.shape == (len(system(seed)[1]), 3, 4)
    for index in np.ndindex(3, 4):
        np.testing.assert_array_equal(table.at(ages[index]), found[(slice(None), *index)])


def test_all_knots_in_order_and_beyond_the_last_only_the_line() -> None:
    growth = Growth(np.array([[0.0, 1.0], [0.0, 0.0]]), spread=np.array([np.inf, 0.0]))
    table = RadiusTable(growth, np.array([0.0, 1.0]), np.zeros(2))
    knots = np.concatenate(
        [FIRST * np.arange(KNOTS) / KNOTS, *(FIRST * 2.0**e * (1.0 + np.arange(KNOTS) / KNOTS) for e in range(OCTAVES))]
    )
    np.testing.assert_allclose(table.at(knots)[0], knots**2 / 2.0, rtol=1e-6)
    between = knots[:-1] + 0.3 * np.diff(knots)
    assert (table.at(between)[0] >= between**2 / 2.0).all()
    last = FIRST * 2.0**OCTAVES
    assert table.at(np.array([last, 10 * last, np.inf])).tolist() == [
        [math.inf] * 3,
        [pytest.approx(last), pytest.approx(10 * last), math.inf],
    ]


def test_explosive_growth_is_inf_and_never_nan() -> None:
    table = RadiusTable(Growth(np.array([[500.0, 3.0], [0.0, -1e4]])), np.ones(2), np.ones(2))
    found = table.at(np.geomspace(1e-6, 1e6, 500))
    assert not np.isnan(found).any()
    assert np.isinf(found[0, -1])
    assert (found[0, 1:] >= found[0, :-1]).all()


@given(SEEDS)
def test_exponential_of_stiff_matrices(seed: int) -> None:
    matrix, *_ = system(seed)
    for t in (1e-4, 0.3, 10.0 / max(np.abs(matrix).sum(axis=1).max(), 1e-3)):
        with mpmath.workdps(60):
            wanted = mpmath.expm(mpmath.matrix(matrix.tolist()) * mpmath.mpf(t), method="taylor")
            wanted = np.array(wanted.tolist(), dtype=float)
        np.testing.assert_allclose(exponential(matrix, t), wanted, rtol=1e-12, atol=1e-300)
