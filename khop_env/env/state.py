"""What an environment has to remember, and what it returns."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from khop_env.env.layout import Float32Array
from khop_env.observers import FloatArray, IntArray
from khop_env.simulation import SimulatorState

INFO_KEYS = (
    "task_error",
    "max_normalized_disagreement",
    "max_error_to_bound",
    "clipped_observations",
    "clipped_actions",
)
"""Keys of every info: the agent's root mean square error along its task edges in m; the largest |xi| / rho and
|x_tilde| / delta (inputs: |mu| / omega, |g_tilde| / theta) of all observers since the last action, below 1 by
guarantee; entries of this agent's observation and action that were clipped."""

Infos = dict[str, NDArray[Any]]
Step = tuple[Float32Array, FloatArray, NDArray[np.bool_], NDArray[np.bool_], Infos]


@dataclass(frozen=True, eq=False)
class EnvState:
    """Everything that an environment needs to continue bit for bit; treat it as opaque.

    Attributes:
        simulator: states, estimates and the disturbances' draws.
        inputs: (m, B) inputs in force, as fractions of their limits.
        cycles: (B,) control periods since reset.
        over: (B,) whether the episode has ended, or none has begun.
        leaders: ids of the leaders.
        routes: the leaders' draws and where they began; empty without leaders.
        generators: one per copy; None before the first reset.
        seeded: (B,) whether a copy was ever reset with a seed.
    """

    simulator: SimulatorState
    inputs: FloatArray
    cycles: IntArray
    over: NDArray[np.bool_]
    leaders: tuple[str, ...]
    routes: tuple[FloatArray, ...]
    generators: list[np.random.Generator | None]
    seeded: NDArray[np.bool_]
