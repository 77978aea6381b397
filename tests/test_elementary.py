"""The compiled elementary functions against NumPy's, in units of the last place."""

import functools

import numba
import numpy as np
import pytest

from khop_env import elementary


@functools.cache
def loop_over(function):
    @numba.njit(error_model="numpy")
    def loop(values, out):
        for i in range(values.size):
            out[i] = function(values[i])

    return loop


def evaluate(function, x):
    out = np.empty_like(x)
    loop_over(function)(x, out)
    return out


RNG = np.random.default_rng(0)
TINY = np.concatenate([sign * 10.0 ** RNG.uniform(-300, -3, 500) for sign in (1, -1)])
CASES = {
    "expm1": (
        elementary.expm1,
        np.expm1,
        np.concatenate([RNG.uniform(-600, 600, 20_000), RNG.uniform(-1, 1, 20_000), TINY]),
    ),
    "tanh": (
        elementary.tanh,
        np.tanh,
        np.concatenate([RNG.uniform(-30, 30, 20_000), RNG.uniform(-1, 1, 20_000), TINY, [0, 1e300]]),
    ),
    "log": (
        elementary.log,
        np.log,
        np.concatenate([10.0 ** RNG.uniform(-300, 300, 20_000), RNG.uniform(0.1, 10, 20_000), 1 + TINY, [1.0]]),
    ),
    "log_ratio": (
        elementary.log_ratio,
        lambda e: 2 * np.arctanh(e),
        np.concatenate([RNG.uniform(-1, 1, 40_000), TINY, 1 - 10.0 ** RNG.uniform(-15.9, 0, 5_000), [0.0]]),
    ),
}


@pytest.mark.parametrize("name", CASES)
def test_relative_error_is_a_few_units_in_the_last_place(name):
    ours, reference, x = CASES[name]
    expected = reference(x)
    assert np.all(np.abs(evaluate(ours, x) - expected) <= 1.2e-15 * np.abs(expected))


def test_sine_is_accurate_and_odd():
    x = np.concatenate([RNG.uniform(-1e4, 1e4, 40_000), RNG.uniform(-np.pi, np.pi, 40_000), TINY])
    values = evaluate(elementary.sin, x)
    assert np.max(np.abs(values - np.sin(x))) < 4e-16
    np.testing.assert_array_equal(values, -evaluate(elementary.sin, -x))


def test_cosine_is_accurate_and_even():
    x = np.concatenate([RNG.uniform(-1e4, 1e4, 40_000), RNG.uniform(-np.pi, np.pi, 40_000), TINY, [0.0]])
    values = evaluate(elementary.cos, x)
    assert np.max(np.abs(values - np.cos(x))) < 4e-16
    np.testing.assert_allclose(values, evaluate(elementary.cos, -x), rtol=0.0, atol=4e-16)


def test_result_does_not_depend_on_the_place_in_a_vector():
    """Vectorised bodies and scalar remainders must agree to the bit, or a batch would change a trajectory."""
    x = RNG.uniform(-0.999, 0.999, 61)
    for function in (
        elementary.expm1,
        elementary.log,
        elementary.tanh,
        elementary.sin,
        elementary.cos,
        elementary.log_ratio,
    ):
        values = np.abs(x) if function is elementary.log else x
        whole = evaluate(function, values)
        alone = np.array([evaluate(function, values[i : i + 1])[0] for i in range(x.size)])
        np.testing.assert_array_equal(whole, alone)
