"""Objects in a line, for people who print them."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from typing import Any

import numpy as np
from numpy.typing import NDArray

BOUND_REACHED = 1e-6
"""Rounding by which an error may exceed its certified bound, which it may reach, and still be written as 1.000."""

_LONGEST = 60  # characters of a value that is shown as it is


def brief(instance: Any) -> str:
    """A dataclass that holds arrays: their types and shapes, and of long values how many they are.

    A class takes it as its own: `__repr__ = brief`.

    Args:
        instance: of a dataclass.
    """
    parts = [f"{field.name}={_short(getattr(instance, field.name))}" for field in dataclasses.fields(instance)]
    return f"{type(instance).__name__}({', '.join(parts)})"


def spread(t: NDArray[np.float64]) -> str:
    """Where environments are in time: "t = 0.5 s", or "t = 0 to 0.5 s".

    Args:
        t: (B,) in s.
    """
    first, last = f"{t.min():.6g}", f"{t.max():.6g}"
    return f"t = {first} s" if first == last else f"t = {first} to {last} s"


def ratio_text(value: float | None, rounding: float = 0.0) -> str:
    """A ratio to a bound with three decimals, which never say 1.000 of another number.

    Below 1 it is rounded down to "0.999+"; above 1 it has as many decimals as tell it from 1.

    Args:
        value: the ratio; None if it isn't finite.
        rounding: by how much the ratio may exceed 1 and be written as 1.000, for bounds that may be reached.
    """
    if value is None or not math.isfinite(value):
        return "not finite"
    if value >= 1e4:
        return f"{value:.4g}"
    text = f"{value:.3f}"
    if text != "1.000" or 1.0 <= value <= 1.0 + rounding:
        return text
    return "0.999+" if value < 1.0 else next((t for d in range(4, 17) if float(t := f"{value:.{d}f}") != 1.0), text)


def _short(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype}[{', '.join(map(str, value.shape))}]"
    if hasattr(value, "number_of_edges"):  # a graph; networkx takes a while to import
        return f"<graph of {len(value)} nodes and {value.number_of_edges()} edges>"
    if hasattr(value, "_fields"):
        return f"{type(value).__name__}(...)"  # a named tuple of arrays
    if isinstance(value, Mapping | list | tuple) and len(repr(value)) > _LONGEST:
        return f"<{len(value)} {'entry' if len(value) == 1 else 'entries'}>"
    return repr(value)
