"""The barrier phi = T^2 / 2 and its impulse z = phi'(e), against arithmetic with 60 digits."""

import math

import mpmath
import networkx as nx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from khop_env.observers.barrier import barrier, eps_near_impulse
from khop_env.observers.disagreement import barrier_curvature, correction, transformation, transformation_slope
from khop_env.observers.layout import PairLayout
from khop_env.physics import Links, k_hop_neighbors

mpmath.mp.dps = 60
ULP = 2.0**-52
INSIDE = st.floats(-1.0, 1.0, exclude_min=True, exclude_max=True)
TRANSFORMED = st.floats(-690.0, 690.0) | st.floats(-3.0, 3.0)


def exact_t(e):
    """T(e) = ln((1 + e) / (1 - e)) = 2 artanh(e) in high precision; 60 digits of 1 + e hold no e below 1e-60."""
    e = mpmath.mpf(e)
    return mpmath.log((1 + e) / (1 - e)) if abs(e) > 1e-20 else 2 * e


def exact_curvature(e):
    """phi''(e) = 4 (1 + e T) / (1 - e^2)^2, by differentiating phi = T^2 / 2 twice."""
    e = mpmath.mpf(e)
    return 4 * (1 + e * exact_t(e)) / (1 - e * e) ** 2


@given(e=INSIDE)
def test_transformation_and_its_slope(e):
    """T(e) = ln((1 + e) / (1 - e)), J_T = T' = 2 / (1 - e^2) > 0 (Section III-B); T is odd."""
    assert transformation(e) == pytest.approx(float(exact_t(e)), rel=4 * ULP, abs=0.0)
    assert transformation(-e) == -transformation(e)
    assert transformation_slope(e) == pytest.approx(float(2 / (1 - mpmath.mpf(e) ** 2)), rel=4 * ULP)
    assert transformation_slope(e) >= 2.0


@given(e=INSIDE)
def test_curvature_of_the_barrier_is_at_least_four(e):
    """phi''(e) = 4 (1 + e T) / (1 - e^2)^2 >= 4: the barrier is strictly convex, and stiff by 4 / rho^2 at least."""
    assert barrier_curvature(e) == pytest.approx(float(exact_curvature(e)), rel=16 * ULP)
    assert barrier_curvature(e) >= 4.0


@given(e=INSIDE)
def test_curvature_is_the_second_derivative(e):
    """phi'' of phi = T^2 / 2, by differences with 60 digits: the formula above isn't taken on trust either."""
    assert float(mpmath.diff(lambda s: exact_t(s) ** 2 / 2, e, 2, h=mpmath.mpf(1 - abs(e)) * mpmath.mpf("1e-15"))) == (
        pytest.approx(float(exact_curvature(e)), rel=1e-10)
    )


def test_barrier_is_self_concordant_up_to_a_constant():
    """|phi'''| <= 1.31 phi''^(3/2) on the whole interval: phi is self-concordant (Nesterov and Nemirovskii, 1994)."""
    e = np.concatenate([np.linspace(-0.999, 0.999, 20_001), 1 - np.geomspace(1e-15, 1e-3, 1000)])
    t, j = 2 * np.arctanh(e), 2 / ((1 - e) * (1 + e))
    second = j**2 * (1 + e * t)
    third = 2 * e * j**3 * (1 + e * t) + j**2 * t + e * j**3
    ratio = np.abs(third) / second**1.5
    assert ratio.max() <= 1.31
    assert ratio.max() > 1.2  # the constant is the right one


@given(eps=TRANSFORMED)
def test_barrier_in_the_transformed_unknown(eps):
    """e = tanh(eps / 2) inverts T, z = phi'(e) = T J_T = eps (1 + cosh eps), and d eps / dz is its reciprocal slope."""
    e, z, gain = barrier(eps)
    exact = mpmath.mpf(eps)
    assert e == pytest.approx(float(mpmath.tanh(exact / 2)), rel=6 * ULP, abs=0.0)
    assert z == pytest.approx(float(exact * (1 + mpmath.cosh(exact))), rel=16 * ULP, abs=0.0)
    slope = 1 / (1 + mpmath.cosh(exact) + exact * mpmath.sinh(exact))
    if abs(eps) < 340.0:  # a solve never gets there: z = 1e150
        assert gain == pytest.approx(float(slope), rel=16 * ULP)
    else:
        assert 0.0 <= gain <= 1e-140
    assert abs(e) <= 1.0


@given(eps=st.floats(-30.0, 30.0))
def test_impulse_and_curvature_agree(eps):
    """d z / d e = phi''(e), so that Newton's matrix diag(de / dz) + s M is the proximal problem's Hessian; de/dz <=
    1/4.
    """
    e, _, gain = barrier(eps)
    exact = mpmath.mpf(eps)
    slope_of_e = mpmath.mpf(gain) / (1 + mpmath.cosh(exact))  # de/dz = de/deps deps/dz
    assert float(1 / slope_of_e) == pytest.approx(float(exact_curvature(mpmath.tanh(exact / 2))), rel=1e-14)
    assert 0.0 < float(slope_of_e) <= 0.25 * (1 + 16 * ULP)
    assert -1.0 < e < 1.0


@given(exponent=st.floats(-290.0, 299.0), sign=st.sampled_from([-1.0, 1.0]))
def test_impulse_is_inverted_over_six_hundred_decades(exponent, sign):
    """eps_near_impulse solves z = eps (1 + cosh eps) for z from 1e-290 to 1e299, to a relative 7e-3 in eps."""
    z = sign * 10.0**exponent
    eps = eps_near_impulse(z)
    assert math.copysign(1.0, eps) == sign
    exact = mpmath.mpf(abs(eps))
    residual = exact * (1 + mpmath.cosh(exact)) / mpmath.mpf(abs(z)) - 1
    # d ln z = (1 + eps tanh(eps / 2)) d ln eps
    assert abs(mpmath.log1p(residual)) <= 7.5e-3 * (1 + exact * mpmath.tanh(exact / 2))


def test_no_impulse_is_no_disagreement():
    """T(0) = 0."""
    assert abs(eps_near_impulse(0.0)) < 1e-299
    assert barrier(0.0) == (0.0, 0.0, 0.5)


@given(
    sizes=st.tuples(st.integers(1, 3), st.integers(1, 9)),
    seed=st.integers(0, 2**32 - 1),
)
def test_correction_is_the_paper_s_formula(sizes, seed):
    """-rho^-1 J_T(e) eps with e = xi / rho (the last term of the PPSO's and the PPIO's equation), for all pairs at
    once.
    """
    n, batch = sizes
    rng = np.random.default_rng(seed)
    graph = nx.path_graph(6)
    layout = PairLayout.build(Links.of(graph), k_hop_neighbors(graph, 4), [n] * 6, np.arange(6) * n, relay=True)
    rho = np.exp(rng.normal(size=(layout.rows, batch)))
    expected_e = rng.uniform(-1, 1, (layout.size, batch))
    xi = expected_e * rho[layout.column_row]
    e, out = np.empty_like(xi), np.empty_like(xi)
    correction(layout.arrays, xi, rho, e, out)
    np.testing.assert_allclose(e, expected_e, rtol=1e-15, atol=1e-300)
    eps = np.log((1 + e) / (1 - e))
    np.testing.assert_allclose(out, -(2 / (1 - e**2)) * eps / rho[layout.column_row], rtol=1e-10, atol=1e-14)
