"""How fast two solutions of a drift may part: what a model declares so that an old message is still a bound.

For p' = f(p) and x' = f(x) + g + w the distance obeys, component by component, |x - p|' <= Lambda |x - p| + |g| + |w|:
docs/theory/certificates.md.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, field

import numpy as np
from numpy.typing import NDArray

FloatArray = NDArray[np.float64]

_MULTIPLIERS = np.geomspace(1e-4, 1e5, 1000)[:, None]  # s


@dataclass(frozen=True, eq=False)
class Growth:
    """Bounds on a drift's Jacobian and values, over all times and all states within a region.

    Attributes:
        matrix: (n, n) Lambda in 1/s of the states' units: entry (j, j) is at least df_j/dx_j, which may be negative;
            entry (j, l) is at least |df_j/dx_l|.
        spread: (n,) largest |f_j(x) - f_j(p)| of any two states, in state units per second; inf by default.
        region: (n,) largest |x_j| for which all this holds; inf, the default, for all states. Where it is finite, f is
            taken to go on outside with the slope Lambda_jj along x_j, and with no slope along others (`extended`).
        step: 1 / 16 over the drift's largest rate |df_j/dx_l|, in s: the longest step in which a Runge-Kutta method of
            order 4 follows it well, and an eighth of the longest in which an Euler step is certified. The default inf
            is for drifts whose `drift_lipschitz` is finite, or that don't decay.

    Raises:
        ValueError: for a misshapen, negative or infinite entry where there may be none.
    """

    matrix: FloatArray
    spread: FloatArray = field(default_factory=lambda: np.array(math.inf))
    region: FloatArray = field(default_factory=lambda: np.array(math.inf))
    step: float = math.inf

    def __post_init__(self) -> None:
        matrix = np.array(self.matrix, np.float64)
        if matrix.ndim != 2 or matrix.shape[0] != matrix.shape[1] or not np.isfinite(matrix).all():
            raise ValueError(f"Growth.matrix must be a square matrix of finite numbers; got {self.matrix!r}")
        n = len(matrix)
        if (matrix[~np.eye(n, dtype=bool)] < 0.0).any():
            raise ValueError(
                f"Growth.matrix bounds |df_j/dx_l| off the diagonal, which is never negative; got {matrix.tolist()}"
            )
        for name, lowest in (("spread", "not negative"), ("region", "positive")):
            value = np.array(getattr(self, name), np.float64)
            if value.shape not in ((), (n,)) or not ((value >= 0.0) & ((value > 0.0) | (name == "spread"))).all():
                raise ValueError(
                    f"Growth.{name} must be a number or {n} numbers, {lowest}; got {getattr(self, name)!r}"
                )
            object.__setattr__(self, name, np.broadcast_to(value, n).copy())
        if not self.step > 0.0:
            raise ValueError(f"Growth.step must be positive, in s; got {self.step!r}")
        object.__setattr__(self, "matrix", matrix)

    def extended(self, drift: FloatArray, x: FloatArray, inside: FloatArray) -> FloatArray:
        """The drift at states `x` (..., n) from its values at the nearest states `inside` the region, (..., n)."""
        return drift + np.diag(self.matrix) * (x - inside)


def ship_growth(mass: FloatArray, linear: FloatArray, quadratic: FloatArray, region: FloatArray) -> Growth | None:
    """Growth of `SurfaceVessel`'s drift where |x| <= `region` (6,); None unless that bounds all three velocities.

    With |u| <= U, |v| <= V, |r| <= R the Jacobian's entries are, row by row:

        x', y'      by the heading |u| and |v| turned, at most S = sqrt(U^2 + V^2); by u and v at most 1
        heading'    by r 1
        u'          by u -(d1 + 2 q1 |u|) / m1 <= -d1 / m1;  by v m2 |r| / m1;  by r m2 |v| / m1
        v'          by v at most -d2 / m2;  by u m1 |r| / m2;  by r m1 |u| / m2
        r'          by r at most -d3 / m3;  by u |m1 - m2| |v| / m3;  by v |m1 - m2| |u| / m3

    Position rates are at most S and turn rates R, so that they differ by 2 S and 2 R at most. Velocities' rates have
    no such bound, because outside the region the drag goes on linearly.

    Args:
        mass: (3,) m.
        linear: (3,) d.
        quadratic: (3,) q.
        region: (6,) bounds on |x|.
    """
    U, V, R = region[3:]
    if not np.isfinite(region[3:]).all():
        return None
    m1, m2, m3 = mass
    speed, munk = math.hypot(U, V), abs(m1 - m2)
    matrix = np.zeros((6, 6))
    matrix[:2, 2:5] = speed, 1.0, 1.0
    matrix[2, 5] = 1.0
    matrix[3:, 3:] = [
        [-linear[0] / m1, m2 * R / m1, m2 * V / m1],
        [m1 * R / m2, -linear[1] / m2, m1 * U / m2],
        [munk * V / m3, munk * U / m3, -linear[2] / m3],
    ]
    rates = np.abs(matrix[3:, 3:]).sum(axis=1) + 2.0 * quadratic * region[3:] / mass
    spread = np.array([2.0 * speed, 2.0 * speed, 2.0 * R, math.inf, math.inf, math.inf])
    return Growth(matrix, spread, region, step=1.0 / 16.0 / max(float(rates.max()), 1e-9))


def energy_region(
    mass: FloatArray, linear: FloatArray, quadratic: FloatArray, force: FloatArray, speed: FloatArray
) -> FloatArray:
    """Bounds that velocities never leave when forces are limited and everything else only takes energy.

    The kinetic energy E = sum m v^2 / 2 changes by at most P = sum F |v| - d v^2 - q |v|^3. Wherever P >= 0, E is at
    most E + lambda P <= D(lambda) = sum over j of max over v of m v^2 / 2 + lambda (F v - d v^2 - q v^3), whatever
    lambda > 0. So E falls above the smallest D(lambda), and never exceeds that or its first value. (Weak duality;
    exact lambdas only make it tighter.)

    Args:
        mass: (k,) m of each velocity.
        linear: (k,) drag d.
        quadratic: (k,) drag q.
        force: (k,) largest force F, disturbances included.
        speed: (k,) largest velocity at the start.

    Returns:
        (k,) largest |v_j|, inf if drag can't hold the forces.
    """
    slope, a, b = _MULTIPLIERS * force, 3.0 * _MULTIPLIERS * quadratic, 2.0 * _MULTIPLIERS * linear - mass
    with np.errstate(divide="ignore", invalid="ignore", over="ignore"):
        # The largest value is where slope - b v - a v^2 = 0; this form of the root loses no digits for b > 0.
        root = np.sqrt(b * b + 4.0 * a * slope)
        v = np.where(b > 0.0, 2.0 * slope / (b + root), (root - b) / (2.0 * a))
        terms = 0.5 * mass * v**2 + _MULTIPLIERS * (force * v - linear * v**2 - quadratic * v**3)
    energy = np.where(np.isfinite(terms), terms, math.inf).sum(axis=1).min()
    energy = max(float(energy), 0.5 * float((mass * speed**2).sum()))
    return np.sqrt(2.0 * energy / mass) * (1.0 + 1e-12)
