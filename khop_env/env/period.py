"""Compiled parts of a control period: inputs from commands, the end of episodes, the ratios of infos."""

from __future__ import annotations

from typing import Any

import numpy as np
from numpy.typing import NDArray

from khop_env.compiled import compiled
from khop_env.observers import FloatArray, IntArray
from khop_env.observers.base import Extremes

OTHER, DIRECT, LAG, SLEW, HOLD = range(5)  # kinds of actuators


@compiled
def actuate(
    kind: int, parameter: float, command: FloatArray, scale: FloatArray, inputs: FloatArray, physical: FloatArray
) -> None:
    """Inputs after a step of an actuator, as fractions of the limits and in their units.

    Args:
        kind: DIRECT, LAG, SLEW, HOLD, or OTHER for inputs that have been computed already.
        parameter: as `actuators.compiled_form` returns it.
        command: (m, B) commanded inputs.
        scale: (m, 1) the limits.
        inputs: (m, B) overwritten with the inputs in force.
        physical: (m, B) overwritten with these times `scale`.
    """
    for row in range(command.shape[0]):
        if kind == DIRECT:
            for env in range(command.shape[1]):
                inputs[row, env] = command[row, env]
        elif kind == LAG:
            for env in range(command.shape[1]):
                inputs[row, env] = inputs[row, env] - parameter * (command[row, env] - inputs[row, env])
        elif kind == SLEW:
            for env in range(command.shape[1]):
                change = command[row, env] - inputs[row, env]
                inputs[row, env] = inputs[row, env] + min(max(change, -parameter), parameter)
        elif kind == HOLD:
            for env in range(command.shape[1]):
                inputs[row, env] = inputs[row, env] + (command[row, env] - inputs[row, env]) / parameter
        for env in range(command.shape[1]):
            physical[row, env] = inputs[row, env] * scale[row, 0]


@compiled
def as_fractions(rows: IntArray, physical: FloatArray, limit: FloatArray, inputs: FloatArray) -> None:
    """Write `physical` (m, B) over `limit` (m, 1) into `inputs` (m, B), in some rows."""
    for q in range(rows.size):
        row = rows[q]
        for env in range(inputs.shape[1]):
            inputs[row, env] = physical[row, env] / limit[row, 0]


@compiled
def end_period(
    cycles: IntArray,
    horizon: int,
    terminated: NDArray[np.bool_],
    truncated: NDArray[np.bool_],
    over: NDArray[np.bool_],
) -> bool:
    """Count a control period in `cycles` (B,); write `truncated` (B,) and `over` (B,). True if any episode is over."""
    some = False
    for env in range(cycles.size):
        cycles[env] += 1
        truncated[env] = cycles[env] >= horizon and not terminated[env]
        over[env] = truncated[env] or terminated[env]
        some |= over[env]
    return some


@compiled
def larger_for_all(extremes: Any, normalized: FloatArray, relative: FloatArray) -> None:
    """Write the larger ratio, that of states or that of inputs, for all agents; NaN if one is.

    Args:
        extremes: the fields of `observers.Extremes` as a plain tuple, (B,) each.
        normalized: (B, N) overwritten.
        relative: (B, N) overwritten.
    """
    extremes = Extremes(*extremes)
    for env in range(normalized.shape[0]):
        first, second = extremes.normalized[env], extremes.input_normalized[env]
        normalized[env] = first if first >= second or first != first else second
        first, second = extremes.relative[env], extremes.input_relative[env]
        relative[env] = first if first >= second or first != first else second
