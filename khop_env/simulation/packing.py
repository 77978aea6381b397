"""The arrays of a compiled step, as few arguments, and how compiled code finds its way in them.

Every argument of a compiled call takes time, some 50 ns an array; the equations alone are more than 60.
"""

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


# Numbers of arrays in the order of `System`. Integers: 7 in `runs`, 7 in `estimates`, 6 in `terms`, 7 in `edges`, 10 in
# `states`, 10 in `inputs`, `input_runs`, `sizes`; floats: 1, 1, 3, 1, 2, 2, 3 in `rho`, 3 in `omega`, and both sums.
_INTEGERS, _FLOATS = 49, 18


@pasted
def _integers(integers: IntArray, q: int) -> IntArray:
    """Array q of the integers of `packed`."""
    return integers[integers[q] : integers[q + 1]]


@pasted
def _floats(integers: IntArray, floats: FloatArray, q: int) -> FloatArray:
    """Array q of the floats."""
    return floats[integers[_INTEGERS + 1 + q] : integers[_INTEGERS + 2 + q]]


@pasted
def _pairs(n: IntArray, f: FloatArray, q: int, r: int) -> Any:
    """The fields of `PairArrays`, whose first array of integers is q and of floats r."""
    return (
        _integers(n, q),
        _integers(n, q + 1),
        _integers(n, q + 2),
        _integers(n, q + 3),
        _integers(n, q + 4),
        _integers(n, q + 5),
        _floats(n, f, r),
        _floats(n, f, r + 1),
        _integers(n, q + 6),
        _integers(n, q + 7),
        _integers(n, q + 8),
        _integers(n, q + 9),
    )


@pasted
def _runs(n: IntArray, f: FloatArray, q: int, r: int) -> Any:
    """The fields of `Runs`, likewise."""
    return (
        _integers(n, q),
        _integers(n, q + 1),
        _integers(n, q + 2),
        _integers(n, q + 3),
        _integers(n, q + 4),
        _integers(n, q + 5),
        _integers(n, q + 6),
        _floats(n, f, r),
    )


@pasted
def terms_in(n: IntArray, f: FloatArray) -> Any:
    """The fields of `TermArrays` of a system."""
    dim = _integers(n, 48)[0]
    positions = _integers(n, 19)
    return (
        _integers(n, 14),
        _integers(n, 15),
        _floats(n, f, 2),
        _floats(n, f, 3),
        _integers(n, 16),
        _integers(n, 17),
        _integers(n, 18),
        _floats(n, f, 4),
        positions.reshape(positions.size // dim, dim),
    )


@pasted
def edges_in(n: IntArray, f: FloatArray) -> Any:
    """The fields of `EdgeArrays`."""
    dim = _integers(n, 48)[0]
    own, other, position = _integers(n, 21), _integers(n, 22), _integers(n, 26)
    return (
        _integers(n, 20),
        own.reshape(own.size // dim, dim),
        other.reshape(other.size // dim, dim),
        _integers(n, 23),
        _integers(n, 24),
        _integers(n, 25),
        position.reshape(position.size // dim, dim),
        _floats(n, f, 5),
    )


@pasted
def runs_in(n: IntArray, f: FloatArray) -> Any:
    """The fields of `Runs` of all agents."""
    return _runs(n, f, 0, 0)


@pasted
def estimates_in(n: IntArray, f: FloatArray) -> Any:
    """Those of the estimates whose observers know the drift."""
    return _runs(n, f, 7, 1)


@pasted
def states_in(n: IntArray, f: FloatArray) -> Any:
    """The fields of `PairArrays` of the state observers."""
    return _pairs(n, f, 27, 6)


@pasted
def inputs_in(n: IntArray, f: FloatArray) -> Any:
    """Those of the input observers."""
    return _pairs(n, f, 37, 8)


@pasted
def rho_in(n: IntArray, f: FloatArray) -> Any:
    """The coefficients of the state observers' funnels."""
    return _floats(n, f, 10), _floats(n, f, 11), _floats(n, f, 12)


@pasted
def omega_in(n: IntArray, f: FloatArray) -> Any:
    """Those of the input observers."""
    return _floats(n, f, 13), _floats(n, f, 14), _floats(n, f, 15)


@pasted
def sums_in(n: IntArray, f: FloatArray) -> Any:
    """[M_i^-1 1]_a of both."""
    return _floats(n, f, 16), _floats(n, f, 17)


@pasted
def input_runs_in(n: IntArray) -> IntArray:
    """`System.input_runs`."""
    return _integers(n, 47)


@pasted
def all_drifts_in(n: IntArray) -> bool:
    """Whether every estimate has a drift."""
    return _integers(n, 48)[1] > 0
