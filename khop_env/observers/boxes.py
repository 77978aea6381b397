"""Boxes that contain a state for certain, and what may be done with them without losing it.

Merging is an intersection: commutative, associative and idempotent, so that messages that are lost, late, doubled or in
another order never make a box wrong.
"""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from khop_env.observers.layout import FloatArray


class Box(NamedTuple):
    """All states between two corners, component by component; shapes (n, ...), infinite where nothing is known.

    Attributes:
        low: the lower corner.
        high: the upper corner.
    """

    low: FloatArray
    high: FloatArray

    @staticmethod
    def around(center: FloatArray, radius: FloatArray) -> Box:
        """The states within `radius` of `center`."""
        return Box(center - radius, center + radius)

    def intersect(self, other: Box) -> Box:
        """The states that are in this box and in the `other`."""
        return Box(np.maximum(self.low, other.low), np.minimum(self.high, other.high))

    def empty(self) -> NDArray[np.bool_]:
        """(...) whether no state is left: then what some box was built on doesn't hold."""
        return np.asarray((self.low > self.high).any(axis=0))

    def clip(self, estimate: FloatArray) -> FloatArray:
        """The state of the box nearest to an `estimate` (n, ...): in no component farther from the true state."""
        return np.minimum(np.maximum(estimate, self.low), self.high)

    def far_face(self, estimate: FloatArray) -> FloatArray:
        """(n, ...) distance from an `estimate` to the farther face: the certified bound on its error."""
        return np.maximum(estimate - self.low, self.high - estimate)
