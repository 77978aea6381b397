"""What an environment has to remember, and what it returns."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import numpy as np
from numpy.typing import NDArray

from khop_env.env.actuators import Actuator, described
from khop_env.env.layout import Float32Array
from khop_env.env.tasks import Task
from khop_env.observers import FloatArray, IntArray
from khop_env.physics import Fleet
from khop_env.simulation import SimulatorState

INFO_KEYS = (
    "task_error",
    "max_normalized_disagreement",
    "max_error_to_bound",
    "clipped_observations",
    "clipped_actions",
)
"""Keys of every info: the agent's root mean square error along its task edges in m; the largest |xi| / rho and
|x_tilde| / delta (inputs: |mu| / omega, |g_tilde| / theta) of all observers since the last action, below 1 by
guarantee; entries of this agent's observation and action that were clipped."""

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
        environment: what the state belongs to, as `signature` gives it.
        routes: the leaders' draws and where they began; empty without leaders.
        generators: one per copy; None before the first reset.
        seeded: (B,) whether a copy was ever reset with a seed.
    """

    simulator: SimulatorState
    inputs: FloatArray
    cycles: IntArray
    over: NDArray[np.bool_]
    environment: Mapping[str, tuple[str, ...]]
    routes: tuple[FloatArray, ...]
    generators: list[np.random.Generator | None]
    seeded: NDArray[np.bool_]

    def require_of(self, environment: Mapping[str, tuple[str, ...]]) -> None:
        """Refuse an environment that the state doesn't belong to.

        Raises:
            ValueError: naming what differs, and up to three things that only one of the two has.
        """
        for what, mine in environment.items():
            theirs = self.environment[what]
            if theirs != mine:
                raise ValueError(
                    f"can't restore: the state is of another environment, the {what} differ: {_only(theirs, mine)} "
                    f"there, {_only(mine, theirs)} here; make both with the same arguments"
                )


def signature(fleet: Fleet, task: Task, actuator: Actuator) -> dict[str, tuple[str, ...]]:
    """What two environments must have in common for one to continue from the other's state, in words."""
    ids, places = fleet.ids, task.displacement.tolist()
    leaders = [f"{ids[i]} at {speed} m/s" for i, speed in zip(task.leaders, task.leader_speed, strict=True)]
    edges = [f"{ids[i]} to {ids[j]} by {d} m" for (i, j), d in zip(task.edges.tolist(), places, strict=True)]
    return {
        "tasks": (task.name,),
        "leaders": tuple(leaders),
        "task edges": tuple(edges),
        "actuators": (described(actuator),),
    }


def _only(one: tuple[str, ...], other: tuple[str, ...]) -> str:
    """What only `one` has, shortened."""
    known = set(other)
    own = [text for text in one if text not in known]
    return ", ".join(own[:3] + ["..."] * (len(own) > 3)) or ("no others" if one else "none")
