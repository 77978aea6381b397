"""Actuators: from actions to inputs, with a bounded derivative of g where a policy's actions jump.

The input observer's theorem requires inputs with a bounded derivative (Assumption 2-ii of the paper). A policy changes
its action once in a control period, by any amount, so with `Direct` only the state observer's theorem holds; the others
limit how fast the inputs change. Inputs are fractions of the input limits here.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, is_dataclass
from typing import Protocol

import numpy as np

from khop_env.env.period import DIRECT, HOLD, LAG, OTHER, SLEW
from khop_env.observers import FloatArray
from khop_env.physics import did_you_mean


class Actuator(Protocol):
    """Turns commands into inputs, step by step."""

    def __call__(self, command: FloatArray, u: FloatArray, dt: float, step: int, steps: int) -> FloatArray:
        """Inputs in force during simulator step `step` of `steps` in this control period.

        Args:
            command: (B, m) commanded inputs, as fractions of the limits.
            u: (B, m) the inputs before.
            dt: length of the step in s.
            step: its number within the control period, from 0.
            steps: simulator steps in a control period.
        """
        ...


@dataclass(frozen=True)
class Direct(Actuator):
    """The input is the command, held over the control period."""

    def __call__(self, command: FloatArray, u: FloatArray, dt: float, step: int, steps: int) -> FloatArray:
        """The command."""
        return command


@dataclass(frozen=True)
class Lag(Actuator):
    """First-order lag, u' = (command - u) / time_constant, sampled exactly.

    Attributes:
        time_constant: in s, positive.
    """

    time_constant: float = 0.1

    def __post_init__(self) -> None:
        _require_positive(self, "time_constant")

    def __call__(self, command: FloatArray, u: FloatArray, dt: float, step: int, steps: int) -> FloatArray:
        """Output of the lag after the step."""
        return u - math.expm1(-dt / self.time_constant) * (command - u)


@dataclass(frozen=True)
class SlewLimit(Actuator):
    """The input follows the command at a limited rate.

    Attributes:
        rate: in 1/s, as a fraction of the input limit: at 10 it takes 0.1 s from zero to full.
    """

    rate: float = 10.0

    def __post_init__(self) -> None:
        _require_positive(self, "rate")

    def __call__(self, command: FloatArray, u: FloatArray, dt: float, step: int, steps: int) -> FloatArray:
        """As near to the command as the rate allows."""
        most = self.rate * dt
        return u + np.minimum(np.maximum(command - u, -most), most)


@dataclass(frozen=True)
class Hold(Actuator):
    """First-order hold: the input goes to the command in a straight line over the control period."""

    def __call__(self, command: FloatArray, u: FloatArray, dt: float, step: int, steps: int) -> FloatArray:
        """The next point of the line."""
        return u + (command - u) / (steps - step)


ACTUATORS: dict[str, type[Actuator]] = {"direct": Direct, "lag": Lag, "slew": SlewLimit, "hold": Hold}
"""Actuators by name, without parameters."""


def as_actuator(actuator: str | Actuator) -> Actuator:
    """An actuator from its name, with default parameters; an `Actuator` is returned as it is.

    Raises:
        ValueError: for an unknown name, or an object that isn't an `Actuator`.
    """
    if not isinstance(actuator, str):
        if not callable(actuator) or isinstance(actuator, type):
            raise ValueError(f"actuator must be a name or an Actuator, e.g. Lag(time_constant=0.2); got {actuator!r}")
        return actuator
    if actuator not in ACTUATORS:
        raise ValueError(
            f"no actuator {actuator!r}; {did_you_mean(actuator, ACTUATORS)} (or an object, e.g. Lag(time_constant=0.2))"
        )
    return ACTUATORS[actuator]()


def compiled_form(actuator: Actuator, dt: float, step: int, steps: int) -> tuple[int, float]:
    """Kind and parameter of the library's own actuators for `period.actuate`; OTHER and 0 for all others."""
    kind = type(actuator)
    if kind is Direct:
        return DIRECT, 0.0
    if kind is Lag:
        return LAG, math.expm1(-dt / actuator.time_constant)  # type: ignore[attr-defined]
    if kind is SlewLimit:
        return SLEW, float(actuator.rate * dt)  # type: ignore[attr-defined]
    if kind is Hold:
        return HOLD, float(steps - step)
    return OTHER, 0.0


def described(part: object) -> str:
    """Text that is the same for equal actuators, disturbances or bounds: the class, and a dataclass's parameters."""
    return repr(part) if is_dataclass(part) else type(part).__name__


def _require_positive(actuator: Actuator, name: str) -> None:
    value = getattr(actuator, name)
    if not 0.0 < value < math.inf:
        raise ValueError(f"{type(actuator).__name__}.{name} must be positive and finite; got {value!r}")
