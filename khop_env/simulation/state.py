"""The simulator's whole state: what has to be saved so that a run continues bit for bit."""

from __future__ import annotations

from dataclasses import dataclass, fields

import numpy as np

from khop_env.observers import FloatArray


@dataclass(slots=True)
class SimulatorState:
    """Arrays of B environments, batch last; everything an integrator reads and writes.

    Attributes:
        t: (B,) time since reset in s.
        x: (n, B) true states.
        u: (m, B) inputs in force.
        g: (n, B) their effect g_i(x_i, u_i).
        estimate: (P, B) state estimates.
        eps: (P, B) transformed disagreement of the proximal step: where the next solve starts.
        input_estimate: (Q, B) estimates of g.
        nu: (Q, B) transformed input disagreement, likewise.
        drawn: (B, K) the disturbance's random numbers of this episode.
    """

    t: FloatArray
    x: FloatArray
    u: FloatArray
    g: FloatArray
    estimate: FloatArray
    eps: FloatArray
    input_estimate: FloatArray
    nu: FloatArray
    drawn: FloatArray

    @staticmethod
    def zeros(batch: int, n: int, m: int, pairs: int, input_pairs: int, draws: int) -> SimulatorState:
        """A state of zeros.

        Args:
            batch: number of environments B.
            n: states of the fleet.
            m: inputs of the fleet.
            pairs: P, the length of the state estimates.
            input_pairs: Q, the length of the input estimates.
            draws: K, the disturbance's random numbers.
        """
        t, drawn = np.zeros(batch), np.zeros((batch, draws))
        x, u, g, y, eps, ghat, nu = (np.zeros((k, batch)) for k in (n, m, n, pairs, pairs, input_pairs, input_pairs))
        return SimulatorState(t, x, u, g, y, eps, ghat, nu, drawn)

    def copy(self) -> SimulatorState:
        """An independent copy."""
        return SimulatorState(*(getattr(self, f.name).copy() for f in fields(self)))

    def copy_dynamic(self, other: SimulatorState) -> None:
        """Write all but the episode's draws into `other`, of the same shapes; quicker than `assign`."""
        for name in ("t", "x", "u", "g", "estimate", "eps", "input_estimate", "nu"):
            np.copyto(getattr(other, name), getattr(self, name))

    def assign(self, other: SimulatorState) -> None:
        """Overwrite this state in place.

        Raises:
            ValueError: if an array's shape differs; nothing is overwritten then.
        """
        for f in fields(self):
            mine, theirs = getattr(self, f.name), getattr(other, f.name)
            if mine.shape != theirs.shape:
                raise ValueError(
                    f"can't restore: {f.name} has shape {theirs.shape}, this simulator's is {mine.shape}; it was saved "
                    "by another scenario or batch size"
                )
        for f in fields(self):
            getattr(self, f.name)[...] = getattr(other, f.name)
