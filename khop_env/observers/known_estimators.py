"""Estimators by name, and checks of observers and estimators of a user's own."""

from __future__ import annotations

import copy
from collections.abc import Mapping

import numpy as np

from khop_env.observers.base import Memory, Observers
from khop_env.observers.estimators import Estimator, Relay
from khop_env.observers.layout import IntArray
from khop_env.observers.rounds import Rounds
from khop_env.physics import did_you_mean

ESTIMATORS: Mapping[str, type[Estimator]] = {"ppso": Rounds, "relay": Relay}
"""Estimators by name."""


def as_estimator(estimator: str | Estimator) -> Estimator:
    """An estimator by name, or a copy of an object.

    Raises:
        ValueError: for an unknown name, or an object that isn't an estimator.
    """
    if isinstance(estimator, str):
        if estimator not in ESTIMATORS:
            raise ValueError(f"no estimator {estimator!r}; {did_you_mean(estimator, ESTIMATORS)}")
        return ESTIMATORS[estimator]()
    if isinstance(estimator, type):
        raise ValueError(f"an estimator is an object, not a class: write {estimator.__name__}()")
    missing = _missing(estimator, Estimator, ("name",))
    if missing:
        raise ValueError(
            f"an estimator is a name ({', '.join(ESTIMATORS)}) or an Estimator; got {estimator!r}, which has no "
            f"{missing[0]}"
        )
    return copy.copy(estimator)


def as_observers(observers: Observers) -> Observers:
    """A realisation of the observers, as it is.

    Raises:
        ValueError: for an object that isn't one.
    """
    if isinstance(observers, type):
        raise ValueError(f"observers are an object, not a class: write {observers.__name__}()")
    missing = _missing(observers, Observers, ("name", "order", "by_messages", "copied"))
    if missing:
        raise ValueError(f"observers have what khop_env.observers.Observers says; {observers!r} has no {missing[0]}")
    return observers


def require_own_names(estimator: Estimator, own: Memory, others: Memory) -> None:
    """Refuse an estimator whose memory has names that are in use.

    Raises:
        ValueError: naming them.
    """
    if twice := [name for name in own if name in others]:
        raise ValueError(
            f"estimator {estimator.name!r}: its memory has {', '.join(map(repr, twice))}, which messages use "
            f"themselves; choose other names, e.g. '{estimator.name}.{twice[0]}'"
        )


def _missing(found: object, protocol: type, attributes: tuple[str, ...]) -> list[str]:
    """Attributes and methods that a protocol asks for and an object doesn't have."""
    methods = (name for name, member in vars(protocol).items() if callable(member) and name[0] != "_")
    return [name for name in (*attributes, *methods) if not hasattr(found, name)]


def require_memory(estimator: Estimator, components: IntArray) -> None:
    """Refuse a prepared estimator that would read or write beyond its memory.

    Args:
        estimator: prepared.
        components: (pairs,) of the state of each pair's target.

    Raises:
        ValueError: if that, its width or its proposal isn't what `Estimator` says.
    """
    memory, who = estimator.allocate(), f"estimator {estimator.name!r}"
    if not isinstance(memory, Mapping):
        raise ValueError(f"{who}: allocate() must return a dictionary of arrays, empty for none; got {memory!r}")
    if not isinstance(estimator.width, int | np.integer) or estimator.width < 0:
        raise ValueError(f"{who}: width must be the number of rows of message(), 0 for none; got {estimator.width!r}")
    if estimator.proposed and estimator.proposed not in memory:
        raise ValueError(f"{who}: proposed = {estimator.proposed!r} isn't in its memory, {', '.join(memory) or 'none'}")
    proposal = np.asarray(estimator.proposal)
    if proposal.shape != components.shape or proposal.dtype.kind != "i" or proposal.min(initial=-1) < -1:
        raise ValueError(
            f"{who}: proposal must be {components.shape} integers, a row of {estimator.proposed!r} for each pair of "
            f"design.knowledge or -1; got {proposal.dtype} of shape {proposal.shape}"
        )
    rows = len(memory[estimator.proposed]) if estimator.proposed else 0
    last = int((proposal + components).max(where=proposal >= 0, initial=0))
    if last > rows:
        raise ValueError(f"{who}: proposal asks for {last} rows, and {estimator.proposed!r} has {rows}")
