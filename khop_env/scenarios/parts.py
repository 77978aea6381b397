"""The types of a scenario's parts: mistakes get a message that says what to write."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import numpy as np

from khop_env.observers import TargetObservers
from khop_env.physics import AgentModel, Disturbance
from khop_env.simulation import Arena


def require_parts(name: str, parts: Mapping[str, Any]) -> None:
    """Refuse parts of a scenario that are of a wrong type.

    Args:
        name: of the scenario.
        parts: "models", "observers", "relay", "disturbance", "arena" and "law", as they were given.

    Raises:
        ValueError: naming the first that is wrong, its value and what was expected.
    """
    expected = {
        "models": ("one AgentModel per agent, e.g. (SingleIntegrator(),) * 8", _sequence(parts["models"])),
        "observers": ("None, or one TargetObservers per agent", _options(parts["observers"])),
        "disturbance": (
            "None or a Disturbance, an object and not its class, e.g. Sinusoid(0.3)",
            parts["disturbance"] is None or isinstance(parts["disturbance"], Disturbance),
        ),
        "arena": (
            "None or an Arena, e.g. Arena(radius=0.2)",
            parts["arena"] is None or isinstance(parts["arena"], Arena),
        ),
        "law": (
            "a LawChoice, e.g. LawChoice('tanh', {'gain': 2.0})",
            hasattr(parts["law"], "name") and isinstance(getattr(parts["law"], "parameters", None), Mapping),
        ),
    }
    for part, (what, right) in expected.items():
        if not right:
            raise ValueError(f"scenario {name!r}: {part} must be {what}; got {parts[part]!r}")
    options = parts["observers"] or ()
    for what, values in (
        ("relay", [parts["relay"]]),
        ("the drift of its observers", [option.drift for option in options]),
        ("the input_observer of its observers", [option.input_observer for option in options]),
    ):
        for value in values:
            if not isinstance(value, bool | np.bool):
                raise ValueError(f"scenario {name!r}: {what} must be True or False; got {value!r}")


def _sequence(models: Any) -> bool:
    return isinstance(models, Sequence) and not isinstance(models, str | AgentModel)


def _options(observers: Any) -> bool:
    return observers is None or (
        isinstance(observers, Sequence) and all(isinstance(option, TargetObservers) for option in observers)
    )
