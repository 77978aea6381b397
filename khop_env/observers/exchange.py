"""A round of messages: everybody measures and sends, what arrives is merged, and an estimator gets it."""

from __future__ import annotations

import functools
from typing import Any

import numpy as np
from numpy.typing import NDArray

from khop_env.network import Channel
from khop_env.observers.base import Memory, PlantState
from khop_env.observers.estimators import Estimator, Relay
from khop_env.observers.layout import FloatArray, IntArray
from khop_env.observers.merging import Sources, merge
from khop_env.observers.rounds import Rounds
from khop_env.observers.scalar import LANES
from khop_env.threads import Range, Threads

CHANNEL = "channel."
"""Names of the channel's arrays in the memory of observers begin so."""


class Exchange:
    """Message rounds of many environments. Methods that take a `part` touch the environments in that range only.

    Args:
        channel: the links.
        estimator: prepared.
        sources: where pairs may hear of their targets.
        states: number of components of the fleet's state.
        threads: that share the environments.

    Attributes:
        own: the estimator if it is one of the library's, which works on ranges of environments; else None: what another
            one does, a class derived from the library's included, may not be divided.
        lag: (pairs, B) time from the messages that were merged last to the time of the predictions, in s.
    """

    def __init__(self, channel: Channel, estimator: Estimator, sources: Sources, states: int, threads: Threads) -> None:
        self._channel, self._estimator, self._threads = channel, estimator, threads
        self._sources: Any = tuple(sources)
        library: Any = estimator if type(estimator) in (Rounds, Relay) else None
        self.own: Rounds | Relay | None = library
        self.lag = np.zeros((len(sources.column), channel.num_envs))
        self._noise = channel.network.noise
        self._noisy = np.zeros((states if self._noise else 0, channel.num_envs))
        self._some_late = channel.network.most_rounds_late > 0
        self._some_at_once = channel.network.fewest_rounds_late == 0
        self._names = [(name, CHANNEL + name) for name in channel.allocate()]

    def allocate(self) -> Memory:
        """The channel's memory, zeroed."""
        return {CHANNEL + name: values for name, values in self._channel.allocate().items()}

    def of_channel(self, memory: Memory) -> Memory:
        """The channel's part of the observers' memory."""
        return {name: memory[key] for name, key in self._names}

    def begin(
        self, channel: Memory, state: PlantState, up: NDArray[np.bool_] | None, due: NDArray[np.bool_], part: Range
    ) -> None:
        """Measure what is to be sent, and decide what is lost and what arrives.

        Args:
            channel: `of_channel`.
            state: now.
            up: (L, B) links that are up; None for all.
            due: (B,) environments in which there is a round.
            part: range of environments.
        """
        self._channel.measured(channel, state.x, self._noisy, part)
        self._channel.begin_round(channel, up, due, part)

    def merge_late(self, channel: Memory, state: PlantState, t: FloatArray, part: Range) -> bool:
        """Take over fresher states from messages of earlier rounds; whether any lags behind `t`, that of predictions.

        Args:
            channel: `of_channel`, after `begin`.
            state: now.
            t: (B,) in s.
            part: range of environments.
        """
        return self._some_late and self._merge(True, channel, state, t, part)

    def parts(self, state: PlantState) -> tuple[FloatArray, ...]:
        """Arrays of what all agents send now; a library's estimator doesn't read their values here.

        Raises:
            ValueError: if the estimator's message hasn't its width.
        """
        memory, estimator = state.memory, self._estimator
        added = estimator.message(state)
        if (rows := sum(map(len, added))) != estimator.width:
            raise ValueError(f"estimator {estimator.name!r}: message() has {rows} rows, its width is {estimator.width}")
        if self.own is None:
            added = [np.require(values, np.float64, ["C", "W"]) for values in added]  # as compiled code takes them
        shared = (memory[name] for name in ("center", "error", "stamp", "hops", "said", "data"))
        return (state.t[None], self._noisy if self._noise else state.x, *shared, *added)

    def send(
        self, channel: Memory, state: PlantState, due: NDArray[np.bool_], parts: tuple[FloatArray, ...], part: Range
    ) -> None:
        """Everybody sends what it knows now; messages without delay arrive.

        Args:
            channel: `of_channel`, after `begin`.
            state: now.
            due: (B,) environments in which there is a round.
            parts: as `parts` returns them.
            part: range of environments.
        """
        self._channel.send(channel, parts, due, part)
        if self._some_at_once:
            self._merge(False, channel, state, state.t, part)  # nothing has to be moved

    def receive(self, channel: Memory, state: PlantState, due: NDArray[np.bool_], part: Range) -> None:
        """The estimator uses what has arrived; one that isn't the library's, in all environments at once.

        Args:
            channel: `of_channel`, after `send`.
            state: now.
            due: (B,) environments in which there is a round.
            part: range of environments.
        """
        receive = functools.partial(self._channel.receive, channel)
        if self.own is not None:
            self.own.receive(state, functools.partial(receive, part=part), due, part)
            return

        def take(link: IntArray, row: IntArray, held: FloatArray) -> None:
            self._threads.run(lambda part: receive(link, row, held, part), self._threads.ranges(len(due), LANES))

        self._estimator.receive(state, take, due)

    def _merge(self, late: bool, channel: Memory, state: PlantState, t: FloatArray, part: Range) -> bool:
        memory = state.memory
        return merge(
            self._sources,
            late,
            channel["sent"],
            channel["round"],
            channel["newest"],
            channel["heard"],
            self._noise,
            memory["even_since"],
            t,
            state.t,
            memory["center"],
            memory["error"],
            memory["stamp"],
            memory["hops"],
            memory["arrived"],
            memory["data"],
            self.lag,
            *part,
        )
