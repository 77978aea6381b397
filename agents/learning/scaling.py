"""Features of observations for networks: fixed scales, invalid slots set to zero, rates of change."""

from __future__ import annotations

from collections.abc import Collection, Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agents.policy import EnvDescription
from khop_env.env import ObservationLayout
from khop_env.env.layout import Float32Array
from khop_env.tasks.edges import axis_names

METRE = 0.5  # lengths are in units of 2 m, speeds in units of 2 m/s
SECOND = 2.0  # ages of information are in units of 0.5 s
RATE = 0.25  # rates of change of positions are in units of 4 m/s
MOST = 10.0  # features are clipped to this magnitude: agents under early policies move far away
SCALES = {"m": METRE, "m/s": METRE, "s": SECOND}


@dataclass(frozen=True, eq=False)
class ObservationScaler:
    """Computes features of uniform observations: scaled columns, and rates of change of positions.

    Each slot is multiplied by its validity, and its rates also by its validity one observation earlier. Agents with a
    heading get others' positions and displacements in their own frame, in which their inputs act. Scales are constants,
    not running statistics, which agents under early policies, far away, would distort. Rates are differences to the
    previous observation: they indicate the velocity of agents whose state doesn't contain it, if estimates are good.

    Attributes:
        scale: (D,) factor of each column.
        valid: (D,) index of the column with each column's validity; D, for a constant 1, outside of slots.
        moving: (R,) columns of positions; empty if features hold no rates.
        rate: factor of the differences of positions, in 1/m.
        headed: (H,) one-hot columns of the agent types with a heading; empty if there are none.
        heading: (2,) columns of the heading's cosine and sine.
        planar: (K, 2) pairs of features that are rotated into the agent's own frame.
        slots: (S, C) columns of each slot, if slots are put in the order of their distances, the nearest first; empty
            if they stay in the observation's order.
        places: (S, d) columns of the slots' positions; likewise.
    """

    scale: Float32Array
    valid: NDArray[np.int64]
    moving: NDArray[np.int64]
    rate: float
    headed: NDArray[np.int64]
    heading: NDArray[np.int64]
    planar: NDArray[np.int64]
    slots: NDArray[np.int64]
    places: NDArray[np.int64]

    @classmethod
    def of(cls, env: EnvDescription, rates: bool, nearest: bool = False) -> ObservationScaler:
        """The scaler of an environment, with scales by unit.

        Args:
            env: description of an environment with uniform observations.
            rates: whether features include rates of change.
            nearest: whether slots are ordered by distance.

        Raises:
            ValueError: if own positions are in different columns for different agents.
        """
        layouts = list(env.layouts.values())
        units = list(zip(*([field.unit for field in layout.fields] for layout in layouts), strict=True))
        names = max(layouts, key=lambda layout: len(layout.slots)).names
        return cls.of_columns(env, names, units, rates, nearest)

    @classmethod
    def of_columns(
        cls,
        env: EnvDescription,
        names: Sequence[str],
        units: Sequence[Collection[str]],
        rates: bool,
        nearest: bool = False,
    ) -> ObservationScaler:
        """The scaler of observations with certain columns, of which the own ones are those of the environment.

        Args:
            env: the environment.
            names: of the columns.
            units: of each column; of several agents where these differ.
            rates: as for `of`.
            nearest: likewise.

        Raises:
            ValueError: as `of`.
        """
        scale = np.array([next((SCALES[u] for u in each if u in SCALES), 1.0) for each in units], np.float32)
        valid = np.full(len(names), len(names))
        for column, name in enumerate(names):
            slot, _, rest = name.partition(".")
            if slot.startswith("slot") and rest != "valid":
                valid[column] = names.index(f"{slot}.valid")
        own = _own_position(env)
        moving = [*own, *_vectors(names, len(own), "position")] if rates else []
        headed, heading = _headings(list(env.layouts.values()))
        planar = []
        if len(own) == 2 and len(headed):
            planar = _vectors(names, 2, "position", "displacement")
            planar += [len(names) + q for q, column in enumerate(moving) if column in planar]
        return cls(
            scale,
            valid,
            np.array(moving, np.int64),
            RATE / env.control_period,
            headed,
            heading,
            np.array(planar, np.int64).reshape(-1, 2),
            *_slots(names, len(own) if nearest else 0),
        )

    @property
    def size(self) -> int:
        """Number of features."""
        return len(self.scale) + len(self.moving)

    def __call__(self, observations: Float32Array, before: Float32Array | None) -> Float32Array:
        """Features (..., size).

        Args:
            observations: (..., D).
            before: (..., D) one control period earlier; None at the beginning of an episode, where rates are 0.
        """
        if len(self.slots):
            observations, before = self._ordered(observations, before)
        shape = observations.shape[:-1]
        features = np.zeros((*shape, self.size), np.float32)
        columns = len(self.scale)
        np.multiply(observations, self.scale, out=features[..., :columns])
        if before is not None and len(self.moving):
            changes = observations[..., self.moving] - before[..., self.moving]
            np.multiply(changes, np.float32(self.rate), out=features[..., columns:])
        np.minimum(np.maximum(features, -MOST, out=features), MOST, out=features)
        counts = np.concatenate([observations, np.ones((*shape, 1), np.float32)], axis=-1) > 0.5
        features[..., :columns] *= counts[..., self.valid]
        features[..., columns:] *= counts[..., self.valid[self.moving]]
        if before is not None:  # under a network slots become valid when something arrives, which is no motion
            known = np.concatenate([before, np.ones((*shape, 1), np.float32)], axis=-1) > 0.5
            features[..., columns:] *= known[..., self.valid[self.moving]]
        if len(self.planar):
            turned = observations[..., self.headed].any(axis=-1, keepdims=True)
            cos = np.where(turned, observations[..., [self.heading[0]]], np.float32(1.0))
            sin = np.where(turned, observations[..., [self.heading[1]]], np.float32(0.0))
            x, y = features[..., self.planar[:, 0]], features[..., self.planar[:, 1]]
            features[..., self.planar[:, 0]] = cos * x + sin * y
            features[..., self.planar[:, 1]] = cos * y - sin * x
        return features

    def _ordered(
        self, observations: Float32Array, before: Float32Array | None
    ) -> tuple[Float32Array, Float32Array | None]:
        """Both, with the slots in the order of the distances of the first."""
        known = observations[..., self.valid[self.places[:, 0]]] > 0.5
        distance = np.where(known, np.square(observations[..., self.places]).sum(axis=-1), np.inf)
        order = self.slots[np.argsort(distance, axis=-1, kind="stable")].reshape(*observations.shape[:-1], -1)

        def ordered(values: Float32Array) -> Float32Array:
            found = values.copy()
            found[..., self.slots.reshape(-1)] = np.take_along_axis(values, order, axis=-1)
            return found

        return ordered(observations), None if before is None else ordered(before)


def _slots(names: Sequence[str], dim: int) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Columns (S, C) of each slot and (S, dim) of its position; none without axes."""
    count = sum(name.endswith(".valid") for name in names) if dim else 0
    fields = [name.partition(".")[2] for name in names if name.startswith("slot0.")]
    missing = [f"slot{q}.{field}" for q in range(count) for field in fields if f"slot{q}.{field}" not in names]
    if missing:
        raise ValueError(
            f"nearest=True needs slots with the same columns, and there is no {missing[0]}: "
            "agents of several types have others"
        )
    slots = [[names.index(f"slot{q}.{field}") for field in fields] for q in range(count)]
    places = [[names.index(f"slot{q}.position.{axis}") for axis in axis_names(dim)] for q in range(count)]
    return np.array(slots, np.int64).reshape(count, -1 if count else 0), np.array(places, np.int64).reshape(count, dim)


def _vectors(names: Sequence[str], dim: int, *kinds: str) -> list[int]:
    """Columns "slotN.KIND.AXIS" of vectors, axis by axis."""
    split = [name.rpartition(".")[0] for name in names]
    found = dict.fromkeys(prefix for prefix in split if prefix.rpartition(".")[2] in kinds)
    return [names.index(f"{prefix}.{axis}") for prefix in found for axis in axis_names(dim)]


def _own_position(env: EnvDescription) -> tuple[int, ...]:
    """Columns of the own position, axis by axis, which must be the same for all agents."""
    found = {
        agent: tuple(env.layouts[agent].index(f"own.{name}") for name in model.position)
        for agent, model in env.models.items()
    }
    if len(set(found.values())) > 1:
        raise ValueError(f"own positions must be in the same columns for all agents; got {found}")
    return next(iter(found.values()))


def _headings(layouts: Sequence[ObservationLayout]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """One-hot columns of the types with a heading, and columns of its cosine and sine if these are the same for all."""
    headed, places = set(), set()
    for layout in layouts:
        if "own.heading.cos" in layout.names:
            headed.add(layout.index(f"own.type.{layout.agent.rpartition('_')[0]}"))
            places.add((layout.index("own.heading.cos"), layout.index("own.heading.sin")))
    if len(places) != 1:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    return np.array(sorted(headed)), np.array(places.pop())
