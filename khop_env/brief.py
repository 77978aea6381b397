"""Objects in a line, for people who print them."""

from __future__ import annotations

import dataclasses
from collections.abc import Mapping
from typing import Any

import networkx as nx
import numpy as np
from numpy.typing import NDArray

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


def _short(value: Any) -> str:
    if isinstance(value, np.ndarray):
        return f"{value.dtype}[{', '.join(map(str, value.shape))}]"
    if isinstance(value, nx.Graph):
        return f"<graph of {len(value)} nodes and {value.number_of_edges()} edges>"
    if hasattr(value, "_fields"):
        return f"{type(value).__name__}(...)"  # a named tuple of arrays
    if isinstance(value, Mapping | list | tuple) and len(repr(value)) > _LONGEST:
        return f"<{len(value)} {'entry' if len(value) == 1 else 'entries'}>"
    return repr(value)
