"""Networks and their numbers as users write them."""

from __future__ import annotations

from typing import TypeAlias

import numpy as np

Span: TypeAlias = float | tuple[float, float]
"""A number, or a range (low, high) from which each episode draws."""


def parsed(text: str, what: str) -> Span | None:
    """A number, a range "low..high", or "none"; `what` it is, for error messages.

    Raises:
        ValueError: for any other text.
    """
    if text.lower() == "none":
        return None
    try:
        numbers = [float(part) for part in text.split("..")]
    except ValueError:
        numbers = []
    if not 1 <= len(numbers) <= 2:
        raise ValueError(f"{what} must be a number, or a range like 0.1..0.3; got {text!r}")
    return numbers[0] if len(numbers) == 1 else (numbers[0], numbers[1])


def number(value: object, what: str) -> float:
    """A value that is a number, NumPy's included; `what` it is, for error messages.

    Raises:
        ValueError: for anything else.
    """
    if isinstance(value, bool) or not isinstance(value, int | float | np.integer | np.floating):
        raise ValueError(f"{what} must be a number; got {value!r}")
    return float(value)


def number_or_range(value: object, what: str) -> Span:
    """A value that is a number or a pair (low, high), lists included; `what` it is, for error messages.

    Raises:
        ValueError: for anything else.
    """
    if not isinstance(value, tuple | list):
        return number(value, what)
    if len(value) != 2 or not number(value[0], what) <= number(value[1], what):
        raise ValueError(f"{what} must be a number, or a range (low, high) with low <= high; got {value!r}")
    return float(value[0]), float(value[1])
