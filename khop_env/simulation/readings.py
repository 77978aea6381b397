"""What can be read from a simulator: read-only views of its state, batch first, and what follows from it."""

from __future__ import annotations

import numpy as np

from khop_env.observers import Certified, Extremes, FloatArray, Funnels, ObserverDesign, Observers
from khop_env.observers.disagreement import disagreement_by
from khop_env.observers.funnel_observers import LinksNow, weights_at
from khop_env.physics import read_only
from khop_env.simulation.state import SimulatorState


class Readings:
    """The part of a simulator that is read."""

    design: ObserverDesign
    observers: Observers
    state: SimulatorState
    running_extremes: Extremes
    num_envs: int

    @property
    def t(self) -> FloatArray:
        """(B,) time since reset in s."""
        return read_only(self.state.t.view())

    @property
    def x(self) -> FloatArray:
        """(B, n) true states; `fleet.state_slice(i)` is agent i's part."""
        return read_only(self.state.x.T)

    @property
    def u(self) -> FloatArray:
        """(B, m) inputs in force."""
        return read_only(self.state.u.T)

    @property
    def g(self) -> FloatArray:
        """(B, n) their effect g_i(x_i, u_i) on the states."""
        return read_only(self.state.g.T)

    @property
    def estimates(self) -> FloatArray:
        """(B, P) state estimates in the order of `observers.layout`."""
        return read_only(self.state.memory["estimate"].T)

    @property
    def input_estimates(self) -> FloatArray:
        """(B, Q) estimates of g in the order of `design.inputs.layout`."""
        return read_only(self.state.memory["input_estimate"].T)

    @property
    def extremes(self) -> Extremes:
        """The largest ratios at any grid point since the last reset."""
        return self.running_extremes.copied()

    def error_bounds(self) -> Certified:
        """The guaranteed bound on the error of every estimate now, (P, B), batch last, and its basis."""
        return self.observers.bound(self.state, np.empty_like(self.state.memory["estimate"]))

    def errors(self) -> FloatArray:
        """(B, P) estimation errors x_tilde."""
        return self.estimates - self.x[:, self.observers.layout.column_source]

    def disagreements(self) -> FloatArray:
        """(B, P) disagreements xi."""
        return self._disagreement(self.design.states, "estimate", self.state.x)

    def input_errors(self) -> FloatArray:
        """(B, Q) estimation errors of g."""
        return self.input_estimates - self.g[:, self.design.inputs.layout.column_source]

    def input_disagreements(self) -> FloatArray:
        """(B, Q) input disagreements mu."""
        return self._disagreement(self.design.inputs, "input_estimate", self.state.g)

    def _disagreement(self, funnels: Funnels, memory: str, source: FloatArray) -> FloatArray:
        links = None if self.design.schedule is None else LinksNow(self.design, self.num_envs)
        weights = weights_at(links, self.state)[funnels is self.design.inputs]
        out = np.zeros((funnels.layout.size, self.num_envs))
        disagreement_by(funnels.layout, weights, self.state.memory[memory], source, out)
        return out.T
