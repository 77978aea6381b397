"""Base of all realisations of the observers: objects that own their memory.

A simulator's state is the plant's part and one dictionary of arrays, the observers' memory. The plant moves under its
law and disturbance; the observers call its stages, because the paper's continuous-time observers are integrated
together with it, stage by stage.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any, Literal, NamedTuple, Protocol

import numpy as np
from numpy.typing import NDArray

from khop_env.observers.design import ObserverDesign
from khop_env.observers.layout import FloatArray, IntArray, PairLayout
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
    """Assumptions about the plant on which a guarantee may rest.

    Attributes:
        center: (n,) centre of the initial set.
        radius: (n,) its half widths.
        disturbance: (n,) bound on |w|, in state units per second.
    """

    center: FloatArray
    radius: FloatArray
    disturbance: FloatArray


class Information(NamedTuple):
    """The knowledge that observers have of their targets by messages, per pair of their layout.

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

    def copy_to(self, other: Extremes, where: NDArray[np.bool_] | bool = True) -> None:
        """Overwrite another's, in all environments or in some."""
        for ours, theirs in zip(self, other, strict=True):
            np.copyto(theirs, ours, where=where)
