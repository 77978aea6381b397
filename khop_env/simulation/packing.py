"""The arrays of a compiled step, as few arguments: every argument of a compiled call takes time."""

from __future__ import annotations

from typing import Any, NamedTuple

import numpy as np

from khop_env.compiled import pasted
from khop_env.observers import FloatArray, IntArray
from khop_env.simulation.state import SimulatorState


class Values(NamedTuple):
    """The arrays of a `SimulatorState` that a step changes.

    Attributes:
        t: (B,) time in s.
        x: (n, B) states.
        u: (m, B) inputs.
        g: (n, B) their effect.
        estimate: (P, B) estimates of states.
        input_estimate: (Q, B) estimates of the inputs' effects.
        eps: (P, B) transformed disagreements.
        nu: (Q, B) those of the input observers.
    """

    t: FloatArray
    x: FloatArray
    u: FloatArray
    g: FloatArray
    estimate: FloatArray
    input_estimate: FloatArray
    eps: FloatArray
    nu: FloatArray

    @classmethod
    def of(cls, state: SimulatorState) -> Values:
        """Of a state; its arrays themselves."""
        memory = (state.memory[name] for name in ("estimate", "input_estimate", "eps", "nu"))
        return cls(state.t, state.x, state.u, state.g, *memory)


class System(NamedTuple):
    """The equations of a step, by plain tuples with the fields of the named tuples that they are called after.

    Attributes:
        runs: all agents, of `physics.right_hand_sides.Runs`.
        estimates: the estimates whose observers know the drift, likewise.
        terms: of the disturbance, `physics.waveforms.TermArrays`.
        edges: of the law, `EdgeArrays`.
        states: the pairs of the state observers, `PairArrays`.
        inputs: those of the input observers.
        rho: the funnels' coefficients of the state observers.
        omega: those of the input observers.
        state_sums: (pairs,) [M_i^-1 1]_a of the state observers.
        input_sums: likewise of the input observers.
        input_runs: (3 K,) K runs of estimates with an input observer: first rows, the same among the input estimates,
            numbers of rows.
        sizes: dimension of positions, and whether `estimates` are all estimates.
    """

    runs: Any
    estimates: Any
    terms: Any
    edges: Any
    states: Any
    inputs: Any
    rho: Any
    omega: Any
    state_sums: FloatArray
    input_sums: FloatArray
    input_runs: IntArray
    sizes: IntArray


def packed(system: System) -> tuple[IntArray, FloatArray]:
    """All arrays of a system in two, of integers and of floats, since every argument of a compiled call takes time.

    The integers begin with tables of where each array of integers, and then each of floats, begins and the last ends.
    """
    arrays = [np.ravel(each) for part in system for each in (part if isinstance(part, tuple) else (part,))]
    integers = [each for each in arrays if each.dtype.kind == "i"]
    floats = [each for each in arrays if each.dtype.kind == "f"]
    assert (len(integers), len(floats)) == (_INTEGERS, _FLOATS)
    starts = _INTEGERS + _FLOATS + 2 + np.cumsum([0, *map(len, integers)])
    float_starts = np.cumsum([0, *map(len, floats)])
    return np.concatenate([starts, float_starts, *integers]).astype(np.int64), np.concatenate(floats)


_INTEGERS, _FLOATS = 49, 18


@pasted
def integers_at(integers: IntArray, q: int) -> IntArray:
    """Array q of the integers of `packed`."""
    return integers[integers[q] : integers[q + 1]]


@pasted
def floats_at(integers: IntArray, floats: FloatArray, q: int) -> FloatArray:
    """Array q of the floats."""
    return floats[integers[_INTEGERS + 1 + q] : integers[_INTEGERS + 2 + q]]


@pasted
def pairs_at(n: IntArray, f: FloatArray, q: int, r: int) -> Any:
    """The fields of `PairArrays`, whose first array of integers is q and of floats r."""
    return (
        integers_at(n, q),
        integers_at(n, q + 1),
        integers_at(n, q + 2),
        integers_at(n, q + 3),
        integers_at(n, q + 4),
        integers_at(n, q + 5),
        floats_at(n, f, r),
        floats_at(n, f, r + 1),
        integers_at(n, q + 6),
        integers_at(n, q + 7),
        integers_at(n, q + 8),
        integers_at(n, q + 9),
    )


@pasted
def runs_at(n: IntArray, f: FloatArray, q: int, r: int) -> Any:
    """The fields of `Runs`, likewise."""
    return (
        integers_at(n, q),
        integers_at(n, q + 1),
        integers_at(n, q + 2),
        integers_at(n, q + 3),
        integers_at(n, q + 4),
        integers_at(n, q + 5),
        integers_at(n, q + 6),
        floats_at(n, f, r),
    )


@pasted
def terms_at(n: IntArray, f: FloatArray, dim: int) -> Any:
    """The fields of `TermArrays`."""
    positions = integers_at(n, 19)
    return (
        integers_at(n, 14),
        integers_at(n, 15),
        floats_at(n, f, 2),
        floats_at(n, f, 3),
        integers_at(n, 16),
        integers_at(n, 17),
        integers_at(n, 18),
        floats_at(n, f, 4),
        positions.reshape(positions.size // dim, dim),
    )


@pasted
def edges_at(n: IntArray, f: FloatArray, dim: int) -> Any:
    """The fields of `EdgeArrays`."""
    own, other, position = integers_at(n, 21), integers_at(n, 22), integers_at(n, 26)
    return (
        integers_at(n, 20),
        own.reshape(own.size // dim, dim),
        other.reshape(other.size // dim, dim),
        integers_at(n, 23),
        integers_at(n, 24),
        integers_at(n, 25),
        position.reshape(position.size // dim, dim),
        floats_at(n, f, 5),
    )


class Work(NamedTuple):
    """Arrays that a step fills: the stages' rates, and scratch.

    Attributes:
        rates: (stages, n, B) x' at the stage before.
        predicted: (stages, P, B) f(x_hat) + g_hat there.
        slopes: (stages, P, B) corrections of the state observers at the stage.
        input_slopes: (stages, Q, B) those of the input observers.
        w: (n, B) disturbance.
        rho: (rows, B) funnels of the state observers.
        omega: those of the input observers.
        terms: (E, d, B) of the law.
        velocity: (N * d, B) likewise.
        drift: (n, B) likewise.
    """

    rates: FloatArray
    predicted: FloatArray
    slopes: FloatArray
    input_slopes: FloatArray
    w: FloatArray
    rho: FloatArray
    omega: FloatArray
    terms: FloatArray
    velocity: FloatArray
    drift: FloatArray
