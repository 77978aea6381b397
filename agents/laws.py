"""Feedback laws by name: scenarios name theirs by a string, and nothing below this package knows what it means."""

from __future__ import annotations

from collections.abc import Callable

from agents.consensus import TanhConsensus
from khop_env.physics import did_you_mean
from khop_env.scenarios import LawChoice
from khop_env.simulation import Law

LAWS: dict[str, Callable[..., Law]] = {"tanh": TanhConsensus}


def make_law(choice: LawChoice | str) -> Law:
    """The law of a scenario, e.g. `make_law(scenario.law)`, or one by name with default parameters.

    Raises:
        ValueError: for an unknown name or parameter.
    """
    choice = LawChoice(choice) if isinstance(choice, str) else choice
    if choice.name not in LAWS:
        raise ValueError(f"no law {choice.name!r}; {did_you_mean(choice.name, LAWS)}")
    try:
        return LAWS[choice.name](**choice.parameters)
    except TypeError as error:
        raise ValueError(
            f"law {choice.name!r} doesn't take the parameters {dict(choice.parameters)}: {error}"
        ) from error
