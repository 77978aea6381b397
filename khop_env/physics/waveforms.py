"""Compiled waveforms of the disturbances: each adds its w to some components of a batch of states.

Row b of every result depends on row b of the arguments only. Arguments are first gathered into a contiguous array, so
that the loop over the elementary function vectorises.
"""

from __future__ import annotations

import math

import numpy as np

from khop_env.compiled import compiled
from khop_env.elementary import sin, tanh
from khop_env.physics.agent_model import FloatArray, IndexArray


@compiled
def add_sines(
    t: FloatArray, drawn: FloatArray, components: int, index: IndexArray, amplitude: FloatArray, out: FloatArray
) -> None:
    """Add amplitude / components * sum_j sin(omega_j t + phi_j).

    Args:
        t: Times in seconds, shape (B,).
        drawn: For each environment omega in rad/s, then phi in rad, each (components, C) and flat.
        components: Number of sines j.
        index: Components of the state to add to, shape (C,).
        amplitude: Sum of the amplitudes of all sines, shape (C,).
        out: Added to, shape (B, n).
    """
    channels = index.size
    angle = np.empty(channels)
    total = np.empty(channels)
    for b in range(t.size):
        total[:] = 0.0
        for j in range(components):
            for c in range(channels):
                angle[c] = drawn[b, j * channels + c] * t[b] + drawn[b, (components + j) * channels + c]
            for c in range(channels):
                total[c] += sin(angle[c])
        for c in range(channels):
            out[b, index[c]] += amplitude[c] * (total[c] / components)


@compiled
def add_gusts(
    t: FloatArray,
    drawn: FloatArray,
    duration: float,
    period: float,
    pulses: int,
    index: IndexArray,
    amplitude: FloatArray,
    out: FloatArray,
) -> None:
    """Add the "1 - cosine" pulse of the window that t lies in, written as sin(pi s / duration)**2.

    Args:
        t: Times in seconds, shape (B,).
        drawn: For each environment the beginnings within the window in seconds, then the signs, each (pulses, C), flat.
        duration: Length of a pulse in seconds.
        period: Length of a window in seconds.
        pulses: Number of windows before the sequence repeats.
        index: Components of the state to add to, shape (C,).
        amplitude: Height of a pulse, shape (C,).
        out: Added to, shape (B, n).
    """
    channels = index.size
    angle = np.empty(channels)
    for b in range(t.size):
        window = math.floor(t[b] / period)
        since = t[b] - window * period
        first = int(window) % pulses * channels
        for c in range(channels):
            angle[c] = math.pi * min(max((since - drawn[b, first + c]) / duration, 0.0), 1.0)
        for c in range(channels):
            angle[c] = sin(angle[c])
        for c in range(channels):
            out[b, index[c]] += amplitude[c] * drawn[b, pulses * channels + first + c] * angle[c] * angle[c]


@compiled
def add_coupling(
    x: FloatArray, gain: float, positions: IndexArray, index: IndexArray, amplitude: FloatArray, out: FloatArray
) -> None:
    """Add amplitude * tanh(gain * (mean position - own position)).

    Args:
        x: Fleet states, shape (B, n).
        gain: In 1/m.
        positions: Where all agents' positions sit in the state, shape (N, d).
        index: Position components to add to, agent after agent and all d axes of each, shape (C,).
        amplitude: Bound of each, shape (C,).
        out: Added to, shape (B, n).
    """
    agents, dim = positions.shape
    mean = np.empty(dim)
    pull = np.empty(index.size)
    for b in range(x.shape[0]):
        mean[:] = 0.0
        for i in range(agents):
            for axis in range(dim):
                mean[axis] += x[b, positions[i, axis]]
        for c in range(index.size):
            pull[c] = gain * (mean[c % dim] / agents - x[b, index[c]])
        for c in range(index.size):
            pull[c] = tanh(pull[c])
        for c in range(index.size):
            out[b, index[c]] += amplitude[c] * pull[c]
