"""The complete state of a simulator, from which a run continues bit for bit."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from khop_env.brief import brief
from khop_env.observers import FloatArray, IntArray, Memory


@dataclass(slots=True)
class SimulatorState:
    """Arrays of B environments, batch last: all that a step reads and writes.

    Attributes:
        t: (B,) time since reset in s.
        x: (n, B) true states.
        u: (m, B) inputs in force.
        g: (n, B) their effect g_i(x_i, u_i).
        drawn: (B, K) the disturbance's random numbers of this episode.
        memory: of the observers, by name.
    """

    t: FloatArray
    x: FloatArray
    u: FloatArray
    g: FloatArray
    drawn: FloatArray
    memory: Memory

    __repr__ = brief

    def arrays(self) -> dict[str, FloatArray]:
        """Every array that changes, by name; the observers' memory included."""
        return {"t": self.t, "x": self.x, "u": self.u, "g": self.g, "drawn": self.drawn, **self.memory}

    def copy(self) -> SimulatorState:
        """An independent copy."""
        memory = {name: values.copy() for name, values in self.memory.items()}
        t, x, u, g, drawn = (array.copy() for array in (self.t, self.x, self.u, self.g, self.drawn))
        return SimulatorState(t, x, u, g, drawn, memory)

    def copy_step(self, other: SimulatorState, memory: bool = True, where: NDArray[np.bool_] | bool = True) -> None:
        """Copy the arrays that a step changes into `other`, of the same shapes: all but the episode's draws.

        Args:
            other: changed.
            memory: whether the observers' memory is copied, too.
            where: (B,) in which environments; True for all.
        """
        for ours, theirs in ((self.t, other.t), (self.x, other.x), (self.u, other.u), (self.g, other.g)):
            np.copyto(theirs, ours, where=where)
        if memory:
            for name, values in self.memory.items():
                np.copyto(other.memory[name], values, where=where)

    def assign(self, other: SimulatorState) -> None:
        """Overwrite this state in place; memory of `other` that these observers don't have is left out.

        Raises:
            ValueError: if an array is missing, or of another shape; nothing is overwritten then.
        """
        ours, theirs = self.arrays(), other.arrays()
        if missing := [name for name in ours if name not in theirs]:
            raise ValueError(
                f"can't restore: the state was saved by other observers, without {', '.join(missing)}; restore it into "
                "a simulator with the same ones"
            )
        for name, values in ours.items():
            if values.shape != theirs[name].shape:
                raise ValueError(
                    f"can't restore: {name} has shape {theirs[name].shape}, this simulator's is {values.shape}; it was "
                    "saved by another scenario or number of environments"
                )
        for name, values in ours.items():
            values[...] = theirs[name]


def selected(env_ids: Sequence[int] | IntArray | None, num_envs: int) -> IntArray:
    """Indices of environments, checked; all of them for None.

    Raises:
        ValueError: if an index is out of range, duplicated, or not an integer.
    """
    if env_ids is None:
        return np.arange(num_envs)
    chosen = np.asarray(env_ids)
    if chosen.dtype == bool:
        raise ValueError("env_ids must be indices, not a mask: give np.flatnonzero(mask)")
    wrong = chosen.ndim != 1 or (chosen.size and chosen.dtype.kind not in "iu")
    if wrong or np.any((chosen < 0) | (chosen >= num_envs)) or len(np.unique(chosen)) < len(chosen):
        raise ValueError(f"env_ids must be different indices from 0 to {num_envs - 1}; got {env_ids!r}")
    return chosen.astype(np.int64)
