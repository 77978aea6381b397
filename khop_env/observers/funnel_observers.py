"""The paper's observers, however they are stepped: their funnels, links, bounds and ratios at a state."""

from __future__ import annotations

import math
from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from khop_env.network.randomness import draw_keys
from khop_env.observers.base import Assumptions, Basis, Certified, Extremes, Information, Memory, PlantState
from khop_env.observers.design import ObserverDesign
from khop_env.observers.disagreement import largest_ratios, largest_weighted_ratios
from khop_env.observers.layout import FloatArray, IntArray
from khop_env.observers.performance import FunnelBank
from khop_env.observers.weights import Weights, WeightsNow


class WidthsNow:
    """The widths of many funnels at the time of a simulation, evaluated once an instant.

    Args:
        bank: the funnels.
        num_envs: number of environments B.
    """

    def __init__(self, bank: FunnelBank, num_envs: int) -> None:
        self._bank = bank
        self._time = b""
        self._values = np.ones((len(bank), num_envs))

    def at(self, t: FloatArray) -> FloatArray:
        """(rows, B) widths at the times `t` (B,); overwritten by the next instant's."""
        now = t.tobytes()
        if now != self._time:
            self._time = b""  # if the evaluation raises, its partial results aren't used
            self._bank.evaluate(t, self._values)
            self._time = now
        return self._values


class LinksNow:
    """The links that are up in the states of a simulation, and what follows from them for the observers.

    All of it is a function of a state: of its time, true states and "key".

    Args:
        design: with a schedule.
        num_envs: number of environments B.

    Attributes:
        states: weights of the state observers' layout.
        inputs: of the input observers'.
    """

    def __init__(self, design: ObserverDesign, num_envs: int) -> None:
        self._activity, self._up = design.activity(), np.ones((len(design.links), num_envs), np.bool_)
        self.states, self.inputs = (WeightsNow(funnels.layout, num_envs) for funnels in (design.states, design.inputs))

    def up(self, state: PlantState) -> NDArray[np.bool_]:
        """(L, B) whether each link of the design is up; overwritten by the next call."""
        return self._activity.up(state.memory["key"], state.t, state.x, self._up)


def weights_at(links: LinksNow | None, state: PlantState) -> tuple[Weights | None, Weights | None]:
    """Weights of state and input observers at a state; None where links don't change."""
    if links is None:
        return None, None
    up = links.up(state)
    return links.states.of(up), links.inputs.of(up)


class FunnelObservers:
    """The paper's state and input observers (PPSO and PPIO), however they are stepped.

    Attributes:
        design: the pairs (observer, target) and their funnels.
        num_envs: number of environments B.
        rho: the state observers' funnels now.
        omega: the input observers'.
        links: those that are up; None without a schedule.
    """

    basis: Basis = "theorem"
    by_messages = False
    copied = True
    longest_step = math.inf

    def prepare(self, design: ObserverDesign, num_envs: int, assumed: Assumptions) -> None:
        """Allocate the buffers for steps of `design` in `num_envs` environments; nothing more is `assumed`."""
        self.design, self.num_envs, self.layout = design, num_envs, design.states.layout
        self.rho, self.omega = WidthsNow(design.states.rho, num_envs), WidthsNow(design.inputs.rho, num_envs)
        self._delta = WidthsNow(design.states.delta, num_envs)
        self.links = None if design.schedule is None else LinksNow(design, num_envs)

    def allocate(self) -> Memory:
        """Estimates of states (P, B) and of the inputs' effects (Q, B); with a schedule "key" (B,), too."""
        sizes = {"estimate": self.design.states.layout.size, "input_estimate": self.design.inputs.layout.size}
        memory: Memory = {name: np.zeros((size, self.num_envs)) for name, size in sizes.items()}
        return memory if self.links is None else {**memory, "key": np.zeros(self.num_envs, np.uint64)}

    def reset(
        self, state: PlantState, env_ids: IntArray, rngs: Sequence[np.random.Generator], first_guess: FloatArray
    ) -> None:
        """Start the estimates from `first_guess` in the environments `env_ids`, and draw their keys."""
        for name, values in state.memory.items():
            if name == "key":
                values[env_ids] = draw_keys(rngs)
                continue
            guess = first_guess[self.design.states.layout.column_source][:, None] if name == "estimate" else 0.0
            values[:, env_ids] = guess

    def bound(self, state: PlantState, out: FloatArray) -> Certified:
        """Each observer's own bound [M_i^-1 rho_i]_a, guaranteed while every disagreement is inside its funnel.

        With a schedule M_i is that of the links that are up, and the bound of an observer that is cut off inf.
        """
        states = self.design.states
        if self.links is None:
            return Certified(states.error_bounds(self._delta.at(state.t), out), self.basis)
        sums = self.links.states.inverse_row_sums(self.links.up(state))
        np.take(self.rho.at(state.t), states.layout.column_row, axis=0, out=out, mode="clip")
        return Certified(np.multiply(out, sums[states.layout.column_pair], out=out), self.basis)

    def links_up(self, state: PlantState) -> NDArray[np.bool_] | None:
        """(L, B) whether each link of the design is up, overwritten by the next call; None without a schedule."""
        return None if self.links is None else self.links.up(state)

    def information(self, state: PlantState) -> Information:
        """Nothing is old here: exchange is continuous."""
        shape = self.layout.pairs, self.num_envs
        return Information(*(np.broadcast_to(value, shape) for value in (0.0, 1.0, 0.0)))

    def raise_extremes(self, state: PlantState, extremes: Extremes) -> None:
        """Raise running maxima of |xi| / rho and errors over own bounds, and of the same for inputs, to a state's."""
        memory, links = state.memory, self.links
        up = None if links is None else links.up(state)
        for kind, funnels, widths, estimate, source, normalized, relative in (
            (
                "states",
                self.design.states,
                self.rho,
                memory["estimate"],
                state.x,
                extremes.normalized,
                extremes.relative,
            ),
            (
                "inputs",
                self.design.inputs,
                self.omega,
                memory["input_estimate"],
                state.g,
                extremes.input_normalized,
                extremes.input_relative,
            ),
        ):
            layout = funnels.layout
            if not layout.size:
                continue
            rho, maxima = widths.at(state.t), (normalized, relative)
            if up is None:
                largest_ratios(layout.packed, estimate, source, rho, layout.inverse_row_sums, *maxima, 0, self.num_envs)
            else:
                weights: WeightsNow = getattr(links, kind)
                now, sums = weights.of(up), weights.inverse_row_sums(up)
                largest_weighted_ratios(layout.packed, now, estimate, source, rho, sums, *maxima)
