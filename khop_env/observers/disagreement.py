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
    """phi''(e) of the barrier phi = T^2 / 2; the correction's stiffness is phi''(e) / rho^2, at least 4 / rho^2."""
    slope = transformation_slope(e)
    return slope * slope * (1.0 + e * transformation(e))


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
    batch = estimate.shape[1]
    for t in range(plan.shape[0]):
        eta, n, offset, origin, pair = plan[t, 0], plan[t, 1], plan[t, 2], plan[t, 3], plan[t, 5]
        for a in range(eta):
            d, h = diagonal[pair + a], relay[pair + a]
            for c in range(n):
                column = offset + a * n + c
                if h == 0.0:  # nobody tells it: the state must not even be read
                    for env in range(batch):
                        out[column, env] = d * estimate[column, env]
                else:
                    for env in range(batch):
                        out[column, env] = d * estimate[column, env] - h * source[origin + c, env]
                for k in range(link_start[pair + a], link_start[pair + a + 1]):
                    other = offset + link[k] * n + c
                    for env in range(batch):
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
    batch = xi.shape[1]
    scale = np.empty(batch)
    for t in range(plan.shape[0]):
        eta, n, offset, row = plan[t, 0], plan[t, 1], plan[t, 2], plan[t, 4]
        for c in range(n):
            for env in range(batch):
                scale[env] = 1.0 / rho[row + c, env]
            for a in range(eta):
                column = offset + a * n + c
                for env in range(batch):
                    normalized = xi[column, env] * scale[env]
                    e[column, env] = normalized
                    rate = -transformation_slope(normalized) * transformation(normalized)
                    out[column, env] = rate * scale[env]


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
    diagonal: FloatArray,
    relay: FloatArray,
    link_start: IntArray,
    link: IntArray,
    estimate: FloatArray,
    source: FloatArray,
    rho: FloatArray,
    gain: FloatArray,
    out: FloatArray,
) -> None:
    """Raise `out` (2, B) to the largest |xi| / rho and |x_tilde| / delta over all pairs and components.

    Args:
        plan: and `diagonal`, `relay`, `link_start`, `link`: `PairLayout.arrays`.
        diagonal: see there.
        relay: see there.
        link_start: see there.
        link: see there.
        estimate: (P, B) estimates.
        source: (n, B) the truth.
        rho: (rows, B) funnels.
        gain: (rows,) the design rule's rho / delta.
        out: running maxima; inf where a number isn't finite.
    """
    batch = estimate.shape[1]
    xi = np.empty(batch)
    for t in range(plan.shape[0]):
        eta, n, offset, origin, row, pair = plan[t, 0], plan[t, 1], plan[t, 2], plan[t, 3], plan[t, 4], plan[t, 5]
        for a in range(eta):
            d, h = diagonal[pair + a], relay[pair + a]
            for c in range(n):
                column = offset + a * n + c
                for env in range(batch):
                    xi[env] = d * estimate[column, env] - h * source[origin + c, env]
                for k in range(link_start[pair + a], link_start[pair + a + 1]):
                    other = offset + link[k] * n + c
                    for env in range(batch):
                        xi[env] -= estimate[other, env]
                factor = gain[row + c]
                for env in range(batch):
                    scale = 1.0 / rho[row + c, env]
                    normalized = abs(xi[env]) * scale
                    relative = abs(estimate[column, env] - source[origin + c, env]) * scale * factor
                    normalized = normalized if normalized < np.inf else np.inf  # a NaN must not look fine
                    out[0, env] = max(out[0, env], normalized)
                    out[1, env] = max(out[1, env], relative)
