"""The proximal step: the barrier treated implicitly, so that the funnel is kept at any step size.

For one target and component the step solves, for the observers' estimates y,

    y = y* - tau P^-1 phi'(e),    e = P^-1 xi,    xi = M y - h x_i,    phi = T^2 / 2,

with everything at the end of the step: the optimality condition of a strictly convex problem that is finite only
inside the open funnel, so there is exactly one solution for every tau > 0, every predictor y* and every jump of x_i,
and it satisfies |e| < 1 (docs/theory/step.md; proximal point of a self-concordant barrier; Y. Nesterov and A.
Nemirovskii, 1994).

Written in the impulse z = phi'(e) and with b = P^-1 (M y* - h x_i), s = tau / rho^2, it reads

    e(z) + s M z = b,

where e(z) is increasing and bounded with slope in (0, 1/4]. Newton's matrix diag(de/dz) + s M is symmetric positive
definite with M's sparsity, and never singular. Where links go one way M isn't symmetric, but a row-wise diagonally
dominant M-matrix: there is still exactly one solution (docs/theory/graphs.md), and Newton's matrix is factorised by LU,
which needs no pivoting; likewise where links come and go, and M differs between environments. The unknown that is
carried is eps = T(e): any real number, so no step can leave the funnel, and no digits are lost at its wall.

A last step is linear in z, and e(z) + s M z = b then holds to rounding however small the step was: the disagreement
of the returned estimates is rho e, whatever the tolerance.
"""

from __future__ import annotations

import numpy as np

from khop_env.compiled import compiled, place
from khop_env.observers.barrier import LONG_STEP, barriers, land, start_anew, start_anew_weighted
from khop_env.observers.layout import FloatArray, PairArrays
from khop_env.observers.newton import newton_step, newton_step_one_way
from khop_env.observers.weights import Weights

TOLERANCE = 1e-5  # on eps; Newton's error is its square, far below any step's own
MAX_ITERATIONS = 200
DAMPED = 32  # after so many steps come as many halved ones: they end the cycles of a few problems in a million
LANES = 256  # scalar problems solved side by side: enough to fill vector registers, few enough to stay in cache


@compiled
def solve(
    pairs: PairArrays,
    tau: float,
    predictor: FloatArray,
    source: FloatArray,
    rho: FloatArray,
    eps: FloatArray,
    estimate: FloatArray,
    slope: FloatArray,
    batch: tuple[int, int],
    targets: tuple[int, int],
    weights: Weights | None = None,
) -> tuple[int, int, int]:
    """One proximal step of the observers of a range of targets, in a range of environments.

    Args:
        pairs: `PairLayout.packed`.
        tau: step of the implicit part, in seconds.
        predictor: (P, B) y*, the estimates after the explicit part of the step.
        source: (n, B) the fleet's vector that is observed (states x, or input maps g) at the end of the step.
        rho: (rows, B) the funnels at the end of the step.
        eps: (P, B) transformed disagreement; the last one on entry (anything within +-100 will do), the new one
            on return.
        estimate: (P, B) the new estimates, written; may be `predictor`.
        slope: (P, B) the correction -P^-1 J eps at the end of the step, written.
        batch: first environment and one past the last.
        targets: first target of the layout and one past the last.
        weights: `WeightsNow.of`, of a layout built for changing links; None for all links up.

    Returns:
        Evaluations of the barrier (one per pair, component and Newton iteration), then the environment and the target
        (its place in the layout) where the solve failed, -1 and -1 if it didn't. It fails on input that isn't finite,
        and on nothing else in three hundred thousand random problems up to a million funnel widths away (at most 28
        iterations, 5 on average; two along a run), nor in 1.2 million with random links down (30; 65 in 6 of them).
    """
    pairs = PairArrays(*pairs)
    one_way = pairs.last.size > 0  # or changing: where M needn't be symmetric
    widest = profile = most = most_entries = 1
    for t in range(targets[0], targets[1]):
        eta, n, pair = pairs.observers[t], pairs.components[t], pairs.pair[t]
        entries = 0
        for a in range(eta):
            entries += a - pairs.first[pair + a]
        widest, profile = max(widest, eta), max(profile, eta * eta if one_way else entries)
        most_entries = max(most_entries, pairs.entry_start[pair + eta] - pairs.entry_start[pair])
        most = max(most, n * min(max(1, LANES // n), batch[1] - batch[0]))
    diagonal, relay, first = pairs.diagonal, pairs.relay, pairs.first
    entry_start, entry_of = pairs.entry_start, pairs.entry
    memory = np.empty((9, widest, most))  # one allocation: such overheads dominate the solve of one environment
    b, e, z, gain, dz = memory[0], memory[1], memory[2], memory[3], memory[4]
    pivot, entry, u, answer = memory[5], memory[6], memory[7], memory[8]
    flat = memory.reshape(9, widest * most)
    flat_e, flat_z, flat_gain, flat_u = flat[1], flat[2], flat[3], flat[7]
    lower = np.empty((profile, most))
    row_start = np.empty(widest, np.int64)
    of_lanes = np.empty((6, most))
    inv_rho, scale, active, worst, poison = of_lanes[0], of_lanes[1], of_lanes[2], of_lanes[3], of_lanes[4]
    of_links = np.empty((0 if weights is None else 2 * widest + most_entries, most))
    d_lanes, h_lanes, w_lanes = of_links[:widest], of_links[widest : 2 * widest], of_links[2 * widest :]
    evaluations = 0

    for t in range(targets[0], targets[1]):
        eta, n, pair = pairs.observers[t], pairs.components[t], pairs.pair[t]
        offset, origin, row = pairs.column[t], pairs.source[t], pairs.row[t]
        entries = 0
        for a in range(eta):
            row_start[a] = entries - first[pair + a]
            entries += a - first[pair + a]
        chunk = max(1, LANES // n)
        for c0 in range(batch[0], batch[1], chunk):
            width = min(chunk, batch[1] - c0)
            lanes = n * width  # a lane is one component in one environment
            for c in range(n):
                for env in range(width):
                    lane = place(c * width + env)
                    inverse = 1.0 / rho[row + c, place(c0 + env)]
                    inv_rho[lane] = inverse
                    scale[lane] = tau * inverse * inverse
                    worst[lane] = source[origin + c, place(c0 + env)]
            for a in range(eta):
                for c in range(n):
                    column = offset + a * n + c
                    for env in range(width):
                        answer[a, place(c * width + env)] = predictor[column, place(c0 + env)]
                        u[a, place(c * width + env)] = eps[column, place(c0 + env)]
            if weights is not None:
                diagonal_now, relay_now, entry_now = weights
                origin_of_entries = entry_start[pair]
                for c in range(n):
                    for env in range(width):
                        lane, at = place(c * width + env), place(c0 + env)
                        for a in range(eta):
                            d_lanes[a, lane], h_lanes[a, lane] = diagonal_now[pair + a, at], relay_now[pair + a, at]
                        for k in range(entry_start[pair + eta] - origin_of_entries):
                            w_lanes[k, lane] = entry_now[origin_of_entries + k, at]
            for a in range(eta):
                if weights is not None:
                    for lane in range(lanes):
                        b[a, lane] = d_lanes[a, lane] * answer[a, lane] - h_lanes[a, lane] * worst[lane]
                    for k in range(entry_start[pair + a], entry_start[pair + a + 1]):
                        other, from_it = entry_of[k], place(k - entry_start[pair])
                        for lane in range(lanes):
                            b[a, lane] -= w_lanes[from_it, lane] * answer[other, lane]
                else:
                    d, h = diagonal[pair + a], relay[pair + a]
                    for lane in range(lanes):
                        b[a, lane] = d * answer[a, lane] - h * worst[lane]
                    for k in range(entry_start[pair + a], entry_start[pair + a + 1]):
                        other = entry_of[k]
                        for lane in range(lanes):
                            b[a, lane] -= answer[other, lane]
                for lane in range(lanes):
                    b[a, lane] *= inv_rho[lane]
            for lane in range(lanes):
                active[lane] = 1.0

            iteration = 0
            moving = True
            while moving:
                barriers(eta, lanes, most, flat_u, flat_e, flat_z, flat_gain)
                if iteration == 0:
                    if weights is not None:
                        anew = start_anew_weighted(
                            eta, lanes, h_lanes, scale, b, e, z, gain, u, pivot, worst, poison, of_lanes[5]
                        )
                    else:
                        anew = start_anew(eta, pair, lanes, relay, scale, b, e, z, gain, u, pivot, worst, poison)
                    if anew:
                        barriers(eta, lanes, most, flat_u, flat_e, flat_z, flat_gain)
                if one_way:
                    newton_step_one_way(
                        eta,
                        pair,
                        lanes,
                        diagonal,
                        entry_start,
                        entry_of,
                        first,
                        pairs.last,
                        scale,
                        b,
                        e,
                        z,
                        gain,
                        dz,
                        pivot,
                        entry,
                        lower,
                        None if weights is None else d_lanes,
                        None if weights is None else w_lanes,
                    )
                else:
                    newton_step(
                        eta,
                        pair,
                        lanes,
                        diagonal,
                        entry_start,
                        entry_of,
                        first,
                        scale,
                        b,
                        e,
                        z,
                        gain,
                        dz,
                        pivot,
                        entry,
                        lower,
                        row_start,
                    )
                evaluations += eta * lanes
                iteration += 1
                damped = iteration % (2 * DAMPED) >= DAMPED
                if damped:
                    for a in range(eta):
                        for lane in range(lanes):
                            dz[a, lane] *= 0.5
                for lane in range(lanes):
                    worst[lane] = 0.0
                    poison[lane] = 0.0
                # a lane that has converged doesn't move again, or its result would depend on the other lanes
                for a in range(eta):
                    for lane in range(lanes):
                        on = active[lane] > 0.0
                        step = dz[a, lane] * gain[a, lane] if on else 0.0
                        worst[lane] = max(abs(step), worst[lane])
                        poison[lane] += 0.0 * step  # 0, or NaN once and for all, which a maximum may lose
                        answer[a, lane] = z[a, lane] + dz[a, lane] if on else answer[a, lane]
                        u[a, lane] += step
                moving = False
                longest = 0.0
                for lane in range(lanes):
                    on = not worst[lane] + poison[lane] <= TOLERANCE  # so that a NaN goes on, to be reported
                    active[lane] = 1.0 if on else 0.0
                    moving = moving or on
                    longest = max(longest, worst[lane])
                if damped:
                    for lane in range(lanes):
                        if worst[lane] > 0.0:  # it moved by half a step, so that it isn't there
                            active[lane], moving = 1.0, True
                if longest > LONG_STEP:
                    land(eta, lanes, active, u, z, gain, dz, answer)
                if moving and iteration == MAX_ITERATIONS:
                    for lane in range(lanes):
                        if active[lane] > 0.0:
                            return evaluations, c0 + lane % width, t
            for a in range(eta):
                for c in range(n):
                    column = offset + a * n + c
                    for env in range(width):
                        lane, at = place(c * width + env), place(c0 + env)
                        correction = -answer[a, lane] * inv_rho[lane]
                        eps[column, at] = u[a, lane]
                        slope[column, at] = correction
                        estimate[column, at] = predictor[column, at] + tau * correction
    return evaluations, -1, -1
