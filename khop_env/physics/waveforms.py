"""Compiled waveforms of the disturbances: each adds its w to some components of a batch of states.

States and w are (n, B), batch last; a loop goes over the environments low to high - 1. Column b of every result depends
on the arguments of environment b only. Arguments are first gathered into a contiguous array, so that the loop over the
elementary function vectorises.
"""

from __future__ import annotations

import math
from typing import Any, NamedTuple

import numpy as np

from khop_env.compiled import compiled, inlined, place
from khop_env.elementary import sin, tanh
from khop_env.physics.agent_model import FloatArray, IndexArray

SINES, GUSTS, COUPLING = range(3)


class Form(NamedTuple):
    """The compiled form of a disturbance: which waveform, and its numbers.

    Attributes:
        kind: SINES, GUSTS or COUPLING.
        number: Of sines or pulses of a channel.
        first: Duration of a pulse in seconds, or the coupling's gain in 1/m.
        second: Length of a window in seconds.
    """

    kind: int
    number: int = 0
    first: float = 0.0
    second: float = 0.0


class TermArrays(NamedTuple):
    """Several disturbances of the library, attached to a fleet.

    Attributes:
        kind: Of each, with `number`, `first` and `second` as in `Form`, shape (T,).
        number: Shape (T,).
        first: Shape (T,).
        second: Shape (T,).
        begin: Where its draws begin among those of an episode, shape (T,).
        channel: Where its channels begin in `component` and `amplitude`, and their number at the end, shape (T + 1,).
        component: Components of the state that it acts on, of all.
        amplitude: Bound of each.
        positions: Where all agents' positions sit in the state, shape (N, d).
    """

    kind: IndexArray
    number: IndexArray
    first: FloatArray
    second: FloatArray
    begin: IndexArray
    channel: IndexArray
    component: IndexArray
    amplitude: FloatArray
    positions: IndexArray


@compiled
def disturb(terms: Any, t: FloatArray, x: FloatArray, drawn: FloatArray, out: FloatArray, low: int, high: int) -> None:
    """Overwrite `out` (n, B) with the sum of all terms, the fields of `TermArrays` as a plain tuple."""
    terms = TermArrays(*terms)
    for row in range(out.shape[0]):
        for e in range(high - low):
            out[row, place(low + e)] = 0.0
    for k in range(terms.kind.size):
        part = terms.component[terms.channel[k] : terms.channel[k + 1]]
        amplitude = terms.amplitude[terms.channel[k] : terms.channel[k + 1]]
        kind, begin, count, first = terms.kind[k], terms.begin[k], terms.number[k], terms.first[k]
        if kind == SINES:
            add_sines(t, drawn, begin, count, part, amplitude, out, low, high)
        elif kind == GUSTS:
            add_gusts(t, drawn, begin, first, terms.second[k], count, part, amplitude, out, low, high)
        else:
            add_coupling(x, first, terms.positions, part, amplitude, out, low, high)


@inlined
def add_sines(
    t: FloatArray,
    drawn: FloatArray,
    begin: int,
    components: int,
    index: IndexArray,
    amplitude: FloatArray,
    out: FloatArray,
    low: int,
    high: int,
) -> None:
    """Add amplitude / components * sum_j sin(omega_j t + phi_j).

    Args:
        t: Times in seconds, shape (B,).
        drawn: Draws of the episode, shape (B, K): omega in rad/s, then phi in rad, each (components, C) and flat.
        begin: Where they begin in a row.
        components: Number of sines j.
        index: Components of the state to add to, shape (C,).
        amplitude: Sum of the amplitudes of all sines, shape (C,).
        out: Added to, shape (n, B).
        low: First environment.
        high: One past the last.
    """
    channels = index.size
    angle = np.empty(channels)
    total = np.empty(channels)
    for b in range(low, high):
        total[:] = 0.0
        for j in range(components):
            of_j = begin + j * channels
            for c in range(channels):
                angle[c] = drawn[b, place(of_j + c)] * t[b] + drawn[b, place(of_j + components * channels + c)]
            for c in range(channels):
                total[c] += sin(angle[c])
        for c in range(channels):
            out[index[c], b] += amplitude[c] * (total[c] / components)


@inlined
def add_gusts(
    t: FloatArray,
    drawn: FloatArray,
    begin: int,
    duration: float,
    period: float,
    pulses: int,
    index: IndexArray,
    amplitude: FloatArray,
    out: FloatArray,
    low: int,
    high: int,
) -> None:
    """Add the "1 - cosine" pulse of the window that t lies in, written as sin(pi s / duration)**2.

    Args:
        t: Times in seconds, shape (B,).
        drawn: Draws of the episode, shape (B, K): beginnings within the window in seconds, then signs, each
            (pulses, C).
        begin: Where they begin in a row.
        duration: Length of a pulse in seconds.
        period: Length of a window in seconds.
        pulses: Number of windows before the sequence repeats.
        index: Components of the state to add to, shape (C,).
        amplitude: Height of a pulse, shape (C,).
        out: Added to, shape (n, B).
        low: First environment.
        high: One past the last.
    """
    channels = index.size
    angle = np.empty(channels)
    for b in range(low, high):
        window = math.floor(t[b] / period)
        since = t[b] - window * period
        first = begin + int(window) % pulses * channels
        for c in range(channels):
            angle[c] = math.pi * min(max((since - drawn[b, first + c]) / duration, 0.0), 1.0)
        for c in range(channels):
            angle[c] = sin(angle[c])
        for c in range(channels):
            out[index[c], b] += amplitude[c] * drawn[b, pulses * channels + first + c] * angle[c] * angle[c]


@inlined
def add_coupling(
    x: FloatArray,
    gain: float,
    positions: IndexArray,
    index: IndexArray,
    amplitude: FloatArray,
    out: FloatArray,
    low: int,
    high: int,
) -> None:
    """Add amplitude * tanh(gain * (mean position - own position)).

    Args:
        x: Fleet states, shape (n, B).
        gain: In 1/m.
        positions: Where all agents' positions sit in the state, shape (N, d).
        index: Position components to add to, agent after agent and all d axes of each, shape (C,).
        amplitude: Bound of each, shape (C,).
        out: Added to, shape (n, B).
        low: First environment.
        high: One past the last.
    """
    agents, dim = positions.shape
    mean = np.empty(dim)
    pull = np.empty(index.size)
    for b in range(low, high):
        mean[:] = 0.0
        for i in range(agents):
            for axis in range(dim):
                mean[axis] += x[positions[i, axis], b]
        for c in range(index.size):
            pull[c] = gain * (mean[c % dim] / agents - x[index[c], b])
        for c in range(index.size):
            pull[c] = tanh(pull[c])
        for c in range(index.size):
            out[index[c], b] += amplitude[c] * pull[c]
