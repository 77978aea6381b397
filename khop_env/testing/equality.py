"""Bitwise comparison of nested values, with the first difference."""

from __future__ import annotations

from collections.abc import Iterator, Mapping
from dataclasses import fields, is_dataclass
from typing import Any

import numpy as np


def difference(first: Any, second: Any, place: str = "") -> str | None:
    """The first difference between two nested values of dicts, sequences, dataclasses, arrays and numbers.

    Args:
        first: a nested value.
        second: a nested value to compare with.
        place: name of the value in the result.

    Returns:
        "observations['agent_0'][3]: 0.5, then 0.25", or None if they are equal bit for bit, types included.
    """
    if type(first) is not type(second):
        return f"{place}: of type {type(first).__name__}, then {type(second).__name__}"
    if isinstance(first, np.ndarray):
        return _of_arrays(first, second, place)
    if isinstance(first, np.random.Generator):
        return difference(first.bit_generator.state, second.bit_generator.state, f"{place} (generator)")
    if isinstance(first, Mapping):
        if list(first) != list(second):
            return f"{place}: with the keys {list(first)}, then {list(second)}"
        return _first(difference(first[key], second[key], f"{place}[{key!r}]") for key in first)
    if isinstance(first, list | tuple):
        if len(first) != len(second):
            return f"{place}: of length {len(first)}, then {len(second)}"
        return _first(difference(*pair, f"{place}[{i}]") for i, pair in enumerate(zip(first, second, strict=True)))
    if is_dataclass(first):
        names = [field.name for field in fields(first)]
        return _first(difference(getattr(first, name), getattr(second, name), f"{place}.{name}") for name in names)
    if hasattr(first, "__array__"):  # NumPy's scalars, and other libraries' arrays
        return _of_arrays(np.asarray(first), np.asarray(second), place)
    if isinstance(first, float):
        return None if first.hex() == second.hex() else f"{place}: {first!r}, then {second!r}"
    if type(first).__eq__ is object.__eq__ and hasattr(first, "__dict__"):
        return difference(vars(first), vars(second), place)
    return None if first == second else f"{place}: {first!r}, then {second!r}"


def arrays(value: Any) -> Iterator[np.ndarray]:
    """All arrays in a nested value of dicts, sequences and object arrays."""
    if isinstance(value, np.ndarray):
        yield value
        if value.dtype == object:
            yield from arrays(value.ravel().tolist())
    elif isinstance(value, Mapping):
        yield from arrays(list(value.values()))
    elif isinstance(value, list | tuple):
        for inner in value:
            yield from arrays(inner)


def _of_arrays(first: np.ndarray, second: np.ndarray, place: str) -> str | None:
    if first.dtype != second.dtype or first.shape != second.shape:
        return f"{place}: {first.dtype} of shape {first.shape}, then {second.dtype} of shape {second.shape}"
    if first.dtype == object:
        return difference(first.ravel().tolist(), second.ravel().tolist(), place)
    if first.tobytes() == second.tobytes():
        return None
    for index, pair in zip(np.ndindex(first.shape), zip(first.flat, second.flat, strict=True), strict=True):
        if pair[0].tobytes() != pair[1].tobytes():
            where = f"[{', '.join(map(str, index))}]" if index else ""
            return f"{place}{where}: {pair[0]}, then {pair[1]}"
    return None


def _first(found: Iterator[str | None]) -> str | None:
    return next((text for text in found if text is not None), None)
