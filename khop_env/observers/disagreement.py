"""The observers' right-hand sides: disagreement, normalised and transformed, and the correction that it drives.

Both observers share them: the state observer (PPSO) compares estimates of x_i within funnels rho, the input observer
(PPIO) estimates of g_i(u_i) within funnels omega. Arrays are (columns, B), batch last, as compiled loops want them.
"""

from __future__ import annotations

import numpy as np

from khop_env.compiled import compiled, inlined
from khop_env.elementary import log_ratio
from khop_env.observers.layout import FloatArray, IntArray


@inlined
def transformation(e: float) -> float:
    """T(e) = ln((1 + e) / (1 - e)): (-1, 1) onto the reals, strictly increasing, T(0) = 0."""
    return log_ratio(e)


@inlined
def transformation_slope(e: float) -> float:
    """J_T(e) = 2 / (1 - e^2), the derivative of T."""
    return 2.0 / ((1.0 - e) * (1.0 + e))


@inlined
def barrier_curvature(e: float) -> float:
    """phi''(e) of the barrier phi = T^2 / 2; the stiffness of the correction is phi''(e) / rho^2, at least 4 / rho^2."""
    slope = transformation_slope(e)
    return slope * slope * (1.0 + e * log_ratio(e))


@compiled
def disagreement(
    plan: IntArray,
    diagonal: FloatArray,
    relay: FloatArray,
    link_start: IntArray,
    link: IntArray,
    estimate: FloatArray,
    source: FloatArray,
    out: FloatArray,
) -> None:
    """xi_i = M_i x_tilde_i for every target and component: the neighbour sums that define the disagreement.

    Args:
        plan: and `diagonal`, `relay`, `link_start`, `link`: `PairLayout.arrays`.
        diagonal: see there.
        relay: see there.
        link_start: see there.
        link: see there.
        estimate: (P, B) the observers' estimates.
        source: (n, B) the fleet's true vector, of which an observer uses what its neighbours relay.
        out: (P, B) xi, written.
    """
    for t in range(plan.shape[0]):
        eta, n, offset, origin, pair = plan[t, 0], plan[t, 1], plan[t, 2], plan[t, 3], plan[t, 5]
        for a in range(eta):
            d, h = diagonal[pair + a], relay[pair + a]
            for c in range(n):
                column = offset + a * n + c
                if h == 0.0:  # nobody tells it: the state must not even be read
                    for env in range(estimate.shape[1]):
                        out[column, env] = d * estimate[column, env]
                else:
                    for env in range(estimate.shape[1]):
                        out[column, env] = d * estimate[column, env] - h * source[origin + c, env]
            for k in range(link_start[pair + a], link_start[pair + a + 1]):
                for c in range(n):
                    column, other = offset + a * n + c, offset + link[k] * n + c
                    for env in range(estimate.shape[1]):
                        out[column, env] -= estimate[other, env]


@compiled
def correction(plan: IntArray, xi: FloatArray, rho: FloatArray, e: FloatArray, out: FloatArray) -> None:
    """The observers' correction -rho^-1 J_T(e) eps with e = xi / rho, eps = T(e).

    Args:
        plan: `PairLayout.plan`.
        xi: (P, B) disagreement.
        rho: (rows, B) funnels.
        e: (P, B) normalised disagreement, written.
        out: (P, B) correction, written; meaningless where |e| >= 1, which the caller has to refuse.
    """
    for t in range(plan.shape[0]):
        eta, n, offset, row = plan[t, 0], plan[t, 1], plan[t, 2], plan[t, 4]
        for column in range(eta * n):
            for env in range(xi.shape[1]):
                e[offset + column, env] = xi[offset + column, env] / rho[row + column % n, env]
    flat, flat_out = e.ravel(), out.ravel()
    for q in range(flat.size):
        flat_out[q] = -transformation_slope(flat[q]) * transformation(flat[q])
    for t in range(plan.shape[0]):
        eta, n, offset, row = plan[t, 0], plan[t, 1], plan[t, 2], plan[t, 4]
        for column in range(eta * n):
            for env in range(xi.shape[1]):
                out[offset + column, env] /= rho[row + column % n, env]


@compiled
def largest_curvature(plan: IntArray, e: FloatArray, rho: FloatArray, out: FloatArray) -> None:
    """Write into `out` (targets, B) the largest phi''(e) / rho^2 over each target's observers and components."""
    for t in range(plan.shape[0]):
        eta, n, offset, row = plan[t, 0], plan[t, 1], plan[t, 2], plan[t, 4]
        for env in range(e.shape[1]):
            largest = 0.0
            for column in range(eta * n):
                scale = rho[row + column % n, env]
                largest = max(largest, barrier_curvature(e[offset + column, env]) / (scale * scale))
            out[t, env] = largest


@compiled
def extremes(
    plan: IntArray,
    xi: FloatArray,
    rho: FloatArray,
    delta: FloatArray,
    estimate: FloatArray,
    source: FloatArray,
    normalized: FloatArray,
    relative: FloatArray,
) -> None:
    """Raise (B,) `normalized` to the largest |xi| / rho and (B,) `relative` to the largest |x_tilde| / delta."""
    for t in range(plan.shape[0]):
        eta, n, offset, origin, row = plan[t, 0], plan[t, 1], plan[t, 2], plan[t, 3], plan[t, 4]
        for column in range(eta * n):
            c = column % n
            for env in range(xi.shape[1]):
                normalized[env] = max(normalized[env], abs(xi[offset + column, env]) / rho[row + c, env])
                error = abs(estimate[offset + column, env] - source[origin + c, env])
                relative[env] = max(relative[env], error / delta[row + c, env])
    # max drops a NaN where it is the second argument; a trajectory that has one must not look fine
    for env in range(xi.shape[1]):
        for column in range(xi.shape[0]):
            if not np.isfinite(xi[column, env]):
                normalized[env] = np.inf
