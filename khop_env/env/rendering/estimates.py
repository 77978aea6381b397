"""The estimates of one agent in a frame."""

from __future__ import annotations

import numpy as np

from khop_env.env.rendering.looks import angles, headings, sensible
from khop_env.env.rendering.scene import Messages
from khop_env.observers import FloatArray, FunnelBank, IntArray, ObserverDesign, PairLayout


def default_observer(design: ObserverDesign, task_edges: IntArray) -> int:
    """The agent with most task edges to k-hop targets, the first of several."""
    observers = [i for i, j in task_edges.tolist() if (j, i) not in design.links.index]
    return int(np.bincount(observers, minlength=len(design.fleet)).argmax())


class Estimates:
    """Estimated positions of one agent's targets, and the boxes of the guaranteed bounds on their errors.

    Args:
        design: the observers.
        observer: index of the agent.
        layout: of the estimates; by default `design.states.layout`.

    Attributes:
        targets: (K,) indices of the agents that it estimates, ascending.
    """

    def __init__(self, design: ObserverDesign, observer: int, layout: PairLayout | None = None) -> None:
        fleet, self._ideal = design.fleet, layout is None or layout is design.states.layout
        layout = layout or design.states.layout
        slots = {target: offset for (agent, target), offset in layout.slot.items() if agent == observer}
        self.targets = sorted(slots)
        d = min(2, fleet.position_dim)
        place = [fleet.position_index[j, :d] - fleet.state_offset[j] for j in self.targets]
        self._columns = np.array([slots[j] + p for j, p in zip(self.targets, place, strict=True)], int).reshape(-1, d)
        self._pairs = layout.column_pair[self._columns[:, 0]]
        own = headings(fleet)
        self._heading = [slots[j] + own[j] - fleet.state_offset[j] if own[j] >= 0 else -1 for j in self.targets]
        self._final = np.zeros(self._columns.shape)
        if self._ideal:
            rows = layout.column_row[self._columns].reshape(-1)
            delta = FunnelBank([design.states.bounds[row] for row in rows])
            share = design.states.share[layout.column_pair[self._columns]]
            self._final = share * delta.infimum().reshape(self._columns.shape)

    def positions(self, estimates: FloatArray) -> FloatArray:
        """(K, d) estimated positions in m, d at most 2; nan where they can't be drawn. `estimates` is (P,)."""
        return sensible(estimates[self._columns])

    def headings(self, estimates: FloatArray) -> FloatArray:
        """(K,) estimated headings in rad, 0 where there are none. `estimates` is (P,)."""
        return angles(self._heading, estimates)

    def half_widths(self, bounds: FloatArray) -> FloatArray:
        """(K, d) of the box around each estimate that is guaranteed to hold the target, in m. `bounds` is (P,)."""
        return bounds[self._columns]

    def half_widths_in_view(self, bounds: FloatArray) -> FloatArray:
        """(K, d) of the part of each box that the view has to hold, in m.

        Funnels are followed to their end: as they will be as t goes to infinity. Boxes that grow with age are held as
        long as they aren't far larger than most, so that a few old ones don't make everything else small.
        """
        if self._ideal:
            return self._final
        half = self.half_widths(bounds)
        return np.minimum(half, 2.0 * np.median(half)) if np.isfinite(half).any() else np.zeros_like(half)

    def ages(self, messages: Messages) -> FloatArray:
        """(K,) of the newest state of each target, in s; inf where none has arrived."""
        return messages.age[self._pairs]
