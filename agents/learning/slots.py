"""Features by slot, for networks that treat all slots alike, as many as there are."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import cached_property

import numpy as np
from numpy.typing import NDArray

from agents.learning.scaling import ObservationScaler
from agents.policy import EnvDescription
from khop_env.env import ObservationLayout
from khop_env.env.layout import Float32Array


@dataclass(frozen=True, eq=False)
class SlotScaler:
    """Computes features of uniform observations, slot by slot: an agent's own, then those of each slot.

    The first feature of a slot is its validity; if that is 0, all are 0.

    Attributes:
        one: computes the features of observations with one slot.
    """

    one: ObservationScaler

    @classmethod
    def of(cls, env: EnvDescription, rates: bool) -> SlotScaler:
        """The scaler of an environment, and of others with the same columns and any number of slots.

        Args:
            env: description of an environment with uniform observations.
            rates: whether features include rates of change, each beside what changes.

        Raises:
            ValueError: if there are no slots, or slots have different columns.
        """
        names, units = one_slot(list(env.layouts.values()))
        return cls(ObservationScaler.of_columns(env, names, units, rates))

    @property
    def rate(self) -> float:
        """Factor of the differences of positions, in 1/m."""
        return self.one.rate

    @cached_property
    def own(self) -> NDArray[np.int64]:
        """Own features, among those of observations with one slot."""
        return np.flatnonzero(self._is_own)

    @cached_property
    def slot(self) -> NDArray[np.int64]:
        """Features of the slot, among those of observations with one slot; its validity first."""
        return np.flatnonzero(~self._is_own)

    @property
    def _columns(self) -> int:
        """Number of own columns: the slot's validity is the first one after them."""
        return int(self.one.valid.min())

    @property
    def _is_own(self) -> NDArray[np.bool_]:
        return np.concatenate([np.arange(len(self.one.scale)), self.one.moving]) < self._columns

    def __call__(self, observations: Float32Array, before: Float32Array | None) -> Float32Array:
        """Features (..., own + slots * slot).

        Args:
            observations: (..., D), with any number of slots.
            before: (..., D) one control period earlier; None at the beginning of an episode, where rates are 0.
        """
        each = self.one(self._each(observations), None if before is None else self._each(before))
        slots = each[..., self.slot]
        return np.concatenate([each[..., 0, self.own], slots.reshape(*slots.shape[:-2], -1)], axis=-1)

    def _each(self, observations: Float32Array) -> Float32Array:
        """Observations with one slot (..., slots, D'), of each slot."""
        count, width = self._columns, len(self.one.scale) - self._columns
        slots = observations[..., count:].reshape(*observations.shape[:-1], -1, width)
        own = np.broadcast_to(observations[..., None, :count], (*slots.shape[:-1], count))
        return np.concatenate([own, slots], axis=-1)


def slot_widths(layout: ObservationLayout) -> tuple[int, int]:
    """How many columns of an observation are the agent's own, which come first, and how many each slot has.

    Raises:
        ValueError: if there are no slots, or not all have so many columns.
    """
    starts = [column for column, name in enumerate(layout.names) if name.endswith(".valid")]
    if not starts:
        raise ValueError(f"{layout.agent!r} observes no other agents, and attention needs slots")
    ends = [*starts[1:], len(layout)]
    widths = {end - start for start, end in zip(starts, ends, strict=True)}
    if len(widths) > 1:
        raise ValueError(f"attention needs slots with equally many columns; those of {layout.agent!r} have {widths}")
    return starts[0], widths.pop()


def one_slot(layouts: Sequence[ObservationLayout]) -> tuple[tuple[str, ...], list[list[str]]]:
    """Names and units of the own columns and those of a slot, of all agents together, as if there were one slot.

    Where agents of several types differ, a name has them all: "own.vx or own.heading.cos".

    Raises:
        ValueError: if there are no slots, or slots have different columns.
    """
    own, width = slot_widths(layouts[0])
    found: list[dict[str, str]] = [{} for _ in range(own + width)]  # unit by name
    for layout in layouts:
        for column, field in enumerate(layout.fields[: own + width * len(layout.slots)]):  # no padding
            name = field.name if column < own else f"slot0.{field.name.partition('.')[2]}"
            found[column if column < own else own + (column - own) % width][name] = field.unit
    return tuple(" or ".join(sorted(each)) for each in found), [list(each.values()) for each in found]
