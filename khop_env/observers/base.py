"""Base of all realisations of the observers: objects that own their memory.

A simulator's state is the plant's part and one dictionary of arrays, the observers' memory. The plant moves under its
law and disturbance; the observers call its stages, because the paper's continuous-time observers are integrated
together with it, stage by stage.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from khop_env.network.randomness import draw_keys
from khop_env.observers.design import ObserverDesign
from khop_env.observers.disagreement import largest_ratios, largest_weighted_ratios
from khop_env.observers.layout import FloatArray, IntArray, PairLayout
from khop_env.observers.performance import FunnelBank
from khop_env.observers.weights import Weights, WeightsNow
from khop_env.physics import Fleet

Memory = dict[str, NDArray[Any]]
"""Memory of observers by name, batch last; "estimate" (P, B) and "input_estimate" (Q, B) always.

With a schedule of links also "key" (B,), from which an environment's random links are drawn.
"""

Basis = Literal["theorem", "construction", "certificate"]


class SolveError(RuntimeError):
    """A step met numbers that aren't finite, in a state, an input, a disturbance or an estimate."""


class PlantState(Protocol):
    """Arrays of B environments, batch last: the plant's part of a simulator's state, and the observers' memory.

    Attributes:
        t: (B,) time since reset in s.
        x: (n, B) true states.
        u: (m, B) inputs in force.
        g: (n, B) their effect g_i(x_i, u_i).
        drawn: (B, K) the disturbance's random numbers of this episode.
        memory: of the observers.
    """

    t: FloatArray
    x: FloatArray
    u: FloatArray
    g: FloatArray
    drawn: FloatArray
    memory: Memory


class Plant(Protocol):
    """The plant under its law and disturbance, as observers advance it.

    Attributes:
        fleet: the agents.
    """

    fleet: Fleet

    def stage(self, number: int, weights: FloatArray, elapsed: float, before: PlantState, state: PlantState) -> None:
        """Move `state.t` and `state.x` to a Runge-Kutta stage.

        Args:
            number: of the stage, from 0; the rate of change at `state` becomes that of this number.
            weights: (number + 1,) of the rates so far, in s.
            elapsed: time of the stage after `before.t`, in s.
            before: the state at the beginning of the step.
            state: the stage before on entry, this one on return; its inputs are still those of the stage before.

        Raises:
            SolveError: if a state isn't finite.
        """
        ...

    def effect(self, state: PlantState) -> None:
        """Write the effect g_i(x_i, u_i) of the inputs in force into `state.g`."""
        ...

    def actuate(self, state: PlantState) -> None:
        """Write the law's inputs at t, x and the estimates into `state.u`, and their effect into `state.g`."""
        ...


class Certified(NamedTuple):
    """A guaranteed bound on the error of every estimate.

    Attributes:
        bound: (P, B) in the units of the estimates.
        basis: "theorem": the paper's, in continuous time; "construction": of the step, at every grid point; or
            "certificate": of the age of what was received, whatever the network does.
    """

    bound: FloatArray
    basis: Basis


class Assumptions(NamedTuple):
    """What a guarantee may assume of the plant.

    Attributes:
        center: (n,) centre of the initial set.
        radius: (n,) its half widths.
        disturbance: (n,) bound on |w|, in state units per second.
    """

    center: FloatArray
    radius: FloatArray
    disturbance: FloatArray


class Information(NamedTuple):
    """What observers that exchange messages know of their targets, per pair of their layout.

    Attributes:
        age: (pairs, B) time since the newest state that has arrived was measured, in s; inf where none has.
        hops: (pairs, B) links over which it came; 0 where none has.
        since: (pairs, B) time since it arrived, in s; inf where none has.
    """

    age: FloatArray
    hops: FloatArray
    since: FloatArray


class Observers(Protocol):
    """A realisation of the observers.

    Attributes:
        name: e.g. "proximal".
        order: of convergence in the step.
        by_messages: whether agents know of others, neighbours included, by messages only, which can be lost or late.
        copied: whether `advance` gets a copy of the memory as it was; it may change nothing before it raises otherwise.
        longest_step: longest step in s; simulators divide longer ones.
        layout: of the pairs (observer, target) that "estimate" is about, once prepared. Neighbours are among the
            targets where `by_messages`.
    """

    name: str
    order: int
    by_messages: bool
    copied: bool
    longest_step: float
    layout: PairLayout

    def prepare(self, design: ObserverDesign, num_envs: int, assumed: Assumptions) -> None:
        """Get ready; called once, before everything else.

        Args:
            design: the pairs (observer, target) and their funnels.
            num_envs: number of environments B.
            assumed: of the plant.
        """
        ...

    def allocate(self) -> Memory:
        """Zeroed memory of B environments; "estimate" and "input_estimate" are in it."""
        ...

    def reset(
        self, state: PlantState, env_ids: IntArray, rngs: Sequence[np.random.Generator], first_guess: FloatArray
    ) -> None:
        """Start anew in some environments.

        Args:
            state: of all environments, with the first states of those that are reset, and u = 0; the others keep every
                bit of their memory.
            env_ids: (R,) their indices.
            rngs: (R,) generators, for realisations that draw random numbers; drawing from them directly changes later
                draws of the episode, so use `rng.spawn(1)`.
            first_guess: (n,) initial value of all estimates.
        """
        ...

    def advance(self, plant: Plant, before: PlantState, state: PlantState, dt: float) -> None:
        """Advance plant and estimates by `dt` seconds.

        Args:
            plant: moves the true states.
            before: the state at the beginning of the step; only read.
            state: a copy of it on entry, the state at the end of the step on return. Where this raises it is undefined.
            dt: in s.

        Raises:
            SolveError: if a number isn't finite.
        """
        ...

    def bound(self, state: PlantState, out: FloatArray) -> Certified:
        """The guaranteed bound on the error of each of a state's estimates, written into `out` (P, B)."""
        ...

    def links_up(self, state: PlantState) -> NDArray[np.bool_] | None:
        """(L, B) whether each link of the design is up; None where all are, always."""
        ...

    def information(self, state: PlantState) -> Information:
        """Age and way of what is known; called where `by_messages`."""
        ...

    def raise_extremes(self, state: PlantState, extremes: Extremes) -> None:
        """Raise running maxima to the ratios of a state."""
        ...


class Extremes(NamedTuple):
    """The largest ratios since reset or `restart_extremes`, one per environment: below 1 the guarantee holds.

    Attributes:
        normalized: (B,) largest |xi| / rho over pairs, components and steps.
        relative: (B,) largest |x_tilde_a| / [M_i^-1 rho_i]_a, the error of an observer over its own guaranteed bound.
        input_normalized: (B,) largest |mu| / omega.
        input_relative: (B,) likewise of input maps.
    """

    normalized: FloatArray
    relative: FloatArray
    input_normalized: FloatArray
    input_relative: FloatArray

    def kept(self) -> FloatArray:
        """(B,) the larger of the two ratios of disagreements: below 1 while all are inside their funnels."""
        return np.maximum(self.normalized, self.input_normalized)

    def copied(self) -> Extremes:
        """An independent copy."""
        return Extremes(*(values.copy() for values in self))


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
                largest_ratios(layout.packed, estimate, source, rho, layout.inverse_row_sums, *maxima)
            else:
                weights: WeightsNow = getattr(links, kind)
                now, sums = weights.of(up), weights.inverse_row_sums(up)
                largest_weighted_ratios(layout.packed, now, estimate, source, rho, sums, *maxima)
