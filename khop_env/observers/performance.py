"""Prescribed performance functions (Definition 1 of the paper) and their fast evaluation for many rows at once."""

from __future__ import annotations

from collections.abc import Iterable, Sequence
from dataclasses import dataclass
from typing import Protocol, runtime_checkable

import numpy as np
from numpy.typing import ArrayLike, NDArray

from khop_env.compiled import compiled, place
from khop_env.elementary import expm1
from khop_env.physics import read_only

FloatArray = NDArray[np.float64]


@runtime_checkable
class PerformanceFunction(Protocol):
    """A function rho(t) that is C^1, positive and bounded, with bounded derivative, for t >= 0 (Definition 1).

    Any object with these two methods is one; `Exponential` is the usual choice.
    """

    def __call__(self, t: FloatArray) -> FloatArray:
        """Values at the times `t` (s), of the same shape."""
        ...

    def infimum(self) -> float:
        """Largest known lower bound over all t >= 0: the prescribed accuracy at steady state; positive."""
        ...


@dataclass(frozen=True)
class Exponential:
    """rho(t) = (initial - final) exp(-rate t) + final, the paper's conventional choice of a performance function.

    Attributes:
        initial: rho(0), in the unit of the bounded quantity.
        final: rho(infinity), likewise; 0 < final <= initial.
        rate: l, decay rate in 1/s, positive.

    Raises:
        ValueError: if a value is not finite, not positive, or final exceeds initial.
    """

    initial: float
    final: float
    rate: float

    def __post_init__(self) -> None:
        values = (self.initial, self.final, self.rate)
        if not all(np.isfinite(values)) or min(values) <= 0.0 or self.final > self.initial:
            raise ValueError(
                f"a performance function needs 0 < final <= initial and rate > 0, all finite; got initial="
                f"{self.initial}, final={self.final}, rate={self.rate}"
            )

    def __call__(self, t: ArrayLike) -> FloatArray:
        """Values at the times `t` (s), of the same shape."""
        return (self.initial - self.final) * np.exp(-self.rate * np.asarray(t, float)) + self.final

    def infimum(self) -> float:
        """rho(infinity)."""
        return self.final


@dataclass(frozen=True)
class Scaled:
    """`factor` times another performance function; a performance function for factor > 0."""

    function: PerformanceFunction
    factor: float

    def __call__(self, t: FloatArray) -> FloatArray:
        """Values at the times `t` (s), of the same shape."""
        return self.factor * self.function(t)

    def infimum(self) -> float:
        """`factor` times the function's."""
        return self.factor * self.function.infimum()


def scaled(function: PerformanceFunction, factor: float) -> PerformanceFunction:
    """`factor` times `function`; an `Exponential` if `function` is one."""
    if type(function) is Exponential:  # a subclass may have other values
        return Exponential(function.initial * factor, function.final * factor, function.rate)
    return Scaled(function, factor)


def lower_bound(functions: Iterable[Exponential]) -> Exponential:
    """One exponential below all of `functions`: smallest coefficients, fastest rate.

    The design rule needs one C^1 function below every observer's bound; their pointwise minimum need not be C^1.
    """
    functions = list(functions)
    final = min(function.final for function in functions)
    decaying = min(function.initial - function.final for function in functions)
    return Exponential(final + decaying, final, max(function.rate for function in functions))


class FunnelBank:
    """Many performance functions evaluated together: exponentials in compiled code, others one call each.

    Args:
        functions: one per row.

    Attributes:
        exponential: whether all are an `Exponential`.
        coefficients: rho(0) - rho(infinity), rho(infinity) and decay rate of each exponential row, (rows,) each.
    """

    def __init__(self, functions: Sequence[PerformanceFunction]) -> None:
        self.functions = tuple(functions)
        # a subclass of it may have other values
        exponential = [f if type(f) is Exponential else Exponential(1.0, 1.0, 1.0) for f in self.functions]
        self.coefficients = (
            np.array([f.initial - f.final for f in exponential], dtype=float),
            np.array([f.final for f in exponential], dtype=float),
            np.array([f.rate for f in exponential], dtype=float),
        )
        self._others = [(r, f) for r, f in enumerate(self.functions) if type(f) is not Exponential]
        self.exponential = not self._others

    def __len__(self) -> int:
        return len(self.functions)

    def evaluate(self, t: FloatArray, out: FloatArray) -> FloatArray:
        """Write the (rows, B) values at the times `t` (B,) into `out` and return it.

        Raises:
            ValueError: if a function that isn't an `Exponential` gives values that are not positive and finite.
        """
        exponentials(t, *self.coefficients, out, 0, t.size)
        for row, function in self._others:
            out[row] = function(read_only(t[:]))
            if not np.all((out[row] > 0.0) & np.isfinite(out[row])):
                raise ValueError(
                    f"performance function {function!r} gave {out[row].min()} at t in [{t.min()}, {t.max()}] s; "
                    "Definition 1 requires positive, bounded values"
                )
        return out

    def infimum(self) -> FloatArray:
        """(rows,) lower bounds over all t >= 0."""
        return np.array([function.infimum() for function in self.functions])


@compiled
def exponentials(
    t: FloatArray, decaying: FloatArray, final: FloatArray, rate: FloatArray, out: FloatArray, low: int, high: int
) -> None:
    """Write decaying exp(-rate t) + final into `out` (rows, B), in the environments low to high - 1 with times `t`."""
    width = high - low
    decay = np.empty(width)
    for row in range(rate.size):
        if row == 0 or rate[row] != rate[row - 1]:  # one rate for all is the usual case
            speed = rate[row]
            for e in range(width):
                decay[e] = expm1(-min(speed * t[place(low + e)], 700.0)) + 1.0
        start, floor = decaying[row], final[row]
        for e in range(width):
            out[row, place(low + e)] = start * decay[e] + floor
