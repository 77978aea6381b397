"""Definition 1 and Lemma 2: prescribed performance functions, and many of them evaluated together."""

from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from khop_env.observers import Exponential, FunnelBank, PerformanceFunction, lower_bound
from tests.strategies import SEEDS, exponentials

TIMES = np.linspace(0.0, 12.0, 241)


@dataclass(frozen=True)
class Breathing:
    """A user's own: C^1, positive, bounded, and not an exponential."""

    size: float = 1.0

    def __call__(self, t):
        return self.size * (1.5 + np.cos(t))

    def infimum(self):
        return 0.5 * self.size


@given(rho=exponentials())
def test_definition_1_and_the_paper_s_exponential(rho):
    """rho(t) = (rho(0) - rho(inf)) exp(-l t) + rho(inf): positive, bounded by rho(0), slope at most l rho(0)."""
    values = rho(TIMES)
    assert isinstance(rho, PerformanceFunction)
    assert values[0] == pytest.approx(rho.initial, rel=1e-15)
    np.testing.assert_allclose(values, (rho.initial - rho.final) * np.exp(-rho.rate * TIMES) + rho.final, rtol=1e-15)
    assert np.all(values >= rho.infimum() * (1 - 1e-15))
    assert rho.infimum() == rho.final > 0.0
    assert np.all(np.diff(values) <= 1e-15 * rho.initial)
    assert np.all(np.abs(np.diff(values)) <= rho.rate * rho.initial * np.diff(TIMES) + 1e-15 * rho.initial)
    assert rho(1e9) == pytest.approx(rho.final)


@pytest.mark.parametrize(
    "values",
    [(1.0, 2.0, 1.0), (1.0, 0.0, 1.0), (1.0, -1.0, 1.0), (1.0, 0.5, 0.0), (np.inf, 1.0, 1.0), (1.0, np.nan, 1.0)],
)
def test_what_is_no_performance_function_is_refused(values):
    """Definition 1-ii and l > 0."""
    with pytest.raises(ValueError, match="0 < final <= initial and rate > 0"):
        Exponential(*values)


@given(functions=st.lists(exponentials(), min_size=1, max_size=6), seed=SEEDS)
def test_lemma_2_the_norm_of_funnels_is_a_funnel(functions, seed):
    """Lemma 2: |rho(t)| is positive, bounded by the norm of the bounds, with |d/dt| at most the norm of the
    derivatives.
    """
    values = np.array([rho(TIMES) for rho in functions])
    norm = np.linalg.norm(values, axis=0)
    assert np.all(norm > 0.0)
    assert np.all(norm <= np.linalg.norm([rho.initial for rho in functions]) * (1 + 1e-14))
    slopes = np.array([-rho.rate * (rho.initial - rho.final) * np.exp(-rho.rate * TIMES) for rho in functions])
    rate = np.sum(values * slopes, axis=0) / norm
    assert np.all(np.abs(rate) <= np.linalg.norm(slopes, axis=0) * (1 + 1e-12) + 1e-300)


@given(functions=st.lists(exponentials(), min_size=1, max_size=6))
def test_one_exponential_below_several(functions):
    """Smallest coefficients and fastest rate make a C^1 lower bound of all bounds, as Problem 2 needs."""
    lowest = lower_bound(functions)
    for function in functions:
        assert np.all(lowest(TIMES) <= function(TIMES) * (1 + 1e-14))
    assert lower_bound(functions[:1])(TIMES) == pytest.approx(functions[0](TIMES), rel=1e-12)


@given(
    functions=st.lists(exponentials() | st.builds(Breathing, st.floats(0.1, 10.0)), max_size=8),
    t=st.lists(st.floats(0.0, 1e4), min_size=1, max_size=70),
)
def test_bank_equals_one_call_per_function(functions, t):
    """Compiled rows and users' rows agree with calling each function; equal rates next to each other share work."""
    functions = functions + functions[::-1]
    t = np.array(t)
    bank = FunnelBank(functions)
    out = bank.evaluate(t, np.full((len(functions), t.size), np.nan))
    assert len(bank) == len(functions) == len(bank.infimum())
    for row, function in enumerate(functions):
        np.testing.assert_allclose(out[row], function(t), rtol=1e-14, atol=1e-15 * function(0.0))
        assert bank.infimum()[row] == function.infimum()


@pytest.mark.parametrize("bad", [0.0, -1.0, np.nan, np.inf])
def test_a_user_s_function_that_breaks_definition_1_is_named(bad):
    """Values that are not positive and finite would make the funnel empty or the step meaningless."""

    class Broken:
        def __call__(self, t):
            return np.where(t > 1.0, bad, 1.0)

        def infimum(self):
            return 1.0

        def __repr__(self):
            return "Broken()"

    bank = FunnelBank([Exponential(1.0, 1.0, 1.0), Broken()])
    bank.evaluate(np.array([0.5, 1.0]), np.empty((2, 2)))
    with pytest.raises(ValueError, match=r"Broken\(\) gave .* Definition 1 requires positive, bounded values"):
        bank.evaluate(np.array([0.5, 1.5]), np.empty((2, 2)))
