"""The barrier phi = T^2 / 2 of the proximal solve: its values in eps, where Newton's method starts, and where it lands.

As in `khop_env.observers.solve`, e is the normalised disagreement, z = phi'(e) the impulse and eps = T(e).
"""

from __future__ import annotations

import math

from khop_env.compiled import compiled, inlined, place
from khop_env.elementary import expm1, log
from khop_env.observers.layout import FloatArray

_JUMP = 0.25  # in eps: beyond it a warm start is no better than a new start
LONG_STEP = 1.0  # in eps: beyond it exp is not nearly linear


@inlined
def barrier(eps: float) -> tuple[float, float, float]:
    """(e, z, d eps / dz) with e = tanh(eps / 2) and z = phi'(e) = eps (1 + cosh eps); de/dz = de/deps d eps/dz."""
    a = abs(eps)
    growth = expm1(a)
    half = 1.0 / (growth + 2.0)
    e = growth * half
    q = 2.0 * (growth + 1.0) * half * half  # 1 / (1 + cosh eps) = (1 - e^2) / 2
    slope = 1.0 + a * e
    inverse = 1.0 / (q * slope)
    return math.copysign(e, eps), eps * (slope * inverse), q * q * inverse


@inlined
def eps_near_impulse(z: float) -> float:
    """Invert z = eps (1 + cosh eps) to a relative 7e-3, for |z| up to 1e300: near enough to start Newton's method.

    For large |z| it is Lambert's W of 2 |z|, started as R. Iacono and J. P. Boyd do (2017), for small ones z / 2; then
    one step of Newton's method in logarithms, where the function is increasing and nearly straight.
    """
    target = min(abs(z), 1e300) + 1e-300
    growth = log(1.0 + 2.0 * target)
    lambert = growth * (1.0 - log(1.0 + growth) / (2.0 + growth))
    a = 0.5 * target if target < 0.5 else min(0.5 * target, lambert)
    e, value, _ = barrier(a)
    a -= 2.0 * a * (value - target) / ((value + target) * (1.0 + a * e))
    return math.copysign(a, z)


@compiled
def barriers(rows: int, lanes: int, stride: int, u: FloatArray, e: FloatArray, z: FloatArray, gain: FloatArray) -> None:
    """The barrier at `lanes` entries of each row of flat arrays, in one long loop where nothing lies between rows."""
    if lanes == stride:
        for q in range(rows * lanes):
            e[q], z[q], gain[q] = barrier(u[q])
    else:
        for a in range(rows):
            for lane in range(lanes):
                q = place(a * stride + lane)
                e[q], z[q], gain[q] = barrier(u[q])


@compiled
def land(
    eta: int,
    lanes: int,
    active: FloatArray,
    u: FloatArray,
    z: FloatArray,
    gain: FloatArray,
    dz: FloatArray,
    answer: FloatArray,
) -> None:
    """After long steps, compute eps from the impulse z that Newton's method has reached: eps isn't linear in z."""
    for a in range(eta):
        for lane in range(lanes):
            far = active[lane] * abs(dz[a, lane] * gain[a, lane]) > LONG_STEP
            # e(z) flattens away from 0: an impulse that would cross it stops there first
            landing = eps_near_impulse(answer[a, lane]) if z[a, lane] * answer[a, lane] >= 0.0 else 0.0
            u[a, lane] = landing if far else u[a, lane]


@compiled
def start_anew(
    eta: int,
    pair: int,
    lanes: int,
    relay: FloatArray,
    scale: FloatArray,
    b: FloatArray,
    e: FloatArray,
    z: FloatArray,
    gain: FloatArray,
    u: FloatArray,
    total: FloatArray,
    lack: FloatArray,
    stiffness: FloatArray,
) -> bool:
    """Replace a warm start that a jump of the source has made useless; return True if one was replaced.

    Since M 1 = h, the equations of all observers add up to sum e + s sum h z = sum b: for a common impulse z, and for
    any where M is symmetric. Where Newton's step for a common impulse would be long, every observer starts from the one
    common impulse that meets the sum.
    """
    links = 0.0
    for lane in range(lanes):
        lack[lane] = 0.0
        stiffness[lane] = 0.0
        total[0, lane] = 0.0
    for a in range(eta):
        h = relay[pair + a]
        links += h
        for lane in range(lanes):
            total[0, lane] += b[a, lane]
            lack[lane] += b[a, lane] - e[a, lane] - scale[lane] * h * z[a, lane]
            # (de/dz + s h) / (deps/dz): change of the sum per unit of eps
            stiffness[lane] += 0.5 * (1.0 - e[a, lane] * e[a, lane]) + scale[lane] * h / gain[a, lane]
    far = 0.0
    for lane in range(lanes):
        lack[lane] = 1.0 if abs(lack[lane]) > _JUMP * stiffness[lane] else 0.0
        far += lack[lane]
    if far == 0.0:
        return False
    for lane in range(lanes):
        walls = 0.8 * eta  # sum e, about, where all are near the wall
        impulse = max(abs(total[0, lane]) - walls, 0.0) / (scale[lane] * links)
        stiffness[lane] = math.copysign(eps_near_impulse(impulse), total[0, lane])
    for a in range(eta):
        for lane in range(lanes):
            u[a, lane] = stiffness[lane] if lack[lane] > 0.0 else u[a, lane]
    return True


@compiled
def start_anew_weighted(
    eta: int,
    lanes: int,
    relay: FloatArray,
    scale: FloatArray,
    b: FloatArray,
    e: FloatArray,
    z: FloatArray,
    gain: FloatArray,
    u: FloatArray,
    total: FloatArray,
    lack: FloatArray,
    stiffness: FloatArray,
    links: FloatArray,
) -> bool:
    """`start_anew` for weights that differ between lanes: `relay` (eta, lanes), and `links` (lanes,) for their sums.

    Observers that no message of the target's state reaches start from the impulse 0.
    """
    for lane in range(lanes):
        links[lane] = 0.0
        lack[lane] = 0.0
        stiffness[lane] = 0.0
        total[0, lane] = 0.0
    for a in range(eta):
        for lane in range(lanes):
            h = relay[a, lane]
            links[lane] += h
            total[0, lane] += b[a, lane]
            lack[lane] += b[a, lane] - e[a, lane] - scale[lane] * h * z[a, lane]
            # (de/dz + s h) / (deps/dz): change of the sum per unit of eps
            stiffness[lane] += 0.5 * (1.0 - e[a, lane] * e[a, lane]) + scale[lane] * h / gain[a, lane]
    far = 0.0
    for lane in range(lanes):
        lack[lane] = 1.0 if abs(lack[lane]) > _JUMP * stiffness[lane] else 0.0
        far += lack[lane]
    if far == 0.0:
        return False
    for lane in range(lanes):
        walls = 0.8 * eta  # sum e, about, where all are near the wall
        reached = scale[lane] * links[lane]
        impulse = max(abs(total[0, lane]) - walls, 0.0) / reached if reached > 0.0 else 0.0
        stiffness[lane] = math.copysign(eps_near_impulse(impulse), total[0, lane])
    for a in range(eta):
        for lane in range(lanes):
            u[a, lane] = stiffness[lane] if lack[lane] > 0.0 else u[a, lane]
    return True
