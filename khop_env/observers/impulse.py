"""The proximal step of one observer and one component, in plain Python: a single equation in a single unknown."""

from __future__ import annotations

import math

_LARGEST = 700.0  # of eps: cosh overflows beyond 710


def impulse(b: float, stiffness: float) -> float:
    """Solve e(z) + s z = b for the impulse z = phi'(e), to rounding.

    The unknown is eps, with e = tanh(eps / 2) and z = eps (1 + cosh eps), in which the left side increases; Newton's
    method within a bracket, halved where a step would leave it. A last step is linear in z, so that no digits are lost
    where z is large (compare `khop_env.observers.solve`, which does many at once and on coupled observers).

    Args:
        b: disagreement of the predicted estimate, in widths of the funnel.
        stiffness: s, tau d / rho^2 with d terms in the disagreement; positive.

    Raises:
        ValueError: for numbers that aren't finite, or a stiffness that isn't positive.
    """
    if not (math.isfinite(b) and 0.0 < stiffness < math.inf):
        raise ValueError(
            f"expected a finite disagreement and a positive, finite stiffness; got {b!r} and {stiffness!r}"
        )
    target = abs(b)
    if target == 0.0:
        return b
    most = target / stiffness  # of z >= 2 eps, and z >= exp(eps) from eps = 2 on
    low, high = 0.0, min(0.5 * most, max(2.0, math.log(most)) if most > 0.0 else 2.0, _LARGEST)
    eps, last = high, math.inf
    while True:
        e, half = math.tanh(0.5 * eps), 1.0 + math.cosh(eps)
        z = eps * half
        excess = e + stiffness * z - target
        low, high = (low, eps) if excess > 0.0 else (eps, high)
        slope = half + eps * math.sinh(eps)  # dz / deps, while de / deps = 1 / half
        step = excess / (1.0 / half + stiffness * slope)
        if abs(step) <= 1e-9 * eps or high - low <= 1e-15 * high:
            break
        if not low < eps - step < high or abs(step) > 0.9 * last:  # bisect where Newton's method gains little
            step, last = eps - 0.5 * (low + high), math.inf
        else:
            last = abs(step)
        eps -= step
    z -= excess / (1.0 / (half * slope) + stiffness)
    return math.copysign(z, b)
