"""Look-ups in arrays of numbers, for index arrays of thousands of agents."""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

IntArray = NDArray[np.int64]


def ranges(start: IntArray, count: IntArray) -> tuple[IntArray, IntArray]:
    """Ranges of numbers after each other: of each number the range that it is in, and the number."""
    which = np.repeat(np.arange(len(start)), count)
    return which, np.arange(len(which)) + np.repeat(start - np.cumsum(count) + count, count)


def find(wanted: IntArray, known: IntArray) -> tuple[NDArray[np.bool_], IntArray]:
    """Whether each wanted number is among the known ones, which differ, and where; meaningless where it isn't."""
    if not len(known):
        return np.zeros(len(wanted), np.bool_), np.zeros(len(wanted), np.int64)
    order = np.argsort(known)
    place = order[np.minimum(np.searchsorted(known, wanted, sorter=order), len(known) - 1)]
    return known[place] == wanted, place
