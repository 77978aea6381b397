"""The state that one frame shows: plain arrays of one environment."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from khop_env.observers import FloatArray
from khop_env.observers.networked import missed_rounds
from khop_env.simulation import Simulator
from khop_env.tasks import MapCanvas

Decorate = Callable[[MapCanvas], None]


class Messages(NamedTuple):
    """What has arrived over a network.

    Attributes:
        age: (pairs,) of the newest state that each pair of the observers' layout has received, in s; inf for none.
        missed: (L,) rounds by which the newest message over each link is older than one that comes on time; inf where
            nothing has arrived.
    """

    age: FloatArray
    missed: FloatArray


class Scene(NamedTuple):
    """A fleet and its observers at one instant.

    Attributes:
        t: in s.
        x: (n,) state of the fleet.
        estimates: (P,) in the order of the observers' layout.
        bounds: (P,) guaranteed bound on the error of each; inf where there is none.
        ratio: largest |e| = |xi| / rho; under a network the largest error over its certified bound.
        task_error: if there is one to show.
        decorate: draws the task's additions, below the agents.
        messages: under a network.
        up: (L,) whether each of the design's links is up; None for all.
    """

    t: float
    x: FloatArray
    estimates: FloatArray
    bounds: FloatArray
    ratio: float
    task_error: float | None = None
    decorate: Decorate | None = None
    messages: Messages | None = None
    up: NDArray[np.bool_] | None = None

    @staticmethod
    def of(simulator: Simulator, task_error: float | None = None, decorate: Decorate | None = None) -> Scene:
        """The present state of a simulator's first environment, with the largest ratio of its `running_extremes`."""
        state, observers, extremes = simulator.state, simulator.observers, simulator.running_extremes
        up, messages = observers.links_up(state), None
        if observers.by_messages:
            messages = Messages(observers.information(state).age[:, 0], missed_rounds(observers, state)[:, 0])
        return Scene(
            t=float(simulator.t[0]),
            x=simulator.x[0],
            estimates=simulator.estimates[0],
            bounds=simulator.error_bounds().bound[:, 0],
            ratio=float((extremes.relative if observers.by_messages else extremes.kept())[0]),
            task_error=task_error,
            decorate=decorate,
            messages=messages,
            up=None if up is None else up[:, 0].copy(),
        )
