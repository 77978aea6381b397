"""The radius of certified boxes: r' = Lambda r + c from r(0), tabulated once and never rounded down."""

from __future__ import annotations

import math

import numpy as np

from khop_env.observers.layout import FloatArray
from khop_env.physics import Growth

FIRST = 2.0**-7  # s: the table's spacing doubles with the age from here on
OCTAVES = 23  # up to 65536 s; what is older is not bounded
KNOTS = 64  # of each octave
_LARGEST = 1e100
_UP = 1.0 + 1e-6  # rounding: about (n + 20) 2^OCTAVES 2^-53, which is 3e-8


class RadiusTable:
    """Solutions of r' = Lambda r + c with Lambda >= 0 off the diagonal and c, r(0) >= 0, by the matrix exponential.

    Between knots at t and t + h, with s of the way gone, r is the chord and at most s (1 - s) h^2 / 2 sup |r''| more,
    and |r''| <= exp(Lambda (t' - t)) exp(Lambda t) |r''(0)|, where the first factor is at most that of h with Lambda's
    diagonal clipped at 0. All numbers that are multiplied and added are positive, so that rounding stays relative. The
    result is raised by a millionth: many times that, and what `predict` may leave out of its error.

    The radius is the smaller of this and of r(0) + (spread + c) age.

    Args:
        growth: Lambda and spread.
        rate: (n,) c = g_bar + w_bar, inf where unbounded.
        start: (n,) r(0), inf where nothing is known.
    """

    def __init__(self, growth: Growth, rate: FloatArray, start: FloatArray) -> None:
        n = len(rate)
        self._start, self._slope = start, growth.spread + rate
        known = np.isfinite(rate) & np.isfinite(start)
        reach = np.linalg.matrix_power((growth.matrix != 0.0) | np.eye(n, dtype=bool), n) if n else np.eye(0)
        self._lost = np.asarray((reach.astype(bool) & ~known).any(axis=1))  # depends on something without bound
        c, start = np.where(known, rate, 0.0), np.where(known, start, 0.0)

        # r and |r''| in one system: z = [r, 1, y], z' = A z
        matrix = np.zeros((2 * n + 1, 2 * n + 1))
        matrix[:n, :n] = matrix[n + 1 :, n + 1 :] = growth.matrix
        matrix[:n, n] = c
        z = np.concatenate([start, [1.0], np.abs(growth.matrix @ (growth.matrix @ start + c))])
        rising = np.maximum(growth.matrix, 0.0)

        knots = KNOTS * (OCTAVES + 1)
        self._value, self._bulge = np.full((n, knots + 1), math.inf), np.full((n, knots), math.inf)
        h = FIRST / KNOTS
        step, rise = exponential(matrix, h), exponential(rising, h)
        with np.errstate(over="ignore"):
            for k in range(knots + 1):
                if not z.max(initial=0.0) < _LARGEST:
                    break
                self._value[:, k] = z[:n]
                if k == knots:
                    break
                if k >= 2 * KNOTS and k % KNOTS == 0:
                    h, step, rise = 2.0 * h, step @ step, rise @ rise
                    if not max(step.max(), rise.max()) < _LARGEST:
                        break
                self._bulge[:, k] = 0.5 * h * h * (rise @ z[n + 1 :])
                z = step @ z

    def at(self, age: FloatArray) -> FloatArray:
        """(n, ...) radii at ages (...), in s, not negative."""
        inside = age < FIRST * 2.0**OCTAVES
        firsts = np.where(inside, age, 0.0) / FIRST
        mantissa, exponent = np.frexp(np.maximum(firsts, 1.0))
        octave = np.where(firsts < 1.0, 0, exponent)  # 1 for [1, 2), 2 for [2, 4), ... times FIRST
        place = np.where(firsts < 1.0, firsts, 2.0 * mantissa - 1.0) * KNOTS
        s = place - np.floor(place)
        k = place.astype(np.intp) + KNOTS * octave
        columns = (slice(None), *[None] * np.ndim(age))
        with np.errstate(invalid="ignore"):
            table = (1.0 - s) * self._value[:, k] + s * self._value[:, k + 1] + s * (1.0 - s) * self._bulge[:, k]
            line = self._start[columns] + np.where(np.asarray(age) > 0.0, self._slope[columns] * age, 0.0)
        unknown = self._lost[columns] | ~inside | np.isnan(table)
        return np.minimum(np.where(unknown, math.inf, table), np.where(np.isnan(line), math.inf, line)) * _UP


def exponential(matrix: FloatArray, t: float) -> FloatArray:
    """exp(matrix t) of a matrix that isn't negative off the diagonal, every entry to a small relative error.

    exp(A t) = exp(-m t) exp((A + m I) t), where A + m I has no negative entry: Taylor's series of a short time, then
    squarings, add positive numbers only.
    """
    n = len(matrix)
    lift = max(0.0, -float(np.diag(matrix).min(initial=0.0)))
    positive = matrix + lift * np.eye(n)
    squarings = max(0, math.ceil(math.log2(max(2.0 * t * float(positive.sum(axis=1).max(initial=0.0)), 1.0))))
    short = t / 2.0**squarings
    term = total = np.eye(n)
    for order in range(1, 20):
        term = term @ positive * (short / order)
        total = total + term
    total = total * math.exp(-lift * short)
    with np.errstate(over="ignore"):
        for _ in range(squarings):
            total = total @ total
    return total
