"""The observers' right-hand sides: disagreement, normalised and transformed, and the correction that it drives.

Both observers share them: the state observer (PPSO) compares estimates of x_i within funnels rho, the input observer
(PPIO) estimates of g_i(u_i) within funnels omega. Arrays are (columns, B), batch last, as compiled loops want them.
"""

from __future__ import annotations

import numpy as np

from khop_env.compiled import compiled, inlined, place
from khop_env.elementary import log_ratio
from khop_env.observers.layout import FloatArray, PairArrays, PairLayout
from khop_env.observers.weights import Weights


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
def disagreement(pairs: PairArrays, estimate: FloatArray, source: FloatArray, out: FloatArray) -> None:
    """xi_i = M_i x_tilde_i for every target and component: the neighbour sums that define the disagreement.

    Args:
        pairs: `PairLayout.arrays`.
        estimate: (P, B) the observers' estimates.
        source: (n, B) the fleet's true vector; an observer uses only the parts that its neighbours relay.
        out: (P, B) xi, written.
    """
    batch = estimate.shape[1]
    for t in range(pairs.observers.size):
        eta, n, pair = pairs.observers[t], pairs.components[t], pairs.pair[t]
        offset, origin = pairs.column[t], pairs.source[t]
        for a in range(eta):
            d, h = pairs.diagonal[pair + a], pairs.relay[pair + a]
            for c in range(n):
                column = offset + a * n + c
                if h == 0.0:  # no neighbour relays the state to this observer, so it isn't read
                    for env in range(batch):
                        out[column, env] = d * estimate[column, env]
                else:
                    for env in range(batch):
                        out[column, env] = d * estimate[column, env] - h * source[origin + c, env]
                for k in range(pairs.entry_start[pair + a], pairs.entry_start[pair + a + 1]):
                    other = offset + pairs.entry[k] * n + c
                    for env in range(batch):
                        out[column, env] -= estimate[other, env]


@compiled
def weighted_disagreement(
    pairs: PairArrays, weights: Weights, estimate: FloatArray, source: FloatArray, out: FloatArray
) -> None:
    """`disagreement` for links that come and go, `WeightsNow.of`; 0 for observers that are cut off."""
    pairs = PairArrays(*pairs)
    diagonal, relay, entry = weights
    batch = estimate.shape[1]
    for t in range(pairs.observers.size):
        eta, n, pair = pairs.observers[t], pairs.components[t], pairs.pair[t]
        offset, origin = pairs.column[t], pairs.source[t]
        for a in range(eta):
            for c in range(n):
                column = offset + a * n + c
                for env in range(batch):
                    own = diagonal[pair + a, env] * estimate[column, env]
                    out[column, env] = own - relay[pair + a, env] * source[origin + c, env]
                for k in range(pairs.entry_start[pair + a], pairs.entry_start[pair + a + 1]):
                    other = offset + pairs.entry[k] * n + c
                    for env in range(batch):
                        out[column, env] -= entry[k, env] * estimate[other, env]


def disagreement_by(
    layout: PairLayout, weights: Weights | None, estimate: FloatArray, source: FloatArray, out: FloatArray
) -> None:
    """`disagreement` of a layout; `weighted_disagreement` where links come and go."""
    if weights is None:
        disagreement(layout.arrays, estimate, source, out)
    else:
        weighted_disagreement(layout.packed, weights, estimate, source, out)


@compiled
def correction(pairs: PairArrays, xi: FloatArray, rho: FloatArray, e: FloatArray, out: FloatArray) -> None:
    """The observers' correction -rho^-1 J_T(e) eps with e = xi / rho, eps = T(e).

    Args:
        pairs: `PairLayout.arrays`.
        xi: (P, B) disagreement.
        rho: (rows, B) funnels.
        e: (P, B) normalised disagreement, written.
        out: (P, B) correction, written; meaningless where |e| >= 1, which the caller has to refuse.
    """
    batch = xi.shape[1]
    scale = np.empty(batch)
    for t in range(pairs.observers.size):
        eta, n, offset, row = pairs.observers[t], pairs.components[t], pairs.column[t], pairs.row[t]
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
def largest_curvature(pairs: PairArrays, e: FloatArray, rho: FloatArray, out: FloatArray) -> None:
    """Write into `out` (targets, B) the largest phi''(e) / rho^2 over each target's observers and components."""
    for t in range(pairs.observers.size):
        eta, n, offset, row = pairs.observers[t], pairs.components[t], pairs.column[t], pairs.row[t]
        for env in range(e.shape[1]):
            largest = 0.0
            for column in range(eta * n):
                scale = rho[row + column % n, env]
                largest = max(largest, barrier_curvature(e[offset + column, env]) / (scale * scale))
            out[t, env] = largest


@compiled
def largest_ratios(
    pairs: PairArrays,
    estimate: FloatArray,
    source: FloatArray,
    rho: FloatArray,
    inverse_row_sums: FloatArray,
    normalized: FloatArray,
    relative: FloatArray,
    low: int,
    high: int,
) -> None:
    """Raise running maxima to the largest |xi| / rho and |x_tilde| / (M^-1 rho) over all pairs and components.

    Args:
        pairs: `PairLayout.packed`.
        estimate: (P, B) estimates.
        source: (n, B) the true values.
        rho: (rows, B) funnels.
        inverse_row_sums: (pairs,) [M_i^-1 1]_a.
        normalized: (B,) running maxima of |xi| / rho; inf where a number isn't finite.
        relative: (B,) running maxima of |x_tilde_a| / ([M_i^-1 1]_a rho_i).
        low: first environment.
        high: one past the last.
    """
    pairs = PairArrays(*pairs)
    width = high - low
    xi = np.empty(width)
    for t in range(pairs.observers.size):
        eta, n, pair = pairs.observers[t], pairs.components[t], pairs.pair[t]
        offset, origin, row = pairs.column[t], pairs.source[t], pairs.row[t]
        for a in range(eta):
            d, h = pairs.diagonal[pair + a], pairs.relay[pair + a]
            factor = 1.0 / inverse_row_sums[pair + a]
            for c in range(n):
                column = offset + a * n + c
                for e in range(width):
                    at = place(low + e)
                    xi[e] = d * estimate[column, at] - h * source[origin + c, at]
                for k in range(pairs.entry_start[pair + a], pairs.entry_start[pair + a + 1]):
                    other = offset + pairs.entry[k] * n + c
                    for e in range(width):
                        xi[e] -= estimate[other, place(low + e)]
                for e in range(width):
                    at = place(low + e)
                    scale = 1.0 / rho[row + c, at]
                    ratio = abs(xi[e]) * scale
                    error = abs(estimate[column, at] - source[origin + c, at]) * scale * factor
                    ratio = ratio if ratio < np.inf else np.inf  # a NaN must not pass as small
                    normalized[at] = max(normalized[at], ratio)
                    relative[at] = max(relative[at], error)


@compiled
def largest_weighted_ratios(
    pairs: PairArrays,
    weights: Weights,
    estimate: FloatArray,
    source: FloatArray,
    rho: FloatArray,
    inverse_row_sums: FloatArray,
    normalized: FloatArray,
    relative: FloatArray,
) -> None:
    """`largest_ratios` for links that come and go: `WeightsNow.of` and its (pairs, B) `inverse_row_sums`."""
    pairs = PairArrays(*pairs)
    xi = np.empty(estimate.shape)
    weighted_disagreement(pairs, weights, estimate, source, xi)
    for t in range(pairs.observers.size):
        eta, n, pair = pairs.observers[t], pairs.components[t], pairs.pair[t]
        offset, origin, row = pairs.column[t], pairs.source[t], pairs.row[t]
        for a in range(eta):
            for c in range(n):
                column = offset + a * n + c
                for env in range(estimate.shape[1]):
                    scale = 1.0 / rho[row + c, env]
                    ratio = abs(xi[column, env]) * scale
                    error = abs(estimate[column, env] - source[origin + c, env]) * scale
                    ratio = ratio if ratio < np.inf else np.inf  # a NaN must not pass as small
                    normalized[env] = max(normalized[env], ratio)
                    relative[env] = max(relative[env], error / inverse_row_sums[pair + a, env])
