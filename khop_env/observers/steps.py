"""A step of observers over a network, as work that threads share where it may be divided."""

from __future__ import annotations

import itertools
import operator
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field
from typing import Generic, TypeAlias, TypeVar

import numpy as np
from numpy.typing import NDArray

from khop_env.compiled import compiled
from khop_env.observers.base import Memory, PlantState
from khop_env.observers.layout import FloatArray
from khop_env.threads import Range, Threads


@dataclass
class Step:
    """What the work of one step shares.

    Attributes:
        state: at its end.
        channel: the channel's memory.
        due: (B,) environments in which there is a round.
        up: (L, B) links that are up; None for all.
        t: (B,) time at its beginning in s.
        dt: in s; 0 for the first round, after a reset.
        parts: arrays of what all agents send.
        behind: ranges in which states were merged that have to catch up.
        rounds: whether there is a round in any environment.
    """

    state: PlantState
    channel: Memory
    due: NDArray[np.bool_]
    up: NDArray[np.bool_] | None
    t: FloatArray = field(default_factory=lambda: np.zeros(0))
    dt: float = 0.0
    parts: tuple[FloatArray, ...] = ()
    behind: set[Range] = field(default_factory=set)

    def __post_init__(self) -> None:
        self.rounds = bool(self.due.any())


@compiled
def note_length(dt: float, before: FloatArray, length: FloatArray, even_since: FloatArray) -> None:
    """Note that a step of `dt` seconds begins at the times `before` (B,).

    Args:
        dt: in s.
        before: in s.
        length: (B,) of the last step; of this one on return.
        even_since: (B,) since when steps are equal, in s; changed.
    """
    for b in range(length.size):
        if abs(length[b] - dt) > 1e-9 * dt:
            even_since[b] = before[b]
        length[b] = dt


Owner = TypeVar("Owner")
Work: TypeAlias = Callable[[Owner, Step, Range], None]
"""A method that does a part of a step in a range of environments."""


class Plan(Generic[Owner]):
    """Work that is done one after the other. Where it may be divided, each range does all of it in one go.

    Args:
        work: methods, and whether they may be called with one range of environments after the other, in several
            threads at once; others are called once, with all.
    """

    def __init__(self, work: Sequence[tuple[Work[Owner], bool]]) -> None:
        groups = itertools.groupby(work, operator.itemgetter(1))
        self._groups = [(divisible, [function for function, _ in group]) for divisible, group in groups]

    def carry_out(self, owner: Owner, step: Step, threads: Threads, ranges: Sequence[Range]) -> None:
        """Do the work of `step` in all `ranges`."""
        whole = ranges[0][0], ranges[-1][1]
        for divisible, functions in self._groups:

            def work(part: Range, functions: list[Work[Owner]] = functions) -> None:
                for function in functions:
                    function(owner, step, part)

            threads.run(work, ranges if divisible else [whole])
