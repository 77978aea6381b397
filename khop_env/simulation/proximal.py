"""The proximal step: the barrier treated implicitly, so that the funnel is kept at any step size.

For one target and component the step solves, for the observers' estimates y,

    y = y* - tau P^-1 phi'(e),    e = P^-1 xi,    xi = M y - h x_i,    phi = T^2 / 2,

with everything at the end of the step: the optimality condition of a strictly convex problem that is finite only
inside the open funnel, so there is exactly one solution for every tau > 0, every predictor y* and every jump of x_i,
and it satisfies |e| < 1 (proximal point of a self-concordant barrier; Y. Nesterov and A. Nemirovskii, 1994).

Written in the impulse z = phi'(e) and with b = P^-1 (M y* - h x_i), s = tau / rho^2, it reads

    e(z) + s M z = b,

where e(z) is increasing and bounded with slope in (0, 1/4]. Newton's matrix diag(de/dz) + s M is symmetric positive
definite with M's sparsity, and never singular. The unknown that is carried is eps = T(e): any real number, so no step
can leave the funnel, and no digits are lost at its wall.

A last step is linear in z, and e(z) + s M z = b then holds to rounding however small the step was: the disagreement
of the returned estimates is rho e, whatever the tolerance.
"""

from __future__ import annotations

import math
from typing import TYPE_CHECKING

import numpy as np

from khop_env.compiled import compiled, inlined
from khop_env.elementary import expm1

if TYPE_CHECKING:
    from khop_env.observers.layout import FloatArray, IntArray

TOLERANCE = 1e-5  # on eps; Newton's error is its square, far below any step's own
MAX_ITERATIONS = 200
LANES = 64  # scalar problems solved side by side: enough to fill vector registers, few enough to stay in cache
_LONG_STEP = 0.5  # in eps: beyond it exp is not nearly linear


@inlined
def _barrier(eps: float) -> tuple[float, float, float]:
    """e = tanh(eps / 2), z = phi'(e) = eps (1 + cosh eps), and d eps / dz, of which de/dz = de/deps d eps/dz."""
    a = abs(eps)
    growth = expm1(a)
    half = 1.0 / (growth + 2.0)
    e = growth * half
    q = 2.0 * (growth + 1.0) * half * half  # 1 / (1 + cosh eps) = (1 - e^2) / 2
    slope = 1.0 + a * e
    inverse = 1.0 / (q * slope)
    return math.copysign(e, eps), eps * (slope * inverse), q * q * inverse


@compiled
def eps_of_impulse(z: float) -> float:
    """Invert z = eps (1 + cosh eps), by Newton in logarithms (increasing and nearly straight, so a few steps do)."""
    target = abs(z)
    if target < 1e-8:
        return 0.5 * z
    a = min(0.5 * target, 1.0 + math.log1p(target))
    goal = math.log(target)
    for _ in range(50):
        value = math.log(a) + a + 2.0 * math.log1p(math.exp(-a)) - 0.6931471805599453 - goal
        step = value / (1.0 / a + math.tanh(0.5 * a))
        a = max(a - step, 0.25 * a)
        if abs(step) <= 1e-14 * a:
            break
    return math.copysign(a, z)


@compiled
def _newton_step(
    members: tuple[int, int, int],
    diagonal: FloatArray,
    link_start: IntArray,
    link: IntArray,
    first: IntArray,
    scale: FloatArray,
    work: FloatArray,
    lower: FloatArray,
    row_start: IntArray,
) -> None:
    """Solve (diag(de/dz) + s M) dz = b - e - s M z for all lanes, by L D L' in the profile of M (no square roots)."""
    eta, pair, lanes = members
    b, e, z, gain, dz, pivot, row = work[0], work[1], work[2], work[3], work[4], work[5], work[6]
    for a in range(eta):
        d, at, begin = diagonal[pair + a], a * lanes, first[pair + a]
        for q in range((a - begin) * lanes):
            row[q] = 0.0
        for lane in range(lanes):
            dz[at + lane] = d * z[at + lane]
        for k in range(link_start[pair + a], link_start[pair + a + 1]):
            other = link[k] * lanes
            for lane in range(lanes):
                dz[at + lane] -= z[other + lane]
            if link[k] < a:
                place = (link[k] - begin) * lanes
                for lane in range(lanes):
                    row[place + lane] = -scale[lane]
        for lane in range(lanes):
            s, q = scale[lane], e[at + lane]
            dz[at + lane] = b[at + lane] - q - s * dz[at + lane]
            pivot[at + lane] = 0.5 * (1.0 - q * q) * gain[at + lane] + s * d
        for j in range(begin, a):
            to = (j - begin) * lanes
            for k in range(max(begin, first[pair + j]), j):
                past, factor = (k - begin) * lanes, (row_start[j] + k) * lanes
                for lane in range(lanes):
                    row[to + lane] -= row[past + lane] * lower[factor + lane]
        for j in range(begin, a):
            to, past, factor = (j - begin) * lanes, j * lanes, (row_start[a] + j) * lanes
            for lane in range(lanes):
                entry = row[to + lane]
                multiplier = entry * pivot[past + lane]
                lower[factor + lane] = multiplier
                pivot[at + lane] -= entry * multiplier
                dz[at + lane] -= multiplier * dz[past + lane]
        for lane in range(lanes):
            pivot[at + lane] = 1.0 / pivot[at + lane]
    for q in range(eta * lanes):
        dz[q] *= pivot[q]
    for a in range(eta - 1, 0, -1):
        for j in range(first[pair + a], a):
            to, factor = j * lanes, (row_start[a] + j) * lanes
            for lane in range(lanes):
                dz[to + lane] -= lower[factor + lane] * dz[a * lanes + lane]


@compiled
def solve(
    plan: IntArray,
    diagonal: FloatArray,
    relay: FloatArray,
    link_start: IntArray,
    link: IntArray,
    first: IntArray,
    tau: float,
    predictor: FloatArray,
    source: FloatArray,
    rho: FloatArray,
    eps: FloatArray,
    estimate: FloatArray,
    slope: FloatArray,
    batch: tuple[int, int],
    targets: tuple[int, int],
) -> tuple[int, int, int]:
    """One proximal step of the observers of a range of targets, in a range of environments.

    Args:
        plan: and `diagonal`, `relay`, `link_start`, `link`, `first`: the arrays of a `PairLayout`.
        diagonal: see there.
        relay: see there.
        link_start: see there.
        link: see there.
        first: see there.
        tau: step of the implicit part, in seconds.
        predictor: (P, B) y*, the estimates after the explicit part of the step.
        source: (n, B) the fleet's vector that is observed (states x, or input maps g) at the end of the step.
        rho: (rows, B) the funnels at the end of the step.
        eps: (P, B) transformed disagreement; the last one on entry (any finite value will do), the new one on return.
        estimate: (P, B) the new estimates, written; may be `predictor`.
        slope: (P, B) the correction -P^-1 J eps at the end of the step, written.
        batch: first environment and one past the last.
        targets: first line of `plan` and one past the last.

    Returns:
        Evaluations of the barrier (one per pair, component and Newton iteration), then the environment and the line of
        `plan` where the solve failed, -1 and -1 if it didn't. It fails on input that isn't finite.
    """
    widest = profile = 1
    narrowest, most = LANES, LANES
    for t in range(targets[0], targets[1]):
        eta, n, pair = plan[t, 0], plan[t, 1], plan[t, 5]
        entries = 0
        for a in range(eta):
            entries += a - first[pair + a]
        widest, profile = max(widest, eta), max(profile, entries)
        narrowest, most = min(narrowest, n), max(most, n)
    work = np.empty((9, widest * most))
    b, e, z, gain, dz, u, answer = work[0], work[1], work[2], work[3], work[4], work[7], work[8]
    lower = np.empty(profile * most)
    row_start = np.empty(widest, np.int64)
    inv_rho, scale, worst, active = np.empty(most), np.empty(most), np.empty(most), np.empty(most)
    evaluations = 0

    tile = max(1, LANES // narrowest)
    for b0 in range(batch[0], batch[1], tile):
        for t in range(targets[0], targets[1]):
            eta, n, offset, origin, row, pair = plan[t, 0], plan[t, 1], plan[t, 2], plan[t, 3], plan[t, 4], plan[t, 5]
            chunk = max(1, most // n)
            for c0 in range(b0, min(b0 + tile, batch[1]), chunk):
                c1 = min(c0 + chunk, b0 + tile, batch[1])
                lanes = (c1 - c0) * n  # a lane is one component in one environment
                total = eta * lanes
                width = c1 - c0
                for c in range(n):
                    for env in range(width):
                        lane = c * width + env
                        r = 1.0 / rho[row + c, c0 + env]
                        inv_rho[lane] = r
                        scale[lane] = tau * r * r
                        worst[lane] = source[origin + c, c0 + env]
                        active[lane] = 1.0
                for column in range(eta * n):
                    for env in range(width):
                        answer[column * width + env] = predictor[offset + column, c0 + env]
                        u[column * width + env] = eps[offset + column, c0 + env]
                entries = 0
                for a in range(eta):
                    d, h, at = diagonal[pair + a], relay[pair + a], a * lanes
                    row_start[a] = entries - first[pair + a]
                    entries += a - first[pair + a]
                    for lane in range(lanes):
                        b[at + lane] = d * answer[at + lane] - h * worst[lane]
                    for k in range(link_start[pair + a], link_start[pair + a + 1]):
                        other = link[k] * lanes
                        for lane in range(lanes):
                            b[at + lane] -= answer[other + lane]
                    for lane in range(lanes):
                        b[at + lane] *= inv_rho[lane]

                iteration = 0
                moving = True
                while moving:
                    for q in range(total):
                        e[q], z[q], gain[q] = _barrier(u[q])
                    _newton_step((eta, pair, lanes), diagonal, link_start, link, first, scale, work, lower, row_start)
                    evaluations += total
                    iteration += 1
                    for lane in range(lanes):
                        worst[lane] = 0.0
                    for a in range(eta):
                        at = a * lanes
                        for lane in range(lanes):
                            worst[lane] = max(worst[lane], abs(dz[at + lane] * gain[at + lane]))
                    # a lane that is done must not move again, or its result would depend on its company
                    for a in range(eta):
                        at = a * lanes
                        for lane in range(lanes):
                            q = at + lane
                            on = active[lane] > 0.0
                            answer[q] = z[q] + dz[q] if on else answer[q]
                            u[q] = u[q] + dz[q] * gain[q] if on else u[q]
                    moving = False
                    longest = 0.0
                    for lane in range(lanes):
                        worst[lane] *= active[lane]
                        on = not worst[lane] <= TOLERANCE  # so that a NaN goes on, to be reported
                        active[lane] = 1.0 if on else 0.0
                        moving = moving or on
                        longest = max(longest, worst[lane])
                    if longest > _LONG_STEP:
                        for a in range(eta):
                            for lane in range(lanes):
                                q = a * lanes + lane
                                if active[lane] > 0.0 and abs(dz[q] * gain[q]) > _LONG_STEP:
                                    u[q] = eps_of_impulse(answer[q])
                    if moving and iteration == MAX_ITERATIONS:
                        for lane in range(lanes):
                            if active[lane] > 0.0:
                                return evaluations, c0 + lane % width, t
                for column in range(eta * n):
                    lane = column % n * width
                    for env in range(width):
                        q = column * width + env
                        correction = -answer[q] * inv_rho[lane + env]
                        eps[offset + column, c0 + env] = u[q]
                        slope[offset + column, c0 + env] = correction
                        estimate[offset + column, c0 + env] = predictor[offset + column, c0 + env] + tau * correction
    return evaluations, -1, -1
