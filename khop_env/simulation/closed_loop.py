"""World and belief as one vector field: everything an integrator evaluates, and nothing it decides.

Arrays are (columns, B) here, batch last and contiguous, because compiled loops run along the batch. What models, laws
and users get are the transposed views (B, ...).
"""

from __future__ import annotations

from typing import Any

import networkx as nx
import numpy as np

from khop_env.observers import FloatArray, FunnelBank, ObserverDesign, PairLayout
from khop_env.simulation.view import Law, Observe, ViewBuilder


class ClosedLoop:
    """The plant under its law and disturbance, and the non-stiff part of the observers.

    Args:
        design: fleet, graph, observers.
        disturbance: an attached disturbance (`physics.Disturbance.attach`), or None.
        law: the feedback law, or None for inputs that are held between steps.
        task: the task graph; needed with a law.
        observe: what the law sees of agents out of earshot.
        batch: number of environments B.
    """

    def __init__(
        self,
        design: ObserverDesign,
        disturbance: Any | None,
        law: Law | None,
        task: nx.Graph | None,
        observe: Observe,
        batch: int,
    ) -> None:
        self.design, self.fleet, self.law, self.batch = design, design.fleet, law, batch
        self.disturbance = disturbance
        self.state_layout: PairLayout = design.states.layout
        self.input_layout: PairLayout = design.inputs.layout
        self.rho: FunnelBank = design.states.rho
        self.omega: FunnelBank = design.inputs.rho
        self.views = ViewBuilder(design, task, observe, batch) if task is not None else None
        self._known_drift = _runs_with_drift(design)
        self._input_columns = _shared_columns(self.state_layout, self.input_layout)
        self._all_drift_known = (
            sum(columns.stop - columns.start for _, columns, _ in self._known_drift) == self.state_layout.size
        )
        self._w = np.zeros((self.fleet.n, batch)).T  # (B, n) in the memory order of the states

    def command(self, t: FloatArray, x: FloatArray, estimate: FloatArray, out: FloatArray) -> None:
        """Write the law's inputs (m, B) into `out`; without a law leave the held ones there.

        Raises:
            ValueError: if the law returns inputs of a wrong shape.
        """
        if self.law is None:
            return
        assert self.views is not None
        u = self.law(t, self.views.update(x, estimate))
        if np.shape(u) != (self.batch, self.fleet.m):
            raise ValueError(
                f"law {self.law!r} returned inputs of shape {np.shape(u)}; expected (environments, inputs) = "
                f"{(self.batch, self.fleet.m)}"
            )
        out.T[:] = u

    def actuate(self, t: FloatArray, x: FloatArray, estimate: FloatArray, u: FloatArray, g: FloatArray) -> None:
        """`command` the inputs `u` (m, B), and write their effect g(x, u) into `g` (n, B)."""
        self.command(t, x, estimate, u)
        self.fleet.input_map(t, x.T, u.T, g.T)

    def plant(self, t: FloatArray, x: FloatArray, g: FloatArray, drawn: FloatArray, out: FloatArray) -> None:
        """Write x' = f(x) + g + w(x, t) into `out` (n, B)."""
        states = x.T
        self.fleet.drift(t, states, out.T)
        out += g
        if self.disturbance is not None:
            out += self.disturbance(t, states, drawn, self._w).T

    def belief(self, t: FloatArray, estimate: FloatArray, input_estimate: FloatArray, out: FloatArray) -> None:
        """Write the state observers' non-stiff part f_i(x_hat) + g_hat into `out` (P, B)."""
        if not self._all_drift_known:
            out.fill(0.0)
        times = t[:, None]
        for model, columns, pairs in self._known_drift:
            rates = model.drift(times, estimate[columns].T.reshape(self.batch, pairs, model.n))
            out[columns] = rates.reshape(self.batch, -1).T
        for state_columns, input_columns in self._input_columns:
            out[state_columns] += input_estimate[input_columns]


def _runs_with_drift(design: ObserverDesign) -> list[tuple[Any, slice, int]]:
    """(model, columns, pairs) for each run of consecutive targets with equal models whose observers know f_i."""
    layout, fleet = design.states.layout, design.fleet
    runs: list[tuple[Any, slice, int]] = []
    for i, (eta, n, offset, *_) in zip(layout.target.tolist(), layout.plan.tolist(), strict=True):
        if not design.options[i].drift:
            continue
        stop = offset + eta * n
        if runs and runs[-1][1].stop == offset and (runs[-1][0] is fleet.models[i] or runs[-1][0] == fleet.models[i]):
            model, columns, pairs = runs[-1]
            runs[-1] = (model, slice(columns.start, stop), pairs + eta)
        else:
            runs.append((fleet.models[i], slice(offset, stop), eta))
    return runs


def _shared_columns(states: PairLayout, inputs: PairLayout) -> list[tuple[slice, slice]]:
    """Columns of the state estimates and of the input estimates of the same pairs, in as few runs as possible.

    Both layouts list targets ascending and a target's observers in the same order.
    """
    start = dict(zip(states.target.tolist(), states.plan[:, 2].tolist(), strict=True))
    runs: list[tuple[slice, slice]] = []
    for i, (eta, n, offset, *_) in zip(inputs.target.tolist(), inputs.plan.tolist(), strict=True):
        width = eta * n
        if runs and runs[-1][0].stop == start[i] and runs[-1][1].stop == offset:
            one, other = runs[-1]
            runs[-1] = (slice(one.start, start[i] + width), slice(other.start, offset + width))
        else:
            runs.append((slice(start[i], start[i] + width), slice(offset, offset + width)))
    return runs
