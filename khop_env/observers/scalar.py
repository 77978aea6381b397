"""The proximal step of one observer alone: one scalar equation for each component, with what it holds of others."""

from __future__ import annotations

import math

import numpy as np
from numpy.typing import NDArray

from khop_env.compiled import compiled, place
from khop_env.elementary import expm1
from khop_env.observers.barrier import barrier, eps_near_impulse
from khop_env.observers.layout import FloatArray, IntArray, PairArrays
from khop_env.observers.single import solve_in_single_precision

LANES = 64  # equations solved side by side
_FEW, _MANY = 8, 100  # iterations from a start; between bounds, where bisection alone would take 60
_SMALL = 1e-5  # in eps: the error after such a step of Halley's method is its cube
_EXACT = 4e-16
_LONGEST = 4.0
_LARGEST = 60.0  # eps that single precision can still find


@compiled
def solve_alone(
    pairs: PairArrays,
    start: IntArray,
    offset: IntArray,
    tau: float,
    held: FloatArray,
    rho: FloatArray,
    due: NDArray[np.bool_],
    eps: FloatArray,
    estimate: FloatArray,
    normalized: FloatArray,
    low: int,
    high: int,
) -> None:
    """Solve y - y* + tau z / rho = 0, z = phi'(e), e = (d y - sum of what is held) / rho, for every pair.

    In z it is e(z) + s d z = b with s = tau / rho^2 and b = (d y* - sum) / rho: increasing, so that it has one root.

    Args:
        pairs: `PairLayout.packed`.
        start: (pairs + 1,) where each pair's sources begin, d of them.
        offset: (pairs,) place of its first value in `held`: source by source, component by component.
        tau: period in s.
        held: (C, B) what was received last.
        rho: (rows, B) the funnels.
        due: (B,) environments in which to solve; the others keep every bit.
        eps: (P, B) T(e); a start on entry, used where single precision overflows; the new one on return.
        estimate: (P, B) y* on entry, y on return.
        normalized: (P, B) e, written.
        low: first environment.
        high: one past the last.
    """
    pairs = PairArrays(*pairs)
    lanes = np.empty((10, LANES))
    target, weight, inverse, total = lanes[0], lanes[1], lanes[2], lanes[3]
    u, active, answer = lanes[4], lanes[5], lanes[6]
    steps, slope, at_u = lanes[7], lanes[8], lanes[9]
    single = np.empty((3, LANES), np.float32)
    columns, rows, sources = np.empty(LANES, np.int64), np.empty(LANES, np.int64), np.empty(LANES, np.int64)
    last = 0
    for i in range(pairs.observers.size):
        last += pairs.observers[i] * pairs.components[i]
    for first in range(low, high, LANES):
        width = min(LANES, high - first)
        waiting = 0
        for e in range(width):
            waiting += due[place(first + e)]
        if waiting == 0:
            continue
        beside = LANES // width  # equations of few environments are solved side by side
        filled = done = 0
        for i in range(pairs.observers.size):
            n = pairs.components[i]
            for a in range(pairs.observers[i]):
                pair = pairs.pair[i] + a
                count = start[pair + 1] - start[pair]
                d = float(count)
                for c in range(n):
                    column, row, origin = pairs.column[i] + a * n + c, pairs.row[i] + c, filled * width
                    for e in range(width):
                        total[place(origin + e)] = 0.0
                    for k in range(count):
                        source = offset[pair] + k * n + c
                        for e in range(width):
                            total[place(origin + e)] += held[source, place(first + e)]
                    for e in range(width):
                        lane, at = place(origin + e), place(first + e)
                        inverse[lane] = 1.0 / rho[row, at]
                        target[lane] = (d * estimate[column, at] - total[lane]) * inverse[lane]
                        weight[lane] = d * tau * inverse[lane] * inverse[lane]
                        u[lane] = eps[column, at]
                    columns[filled], rows[filled], sources[filled] = column, row, count
                    filled += 1
                    done += 1
                    if filled < beside and done < last:
                        continue
                    _start(filled * width, target, weight, u, single)
                    _solve_lanes(filled * width, target, weight, u, active, steps, slope, at_u, answer)
                    for f in range(filled):
                        column_f, row_f, d_f = columns[f], rows[f], float(sources[f])
                        for e in range(width):
                            lane, at = place(f * width + e), place(first + e)
                            if due[at]:
                                eps[column_f, at] = u[lane]
                                normalized[column_f, at] = answer[lane]
                                # from e, not from z: no digits are lost in stiff equations
                                estimate[column_f, at] = (total[lane] + rho[row_f, at] * answer[lane]) / d_f
                    filled = 0


@compiled
def _start(width: int, target: FloatArray, weight: FloatArray, u: FloatArray, single: NDArray[np.float32]) -> None:
    """Replace warm starts by solutions in single precision; where that overflows, they stay."""
    b, w, found = single[0], single[1], single[2]
    for lane in range(width):
        b[lane], w[lane] = target[lane], weight[lane]
    solve_in_single_precision(width, b, w, found)
    for lane in range(width):
        start = np.float64(found[lane])
        u[lane] = start if abs(start) < _LARGEST else u[lane]


@compiled
def _solve_lanes(
    width: int,
    target: FloatArray,
    weight: FloatArray,
    u: FloatArray,
    active: FloatArray,
    steps: FloatArray,
    slope: FloatArray,
    normalized: FloatArray,
    answer: FloatArray,
) -> None:
    """Halley's method in eps from starts `u`; where it isn't quick, anew between bounds. Writes u and e.

    With q = de/deps = (1 - e^2) / 2 and z = eps / q, the excess F = e + s d z - b and its derivatives, times q, are

        A = q (e - b) + s d eps,   B = q^2 + s d (1 + eps e),   C = s d (2 e + eps (q + e^2)) - q^2 e.
    """
    for lane in range(width):
        active[lane] = 1.0
    for _ in range(_FEW):
        for lane in range(width):  # arithmetic alone, which runs in vector registers
            eps, sd = u[lane], weight[lane]
            size = abs(eps)
            growth = expm1(size)
            half = 1.0 / (growth + 2.0)
            e = math.copysign(growth * half, eps)
            q = 2.0 * (growth + 1.0) * half * half
            excess = q * (e - target[lane]) + sd * eps
            first = q * q + sd * (1.0 + eps * e)
            second = sd * (2.0 * e + eps * (q + e * e)) - q * q * e
            steps[lane] = 2.0 * excess * first / (2.0 * first * first - excess * second)
            slope[lane], normalized[lane] = q, e
        moving = 0.0
        for lane in range(width):
            step = steps[lane]
            # far away the exponential is nothing like a parabola, and 700 is its end
            step = step if step < _LONGEST else _LONGEST
            step = step if step > -_LONGEST else -_LONGEST
            # a lane that has converged stays: its result mustn't depend on the others
            on = active[lane]
            u[lane] -= on * step
            e, q = normalized[lane], slope[lane]
            answer[lane] = e - q * step * (1.0 + 0.5 * e * step) if on > 0.0 else answer[lane]
            active[lane] = on if abs(step) > _SMALL else 0.0
            moving += active[lane]
        if moving == 0.0:
            break
    for lane in range(width):
        if not abs(answer[lane]) < 1.0:
            active[lane] = 1.0  # not a number: that is found between bounds, or stays
    for lane in range(width):
        if active[lane] > 0.0:
            u[lane], answer[lane] = _between_bounds(target[lane], weight[lane])


@compiled
def _between_bounds(target: float, weight: float) -> tuple[float, float]:
    """(eps, e) of one equation; the root lies between the impulses (|b| - 1) / (s d) and |b| / (s d)."""
    b = abs(target)
    high = eps_near_impulse(b / weight) * 1.01
    if b < 1.0:
        high = min(high, math.log((1.0 + b) / (1.0 - b)) * 1.01)
    low = eps_near_impulse(max(b - 1.0, 0.0) / weight) * 0.99
    u = high
    for _ in range(_MANY):
        e, z, gain = barrier(u)
        excess = e + weight * z - b
        if excess > 0.0:
            high = u
        else:
            low = u
        following = u - excess / (0.5 * (1.0 - e * e) + weight / gain)
        if not low <= following <= high:
            following = 0.5 * (low + high)
        if abs(following - u) <= _EXACT * (1.0 + u):
            break
        u = following
    return math.copysign(u, target), math.copysign(e, target)
