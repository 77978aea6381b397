"""Newton's step of the proximal solve, (diag(de/dz) + s M) dz = b - e - s M z, for many problems side by side."""

from __future__ import annotations

from khop_env.compiled import compiled, place
from khop_env.observers.layout import FloatArray, IntArray


@compiled
def newton_step(
    eta: int,
    pair: int,
    lanes: int,
    diagonal: FloatArray,
    entry_start: IntArray,
    entry_of: IntArray,
    first: IntArray,
    scale: FloatArray,
    b: FloatArray,
    e: FloatArray,
    z: FloatArray,
    gain: FloatArray,
    dz: FloatArray,
    pivot: FloatArray,
    entry: FloatArray,
    lower: FloatArray,
    row_start: IntArray,
) -> None:
    """Solve (diag(de/dz) + s M) dz = b - e - s M z for all lanes, by L D L' in the profile of M (no square roots)."""
    for a in range(eta):
        d, begin = diagonal[pair + a], first[pair + a]
        for lane in range(lanes):
            dz[a, lane] = d * z[a, lane]
        for j in range(begin, a):
            for lane in range(lanes):
                entry[j, lane] = 0.0
        for k in range(entry_start[pair + a], entry_start[pair + a + 1]):
            other = entry_of[k]
            for lane in range(lanes):
                dz[a, lane] -= z[other, lane]
            if other < a:
                for lane in range(lanes):
                    entry[other, lane] = -scale[lane]
        for lane in range(lanes):
            normalized = e[a, lane]
            dz[a, lane] = b[a, lane] - normalized - scale[lane] * dz[a, lane]
            pivot[a, lane] = 0.5 * (1.0 - normalized * normalized) * gain[a, lane] + scale[lane] * d
        for j in range(begin, a):
            for k in range(max(begin, first[pair + j]), j):
                factor = row_start[j] + k
                for lane in range(lanes):
                    entry[j, lane] -= entry[k, lane] * lower[factor, lane]
        for j in range(begin, a):
            factor = row_start[a] + j
            for lane in range(lanes):
                multiplier = entry[j, lane] * pivot[j, lane]
                lower[factor, lane] = multiplier
                pivot[a, lane] -= entry[j, lane] * multiplier
                dz[a, lane] -= multiplier * dz[j, lane]
        for lane in range(lanes):
            pivot[a, lane] = 1.0 / pivot[a, lane]
    for a in range(eta):
        for lane in range(lanes):
            dz[a, lane] *= pivot[a, lane]
    for a in range(eta - 1, 0, -1):
        for j in range(first[pair + a], a):
            factor = row_start[a] + j
            for lane in range(lanes):
                dz[j, lane] -= lower[factor, lane] * dz[a, lane]


@compiled
def newton_step_one_way(
    eta: int,
    pair: int,
    lanes: int,
    diagonal: FloatArray,
    entry_start: IntArray,
    entry_of: IntArray,
    first: IntArray,
    last: IntArray,
    scale: FloatArray,
    b: FloatArray,
    e: FloatArray,
    z: FloatArray,
    gain: FloatArray,
    dz: FloatArray,
    pivot: FloatArray,
    multiplier: FloatArray,
    upper: FloatArray,
    d_lanes: FloatArray | None,
    w_lanes: FloatArray | None,
) -> None:
    """`newton_step` for an M that isn't symmetric, by LU in its profile; row a of U is upper[a eta : (a + 1) eta].

    Where M differs between lanes, its diagonal is `d_lanes` (eta, lanes), and its other entries are minus `w_lanes`
    (entries of the target, lanes); otherwise both are None.
    """
    for a in range(eta):
        begin, end, row = first[pair + a], last[pair + a], a * eta
        for lane in range(lanes):
            d = diagonal[pair + a] if d_lanes is None else d_lanes[a, lane]
            dz[a, lane] = d * z[a, lane]
        for j in range(begin, end + 1):
            at = place(row + j)
            for lane in range(lanes):
                upper[at, lane] = 0.0
        for k in range(entry_start[pair + a], entry_start[pair + a + 1]):
            other = entry_of[k]
            at = place(row + other)
            if w_lanes is None:
                for lane in range(lanes):
                    dz[a, lane] -= z[other, lane]
                    upper[at, lane] = -scale[lane]
            else:
                from_it = place(k - entry_start[pair])
                for lane in range(lanes):
                    dz[a, lane] -= w_lanes[from_it, lane] * z[other, lane]
                    upper[at, lane] = -scale[lane] * w_lanes[from_it, lane]
        at = place(row + a)
        for lane in range(lanes):
            d = diagonal[pair + a] if d_lanes is None else d_lanes[a, lane]
            normalized = e[a, lane]
            dz[a, lane] = b[a, lane] - normalized - scale[lane] * dz[a, lane]
            upper[at, lane] = 0.5 * (1.0 - normalized * normalized) * gain[a, lane] + scale[lane] * d
        for k in range(begin, a):
            at = place(row + k)
            for lane in range(lanes):
                factor = upper[at, lane] * pivot[k, lane]
                multiplier[0, lane] = factor
                dz[a, lane] -= factor * dz[k, lane]
            for j in range(k + 1, last[pair + k] + 1):
                at, above = place(row + j), place(k * eta + j)
                for lane in range(lanes):
                    upper[at, lane] -= multiplier[0, lane] * upper[above, lane]
        at = place(row + a)
        for lane in range(lanes):
            pivot[a, lane] = 1.0 / upper[at, lane]
    for a in range(eta - 1, -1, -1):
        for j in range(a + 1, last[pair + a] + 1):
            at = place(a * eta + j)
            for lane in range(lanes):
                dz[a, lane] -= upper[at, lane] * dz[j, lane]
        for lane in range(lanes):
            dz[a, lane] *= pivot[a, lane]
