"""Estimators over a network: what an agent makes of the messages that it gets."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol, TypeAlias, runtime_checkable

import numpy as np
from numpy.typing import NDArray

from khop_env.network import Network
from khop_env.observers.base import Extremes, Memory, PlantState
from khop_env.observers.design import ObserverDesign
from khop_env.observers.layout import FloatArray, IntArray
from khop_env.threads import Range

Take: TypeAlias = Callable[[IntArray, IntArray, FloatArray], None]
"""take(link (C,), row (C,), held (C, B)): copy into `held` what has just come over links, from rows of what is sent."""


@runtime_checkable
class Estimator(Protocol):
    """Makes estimates from messages; one class is all that an estimator of your own needs.

    `Networked` stores and forwards stamped states anyway, predicts them, and clips every estimate into the box that
    they certify. So an estimator only says what more is sent, and which estimates it proposes.

    Attributes:
        name: e.g. "relay".
        width: rows that it adds to what all agents send in a round; once prepared.
        proposal: (pairs,) of `design.knowledge`: first row of each pair's estimate in the memory called `proposed`, or
            -1 to take the box's centre.
        proposed: name of that memory; "" for none.
    """

    name: str
    width: int
    proposal: IntArray
    proposed: str

    def prepare(self, design: ObserverDesign, network: Network, num_envs: int, first_row: int) -> None:
        """Get ready.

        Args:
            design: the pairs and funnels.
            network: how often there is a round, and what becomes of messages.
            num_envs: number of environments B.
            first_row: the row at which its own part of what is sent begins. Before it come the message's time, the
                fleet's states (n), and the predictions (P), stamps and hops (pairs each) of `design.knowledge`.
        """
        ...

    def allocate(self) -> Memory:
        """Its own memory, zeroed, by names that nobody else uses."""
        ...

    def reset(self, memory: Memory, env_ids: IntArray, first_guess: FloatArray) -> None:
        """Start anew in the environments `env_ids`, from the `first_guess` (n,) of the fleet's states."""
        ...

    def predict(self, memory: Memory, t: FloatArray, dt: float) -> None:
        """Move its estimates from the times `t` (B,) by `dt` seconds, without messages."""
        ...

    def message(self, state: PlantState) -> list[FloatArray]:
        """Its own part of what all agents send now: arrays (rows, B), `width` rows in all."""
        ...

    def receive(self, state: PlantState, take: Take, due: NDArray[np.bool_]) -> None:
        """Use the messages of a round, in the environments that are `due` (B,); the others keep every bit."""
        ...

    def raise_extremes(self, state: PlantState, extremes: Extremes) -> None:
        """Raise running maxima of ratios that it guarantees; may do nothing."""
        ...


class Relay:
    """States are passed on with their stamps and predicted by the model: the estimate is the certified box's centre."""

    name = "relay"
    proposed = ""
    width = 0
    divisible = True

    def prepare(self, design: ObserverDesign, network: Network, num_envs: int, first_row: int) -> None:
        """Get ready for the pairs of `design`; the `network`, `num_envs` and `first_row` don't matter."""
        self.proposal = np.full(design.knowledge.pairs, -1)

    def allocate(self) -> Memory:
        """No memory."""
        return {}

    def reset(self, memory: Memory, env_ids: IntArray, first_guess: FloatArray) -> None:
        """Nothing to do."""

    def predict(self, memory: Memory, t: FloatArray, dt: float, part: Range | None = None) -> None:
        """Nothing to do: no estimates of its own in `memory` move from `t` by `dt`, in any `part`."""

    def message(self, state: PlantState) -> list[FloatArray]:
        """Nothing more."""
        return []

    def receive(self, state: PlantState, take: Take, due: NDArray[np.bool_], part: Range | None = None) -> None:
        """Nothing to `take` from messages of its own, in whatever `part` is `due`; `state` stays as it is."""

    def raise_extremes(self, state: PlantState, extremes: Extremes, part: Range | None = None) -> None:
        """No ratios."""
