"""Branch-free exp, log, tanh, sin, cos and the paper's transformation T for compiled loops, and sums of arrays.

The C library's functions are calls, and a loop with calls can't be vectorised: tanh then costs 18 ns an element
instead of 2 ns here. Each function is plain arithmetic on one float64, pasted into its caller, and accurate to
a few units in the last place (tests/test_elementary.py). Results don't depend on the vector width.

The reductions are the classical ones (W. J. Cody and W. Waite, Software Manual for the Elementary Functions, 1980).
"""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from khop_env.compiled import compiled, inlined, place

LN2 = 0.6931471805599453
_LN2_HIGH = 0.693147180369123816490
_LN2_LOW = 1.90821492927058770002e-10
_LOG2_E = 1.4426950408889634
_INV_PI = 0.3183098861837907
# 30 bits of pi, then 30 more, then the rest: n * each is exact for |n| < 2**22, also for halves
_PI_HIGH = 3.141592651605606
_PI_MIDDLE = 1.9841871583270443e-09
_PI_LOW = 1.034036596358821e-18
_ROUND = 6755399441055744.0  # 1.5 * 2**52: adding it rounds to an integer, which then sits in the low bits
_ONE_BITS = 0x3FF0000000000000
_MANTISSA = 0x000FFFFFFFFFFFFF
_EXPONENT_AS_FLOAT = 0x4330000000000000  # 2**52: or-ing a small integer into it makes the float 2**52 + integer


@inlined
def expm1(x: float) -> float:
    """e**x - 1 for |x| < 700, without loss of digits near 0."""
    shifted = x * _LOG2_E + _ROUND
    n = shifted - _ROUND
    r = (x - n * _LN2_HIGH) - n * _LN2_LOW
    p = 1.0 / 6227020800.0
    p = p * r + 1.0 / 479001600.0
    p = p * r + 1.0 / 39916800.0
    p = p * r + 1.0 / 3628800.0
    p = p * r + 1.0 / 362880.0
    p = p * r + 1.0 / 40320.0
    p = p * r + 1.0 / 5040.0
    p = p * r + 1.0 / 720.0
    p = p * r + 1.0 / 120.0
    p = p * r + 1.0 / 24.0
    p = p * r + 1.0 / 6.0
    p = p * r + 0.5
    p = r + r * r * p
    power = np.int64((np.float64(shifted).view(np.int64) << 52) + _ONE_BITS).view(np.float64)
    return p * power + (power - 1.0)


@inlined
def log(x: float) -> float:
    """Natural logarithm of a normal positive float, to a few units in the last place of max(1, |log x|)."""
    bits = np.float64(x).view(np.int64)
    f = np.int64((bits & _MANTISSA) | _ONE_BITS).view(np.float64)
    exponent = np.int64((bits >> 52) | _EXPONENT_AS_FLOAT).view(np.float64) - 4503599627371519.0
    above = 1.0 if f > 1.4142135623730951 else 0.0
    f = f * (1.0 - 0.5 * above)
    s = (f - 1.0) / (f + 1.0)
    z = s * s
    p = 1.0 / 21.0
    p = p * z + 1.0 / 19.0
    p = p * z + 1.0 / 17.0
    p = p * z + 1.0 / 15.0
    p = p * z + 1.0 / 13.0
    p = p * z + 1.0 / 11.0
    p = p * z + 1.0 / 9.0
    p = p * z + 1.0 / 7.0
    p = p * z + 1.0 / 5.0
    p = p * z + 1.0 / 3.0
    return (exponent + above) * LN2 + 2.0 * (s + s * z * p)


@inlined
def tanh(x: float) -> float:
    """Hyperbolic tangent of any finite x."""
    growth = expm1(2.0 * min(abs(x), 20.0))
    return math.copysign(growth / (growth + 2.0), x)


@inlined
def sin(x: float) -> float:
    """Sine; the error grows with |x| and is about 1e-16 |x| beyond |x| = 1e5, where the spacing of floats matters."""
    shifted = x * _INV_PI + _ROUND
    n = shifted - _ROUND
    s = _small_sine(((x - n * _PI_HIGH) - n * _PI_MIDDLE) - n * _PI_LOW)
    odd = np.int64(np.float64(shifted).view(np.int64) << 63)
    return np.int64(np.float64(s).view(np.int64) ^ odd).view(np.float64)


@inlined
def cos(x: float) -> float:
    """Cosine, as the sine of the distance to the nearest odd multiple of pi / 2; as accurate as `sin`."""
    shifted = (x * _INV_PI - 0.5) + _ROUND
    n = (shifted - _ROUND) + 0.5
    s = -_small_sine(((x - n * _PI_HIGH) - n * _PI_MIDDLE) - n * _PI_LOW)
    odd = np.int64(np.float64(shifted).view(np.int64) << 63)
    return np.int64(np.float64(s).view(np.int64) ^ odd).view(np.float64)


@inlined
def _small_sine(r: float) -> float:
    """Sine of |r| <= pi / 2."""
    z = r * r
    p = -1.0 / 121645100408832000.0
    p = p * z + 1.0 / 355687428096000.0
    p = p * z - 1.0 / 1307674368000.0
    p = p * z + 1.0 / 6227020800.0
    p = p * z - 1.0 / 39916800.0
    p = p * z + 1.0 / 362880.0
    p = p * z - 1.0 / 5040.0
    p = p * z + 1.0 / 120.0
    p = p * z - 1.0 / 6.0
    return r + r * z * p


@inlined
def log_ratio(e: float) -> float:
    """ln((1 + e) / (1 - e)) = 2 artanh(e) for |e| < 1: the paper's T, without loss of digits near 0 or near |e| = 1.

    With 1 - |e| = f 2**-k the ratio is 2**k (1 + |e|) / f, and ln of the rest is 2 artanh(s), |s| < 0.172. At k = 0
    s is |e| itself, so that nothing is rounded away near 0.
    """
    a = abs(e)
    u = 1.0 + a
    bits = np.float64(1.0 - a).view(np.int64)
    f = np.int64((bits & _MANTISSA) | _ONE_BITS).view(np.float64)
    exponent = 4503599627371519.0 - np.int64((bits >> 52) | _EXPONENT_AS_FLOAT).view(np.float64)
    above = 1.0 if u > 1.4142135623730951 * f else 0.0
    below = 1.0 if u < 0.7071067811865476 * f else 0.0
    f = f * (1.0 + above) * (1.0 - 0.5 * below)
    k = exponent + above - below
    s = a if k == 0.0 else (u - f) / (u + f)
    z = s * s
    p = 1.0 / 21.0
    p = p * z + 1.0 / 19.0
    p = p * z + 1.0 / 17.0
    p = p * z + 1.0 / 15.0
    p = p * z + 1.0 / 13.0
    p = p * z + 1.0 / 11.0
    p = p * z + 1.0 / 9.0
    p = p * z + 1.0 / 7.0
    p = p * z + 1.0 / 5.0
    p = p * z + 1.0 / 3.0
    return math.copysign(k * LN2 + 2.0 * (s + s * z * p), e)


@compiled
def all_finite(values: NDArray[np.float64]) -> bool:
    """True if all values of a contiguous array are finite."""
    total = 0.0
    flat = values.ravel()
    for q in range(flat.size):
        total += 0.0 * flat[q]  # 0, or NaN once and for all
    return total == 0.0


@inlined
def combine(
    base: NDArray[np.float64],
    weights: NDArray[np.float64],
    count: int,
    terms: NDArray[np.float64],
    out: NDArray[np.float64],
    low: int,
    high: int,
) -> None:
    """Write base + sum of weights[k] terms[k], k below `count`, into the columns low to high - 1 of `out`."""
    copy_block(base, out, low, high)
    for k in range(count):
        weight, term = weights[k], terms[k]
        if high - low == out.shape[1]:
            flat, values = out.ravel(), term.ravel()
            for q in range(flat.size):
                flat[q] += weight * values[q]
        else:
            for row in range(out.shape[0]):
                for e in range(high - low):
                    out[row, place(low + e)] += weight * term[row, place(low + e)]


@inlined
def copy_block(values: NDArray[np.float64], out: NDArray[np.float64], low: int, high: int) -> None:
    """Copy the columns low to high - 1; all of them in one long loop."""
    if high - low == out.shape[1]:
        flat, source = out.ravel(), values.ravel()
        for q in range(flat.size):
            flat[q] = source[q]
    else:
        for row in range(out.shape[0]):
            for e in range(high - low):
                out[row, place(low + e)] = values[row, place(low + e)]


@inlined
def add_block(values: NDArray[np.float64], out: NDArray[np.float64], low: int, high: int) -> None:
    """Add the columns low to high - 1, likewise."""
    if high - low == out.shape[1]:
        flat, source = out.ravel(), values.ravel()
        for q in range(flat.size):
            flat[q] += source[q]
    else:
        for row in range(out.shape[0]):
            for e in range(high - low):
                out[row, place(low + e)] += values[row, place(low + e)]
