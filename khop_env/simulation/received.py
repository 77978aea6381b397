"""States of neighbours that arrive while links are up, in place of estimates of them.

In continuous exchange an agent knows the state of a neighbour while the link from it is up. Designs without relays
estimate neighbours, too: while the link is down the estimate is the best that an agent has.
"""

from __future__ import annotations

import numpy as np
from numpy.typing import NDArray

from khop_env.observers import FloatArray, ObserverDesign, Observers, PlantState


class ReceivedStates:
    """Estimates in which neighbours' states stand while they are received.

    Args:
        design: with a schedule of links.
        observers: without messages; their layout has a place for every estimate.
        num_envs: number of environments B.
    """

    def __init__(self, design: ObserverDesign, observers: Observers, num_envs: int) -> None:
        layout, links = observers.layout, design.links
        ends = zip(layout.pair_target.tolist(), layout.observer.tolist(), strict=True)
        link = np.array([links.index.get(pair, -1) for pair in ends], np.int64)[layout.column_pair]
        self._columns = np.flatnonzero(link >= 0)
        self._link, self._source = link[self._columns], layout.column_source[self._columns]
        self._values = np.zeros((layout.size if self._columns.size else 0, num_envs))

    def states(self, state: PlantState, up: NDArray[np.bool_]) -> FloatArray:
        """(P, B) estimates, true states where the link from a neighbour is `up` (L, B); overwritten by the next."""
        estimate = state.memory["estimate"]
        if not self._columns.size:
            return estimate
        self._values[...] = estimate
        self._values[self._columns] = np.where(up[self._link], state.x[self._source], estimate[self._columns])
        return self._values

    def bounds(self, bound: FloatArray, up: NDArray[np.bool_]) -> None:
        """Write 0 into bounds (P, B) on errors where the state itself is received."""
        bound[self._columns] = np.where(up[self._link], 0.0, bound[self._columns])


def links_up(design: ObserverDesign, observers: Observers, state: PlantState) -> NDArray[np.bool_]:
    """(L, B) whether each link is up; all of them for observers that don't follow the schedule."""
    up = observers.links_up(state)
    return np.ones((len(design.links), len(state.t)), np.bool_) if up is None else up
