"""The state of an environment that is saved and restored, and types of its results."""

from __future__ import annotations

import zlib
from collections.abc import Mapping
from dataclasses import dataclass, fields, is_dataclass
from typing import Any

import networkx as nx
import numpy as np
from numpy.typing import NDArray

from khop_env.brief import brief
from khop_env.env.actuators import described
from khop_env.env.layout import Float32Array
from khop_env.env.settings import Settings
from khop_env.network import Schedule
from khop_env.observers import FloatArray, IntArray, Networked, Observers
from khop_env.physics import Disturbance, Links
from khop_env.simulation import SimulatorState
from khop_env.tasks import Task, World

SHARED_INFOS = (
    "max_normalized_disagreement",
    "max_error_to_bound",
    "clipped_observations",
    "clipped_actions",
)
"""Keys of every info beside the task's own: the largest |xi| / rho, and error over the observer's own bound, of all
observers of states and inputs since the last action, below 1 by guarantee; entries of this agent's observation and
action that were clipped; bounds that are the largest value because there is none don't count. Under a network the
bound is the certified one, neighbours' states included."""

_LONGEST = 120  # characters of a graph in a message

Infos = dict[str, NDArray[Any]]
Step = tuple[Float32Array, FloatArray, NDArray[np.bool_], NDArray[np.bool_], Infos]


@dataclass(frozen=True, eq=False)
class EnvState:
    """Everything that an environment needs to continue bit for bit; treat it as opaque.

    Attributes:
        simulator: states, estimates and the disturbances' draws.
        inputs: (m, B) inputs in force, as fractions of their limits.
        cycles: (B,) control periods since reset.
        over: (B,) whether the episode has ended, or none has begun.
        environment: properties of the environment that the state belongs to, as `signature` returns them.
        task: the task's memory, by name.
        generators: one per environment; None before the first reset.
        seeded: (B,) whether the environment was ever reset with a seed.
    """

    simulator: SimulatorState
    inputs: FloatArray
    cycles: IntArray
    over: NDArray[np.bool_]
    environment: Mapping[str, tuple[str, ...]]
    task: Mapping[str, FloatArray]
    generators: list[np.random.Generator | None]
    seeded: NDArray[np.bool_]

    __repr__ = brief

    def require_of(self, environment: Mapping[str, tuple[str, ...]]) -> None:
        """Refuse an environment that the state doesn't belong to.

        Raises:
            ValueError: if they differ; the message names the property, and up to three values of each.
        """
        for what in {**environment, **self.environment}:
            ours, theirs = environment.get(what, ()), self.environment.get(what, ())
            if theirs != ours:
                raise ValueError(
                    f"can't restore: the state is of another environment, the {what} differ: {_only(theirs, ours)} "
                    f"there, {_only(ours, theirs)} here; make both with the same arguments"
                )


def signature(
    task: Task, world: World, settings: Settings, disturbance: Disturbance | None, observers: Observers
) -> dict[str, tuple[str, ...]]:
    """Properties, in words, that two environments must have in common to continue from each other's state."""
    design = world.design
    networked = observers if isinstance(observers, Networked) else None
    steps = f"{settings.control_period:g} s in {settings.substeps} steps of order {settings.order}"
    bounds = dict.fromkeys(described(bound) for bound in (*design.states.bounds, *design.inputs.bounds))
    return {
        **task.signature(world),
        "actuators": (described(settings.actuator),),
        "control periods": (steps,),
        "networks": ("none" if networked is None else described(networked.network),),
        "estimators": () if networked is None else (networked.estimator.name,),
        "message sizes": (str(settings.message_size),),
        "schedules": () if design.schedule is None else tuple(map(_as_text, design.schedule.parts)),
        "disturbances": ("none" if disturbance is None else described(disturbance),),
        "bounds": tuple(bounds),
        "design rules": (design.states.rule,),
        "numbers of hops": (f"k = {design.k}",),
    }


def _as_text(schedule: Schedule) -> str:
    """Text that is the same for equal schedules; graphs as their links."""

    def text(value: object) -> str:
        if isinstance(value, nx.Graph):
            links = str(sorted(Links.of(value).index))
            return links if len(links) < _LONGEST else f"{len(Links.of(value))} links {zlib.crc32(links.encode()):08x}"
        return f"({', '.join(map(text, value))})" if isinstance(value, tuple) else repr(value)

    if not is_dataclass(schedule):
        return type(schedule).__name__
    values = (f"{field.name}={text(getattr(schedule, field.name))}" for field in fields(schedule))
    return f"{type(schedule).__name__}({', '.join(values)})"


def _only(first: tuple[str, ...], second: tuple[str, ...]) -> str:
    """The entries that only `first` has, shortened."""
    known = set(second)
    own = [text for text in first if text not in known]
    return ", ".join(own[:3] + ["..."] * (len(own) > 3)) or ("no others" if first else "none")
