"""The set in which states start."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np
from numpy.typing import ArrayLike

from khop_env.brief import brief
from khop_env.observers import FloatArray, IntArray
from khop_env.simulation.arena import Arena


@dataclass(frozen=True, eq=False)
class InitialSet:
    """The set in which states start: uniformly in a box. Its centre is the observers' common first guess.

    Attributes:
        center: (n,) in the states' units.
        radius: (n,) half widths, not negative.
        arena: if it has one, positions are drawn on condition that they are far enough apart.
        positions: (N, d) the positions' places in the state; needed with an arena.

    Raises:
        ValueError: if they differ in shape, or a number isn't finite or a half width negative.
    """

    center: FloatArray
    radius: FloatArray
    arena: Arena | None = None
    positions: IntArray | None = None

    __repr__ = brief

    def __post_init__(self) -> None:
        center, radius = np.asarray(self.center, dtype=float), np.asarray(self.radius, dtype=float)
        if center.ndim != 1 or center.shape != radius.shape or not np.isfinite([center, radius]).all():
            raise ValueError(f"center and radius must be finite, (n,) each; got {self.center!r} and {self.radius!r}")
        if (radius < 0.0).any():
            raise ValueError(f"radius must not be negative; got {radius.min():g} for component {radius.argmin()}")
        object.__setattr__(self, "center", center)
        object.__setattr__(self, "radius", radius)

    def checked(self, x0: ArrayLike, count: int) -> FloatArray:
        """Initial states (n,) or (count, n) that were given, inside the box or not.

        Raises:
            ValueError: if they aren't finite, or of another shape.
        """
        states, n = np.asarray(x0, dtype=float), len(self.center)
        if states.shape not in ((n,), (count, n)) or not np.all(np.isfinite(states)):
            raise ValueError(f"x0 must be finite, of shape ({n},) or ({count}, {n}); got shape {states.shape}")
        return states

    def draw(self, rng: np.random.Generator) -> FloatArray:
        """One (n,) initial state."""
        x = self.center + self.radius * rng.uniform(-1.0, 1.0, len(self.center))
        if self.arena is not None and self.positions is not None:
            x[self.positions] = self.arena.draw(self.center[self.positions], self.radius[self.positions], rng)
        return x
