"""From an observation to what a network gets: fixed scales, and nothing where a slot is empty."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np
from numpy.typing import NDArray

from agents.policy import EnvDescription
from khop_env.env import ObservationLayout
from khop_env.env.layout import Float32Array
from khop_env.tasks.edges import axis_names

METRE = 0.5  # a network's unit is 2 m, or 2 m/s
RATE = 0.25  # and 4 m/s in how fast positions change
MOST = 10.0  # larger scaled values are cut off: early policies run far away


@dataclass(frozen=True, eq=False)
class ObservationScaler:
    """Makes a network's features of uniform observations: scaled columns, and how fast positions change.

    Each slot is multiplied by its validity, and agents with a heading get others' positions and displacements in their
    own frame, in which their inputs act. Scales are constants, not running statistics: early policies drift far away
    and would spoil these. Changes are differences to the observation before, so that a policy knows how fast agents
    move whose velocity isn't a state, as estimates of it allow.

    Attributes:
        scale: (D,) factor of each column.
        valid: (D,) the column whose value says whether this one counts; D, for a constant 1, outside of slots.
        moving: (R,) columns that are positions; empty for features of a single observation.
        rate: factor of their changes, per m.
        headed: (H,) columns that say that an agent's type has a heading; empty where none has.
        heading: (2,) columns of its cosine and sine.
        planar: (K, 2) features that are turned into the own frame, in pairs.
    """

    scale: Float32Array
    valid: NDArray[np.int64]
    moving: NDArray[np.int64]
    rate: float
    headed: NDArray[np.int64]
    heading: NDArray[np.int64]
    planar: NDArray[np.int64]

    @classmethod
    def of(cls, env: EnvDescription, rates: bool) -> ObservationScaler:
        """Scales by unit.

        Args:
            env: the environment, with uniform observations.
            rates: whether features hold changes.

        Raises:
            ValueError: for agents whose positions stand in different columns.
        """
        layouts = list(env.layouts.values())
        units = zip(*([field.unit for field in layout.fields] for layout in layouts), strict=True)
        scale = np.array([min(METRE if unit in ("m", "m/s") else 1.0 for unit in each) for each in units], np.float32)
        names = max(layouts, key=lambda layout: len(layout.slots)).names
        valid = np.full(len(names), len(names))
        for column, name in enumerate(names):
            slot, _, rest = name.partition(".")
            if slot.startswith("slot") and rest != "valid":
                valid[column] = names.index(f"{slot}.valid")
        own = _own_position(env)
        moving = [*own, *_vectors(names, len(own), "position")] if rates else []
        headed, heading = _headings(layouts)
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
        )

    @property
    def size(self) -> int:
        """Number of features."""
        return len(self.scale) + len(self.moving)

    def __call__(self, observations: Float32Array, before: Float32Array | None) -> Float32Array:
        """Features (..., size).

        Args:
            observations: (..., D).
            before: those one control period earlier; None at the beginning of an episode, whose changes are 0.
        """
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
        if len(self.planar):
            turned = observations[..., self.headed].any(axis=-1, keepdims=True)
            cos = np.where(turned, observations[..., [self.heading[0]]], np.float32(1.0))
            sin = np.where(turned, observations[..., [self.heading[1]]], np.float32(0.0))
            x, y = features[..., self.planar[:, 0]], features[..., self.planar[:, 1]]
            features[..., self.planar[:, 0]] = cos * x + sin * y
            features[..., self.planar[:, 1]] = cos * y - sin * x
        return features


def _vectors(names: Sequence[str], dim: int, *kinds: str) -> list[int]:
    """Columns of vectors "slotN.KIND.AXIS", axis by axis."""
    split = [name.rpartition(".")[0] for name in names]
    found = dict.fromkeys(prefix for prefix in split if prefix.rpartition(".")[2] in kinds)
    return [names.index(f"{prefix}.{axis}") for prefix in found for axis in axis_names(dim)]


def _own_position(env: EnvDescription) -> tuple[int, ...]:
    """Columns of an agent's own position, axis by axis, which have to be the same for all agents."""
    found = {
        agent: tuple(env.layouts[agent].index(f"own.{name}") for name in model.position)
        for agent, model in env.models.items()
    }
    if len(set(found.values())) > 1:
        raise ValueError(f"own positions have to stand in the same columns for all agents; got {found}")
    return next(iter(found.values()))


def _headings(layouts: Sequence[ObservationLayout]) -> tuple[NDArray[np.int64], NDArray[np.int64]]:
    """Columns of the types that have a heading, and of its cosine and sine, if these are the same for all."""
    headed, places = set(), set()
    for layout in layouts:
        if "own.heading.cos" in layout.names:
            headed.add(layout.index(f"own.type.{layout.agent.rpartition('_')[0]}"))
            places.add((layout.index("own.heading.cos"), layout.index("own.heading.sin")))
    if len(places) != 1:
        return np.zeros(0, np.int64), np.zeros(0, np.int64)
    return np.array(sorted(headed)), np.array(places.pop())
