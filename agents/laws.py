"""Feedback laws by name: scenarios refer to a law by a string, which is resolved here."""

from __future__ import annotations

import inspect
from collections.abc import Callable
from typing import get_type_hints

from agents.consensus import LinearConsensus, TanhConsensus
from agents.formation import FormationLaw
from agents.leader_following import LeaderFollowingLaw
from khop_env.physics import did_you_mean
from khop_env.registry import parameters_from_text
from khop_env.scenarios import LawChoice
from khop_env.scenarios.checked import describe, fits
from khop_env.simulation import Law

LAWS: dict[str, Callable[..., Law]] = {
    "tanh": TanhConsensus,
    "linear": LinearConsensus,
    "formation": FormationLaw,
    "leader_following": LeaderFollowingLaw,
}
"""Feedback laws by name."""


class LawError(ValueError):
    """The law is unknown, or a parameter is unknown or invalid.

    Attributes:
        parameter: name of the invalid parameter; None if the error isn't due to a single one.
    """

    def __init__(self, message: str, parameter: str | None = None) -> None:
        super().__init__(message)
        self.parameter = parameter


def make_law(choice: LawChoice | str) -> Law:
    """A scenario's law, e.g. `make_law(scenario.law)`, or a law by name: "tanh", "linear:gain=2,cancel_drift=true".

    Raises:
        LawError: if the name or a parameter is unknown, or a parameter has the wrong type or value.
    """
    name, _, text = choice.partition(":") if isinstance(choice, str) else (choice.name, "", "")
    if name not in LAWS:
        raise LawError(f"no law {name!r}; {did_you_mean(name, LAWS)}")
    if isinstance(choice, str):
        try:
            choice = LawChoice(name, parameters_from_text(text, get_type_hints(LAWS[name]), f"law {choice!r}"))
        except ValueError as error:
            raise LawError(str(error)) from error
    make = LAWS[choice.name]
    known = inspect.signature(make).parameters
    hints = get_type_hints(make)
    parameters = dict(choice.parameters)
    for name, value in choice.parameters.items():
        if name not in known:
            raise LawError(f"law {choice.name!r} has no parameter {name!r}; {_known(name, list(known))}", name)
        expected = hints.get(name, known[name].annotation)
        if expected in (int, float, bool, str) and not fits(value, expected):
            raise LawError(f"{name} of law {choice.name!r} must be {describe(expected)}; got {value!r}", name)
        if expected is float:
            try:
                parameters[name] = float(value)  # compiled loops take no integers of arbitrary size
            except OverflowError:
                raise LawError(f"{name} of law {choice.name!r} is too large for a number", name) from None
    try:
        return make(**parameters)
    except (TypeError, ValueError) as error:
        raise LawError(str(error)) from error


def _known(name: str, known: list[str]) -> str:
    if not known:
        return "it has no parameters"
    near = did_you_mean(name, known)
    return f"{near} (known: {', '.join(known)})" if near.startswith("did") else near
