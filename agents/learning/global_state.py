"""Features of the true global state, for a critic that sees it while policies see observations only."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from agents.learning.scaling import MOST, SCALES
from khop_env.env import BatchedEnv
from khop_env.env.layout import Float32Array


@dataclass(frozen=True, eq=False)
class StateScaler:
    """Computes features of an environment's `state()`: columns scaled by constants by unit, as in `ObservationScaler`.

    The state has the position and all other states of each agent, leaders included; angles are cosine and sine.

    Attributes:
        scale: (S,) factor of each column.
    """

    scale: Float32Array

    @classmethod
    def of(cls, batched: BatchedEnv) -> StateScaler:
        """The scaler of an environment."""
        return cls(np.array([SCALES.get(field.unit, 1.0) for field in batched.state_fields], np.float32))

    @property
    def size(self) -> int:
        """Number of features S, one for each column."""
        return len(self.scale)

    def __call__(self, state: Float32Array) -> Float32Array:
        """Features (..., S) of states (..., S)."""
        return np.clip(state * self.scale, -MOST, MOST)
