"""The simulator: B copies of one closed loop, their seeds, and their state."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from typing import Any

import networkx as nx
import numpy as np
from numpy.typing import ArrayLike

from khop_env.brief import spread
from khop_env.observers import (
    Assumptions,
    Extremes,
    FloatArray,
    FunnelError,
    IntArray,
    ObserverDesign,
    Observers,
    Proximal,
    SolveError,
)
from khop_env.simulation.compiled_step import compiled_step
from khop_env.simulation.initial import InitialSet
from khop_env.simulation.plant import FleetPlant, parts_of_step
from khop_env.simulation.readings import Readings
from khop_env.simulation.state import SimulatorState, selected
from khop_env.simulation.step_control import StepControl, StepCount
from khop_env.simulation.view import OBSERVE, Law, Observe, ViewBuilder

_WARM_UP_STEP = 1e-9  # s: short enough for all observers, long enough to run all of their code


class Simulator(Readings):
    """B copies of a fleet, its disturbances and its observers, advanced together.

    Args:
        design: fleet, communication graph and observers.
        initial: where states start.
        disturbance: a `physics.Disturbance`, or None.
        law: feedback law evaluated at every stage (continuous-time closed loop); None to hold the inputs given to
            `step` (sampled control).
        task: task graph; needed with a law, and by environments.
        observe: source of the states of k-hop targets in the law's view: "estimate", "oracle" (true states) or "local"
            (none).
        observers: realisation of the observers; `Proximal(order=2)` by default.
        num_envs: number of environments B.

    Attributes:
        state: all arrays that a step reads and writes, batch last.
        before: the state at the beginning of the last step.
        observers: this simulator's own copy.
        longest_step: longest step in s that all drifts take (`AgentModel.explicit_step`); inf if they take any.
        running_extremes: the arrays that `extremes` copies; overwritten by steps.

    Raises:
        DesignError: if the initial set doesn't fit into the funnels.
        ValueError: for a law without a task graph, or an unknown `observe`.
    """

    def __init__(
        self,
        design: ObserverDesign,
        initial: InitialSet,
        *,
        disturbance: Any | None = None,
        law: Law | None = None,
        task: nx.Graph | None = None,
        observe: Observe = "estimate",
        observers: Observers | None = None,
        num_envs: int = 1,
    ) -> None:
        if law is not None and task is None:
            raise ValueError("a law acts along the edges of a task graph; give task=")
        if observe not in OBSERVE:
            raise ValueError(f"observe must be one of {', '.join(OBSERVE)}; got {observe!r}")
        if num_envs < 1:
            raise ValueError(f"num_envs must be at least 1; got {num_envs!r}")
        self.design, self.fleet, self.initial, self.num_envs = design, design.fleet, initial, num_envs
        self.disturbance, self._observe = disturbance, observe
        bound = self.fleet.input_map_bound  # an unbounded g can't be checked here; `reset` checks its initial value
        design.require_feasible_start(initial.radius, np.where(np.isfinite(bound), bound, 0.0))
        self.observers: Observers = copy.copy(observers or Proximal())  # its buffers are this simulator's own
        attached = None if disturbance is None else disturbance.attach(self.fleet)
        pushed = np.zeros(self.fleet.n) if attached is None else attached.bound
        self.observers.prepare(design, num_envs, Assumptions(initial.center, initial.radius, pushed))
        self.task_graph = nx.empty_graph(len(self.fleet)) if task is None else task
        views = None if law is None else ViewBuilder(design, self.observers, self.task_graph, observe, num_envs)
        threads, saturated = getattr(self.observers, "pool", None), self.observers.by_messages
        self.plant = FleetPlant(self.fleet, num_envs, attached, law, views, saturated=saturated, threads=threads)
        self.state = SimulatorState(
            t=np.zeros(num_envs),
            x=np.zeros((self.fleet.n, num_envs)),
            u=np.zeros((self.fleet.m, num_envs)),
            g=np.zeros((self.fleet.n, num_envs)),
            drawn=np.zeros((num_envs, 0 if attached is None else attached.draws)),
            memory=self.observers.allocate(),
        )
        self.before, self._interrupted, self._in_one_call = self.state.copy(), False, False
        self.running_extremes = Extremes(*(np.zeros(num_envs) for _ in Extremes._fields))
        self._extremes_before = self.running_extremes.copied()
        self._compiled = compiled_step(self.plant, self.observers, self.state, self.before, self._extremes_before)
        reach = np.abs(initial.center) + initial.radius
        self.longest_step, self._stiffest = self.fleet.explicit_step(reach, pushed)
        self.reset(seed=0)

    def __repr__(self) -> str:
        law = self.plant.law
        name = "no law" if law is None else f"law {getattr(law, '__name__', None) or repr(law)}"
        return f"Simulator({self.design}; {self.observers!r}, {name}, num_envs={self.num_envs}, {spread(self.state.t)})"

    def reset(
        self,
        seed: int | Sequence[int | np.random.Generator] = 0,
        x0: ArrayLike | None = None,
        env_ids: Sequence[int] | IntArray | None = None,
    ) -> Simulator:
        """Start a new episode, in every environment or in some; the others keep every bit.

        Args:
            seed: environment b draws its initial state and disturbance from seed + b; or one seed for each environment
                that is reset, in their order.
            x0: (n,) or (R, n) initial states instead of drawn ones, for the R environments that are reset.
            env_ids: (R,) their indices; all B by default.

        Raises:
            ValueError: for x0 of a wrong shape or not finite, not R seeds, or `env_ids` that are out of range,
                duplicated or not integers.
            DesignError: for an x0 outside the funnels; nothing has been reset then.
        """
        chosen = selected(env_ids, self.num_envs)
        seeds = [seed + int(b) for b in chosen] if isinstance(seed, int | np.integer) else list(seed)
        if len(seeds) != len(chosen):
            raise ValueError(f"expected one seed or {len(chosen)}, one per environment; got {len(seeds)}")
        generators = [np.random.default_rng(each) for each in seeds]  # raises for an invalid seed
        start = None if x0 is None else self.initial.checked(x0, len(chosen))
        if start is not None:
            away = np.abs(start - self.initial.center).reshape(-1, self.fleet.n).max(axis=0)
            self.design.require_feasible_start(away, np.zeros(self.fleet.n))
        state, disturbance = self.state, self.plant.disturbance
        self._interrupted &= len(chosen) < self.num_envs
        for b, rng in zip(chosen, generators, strict=True):
            state.x[:, b] = self.initial.draw(rng)
            if disturbance is not None:
                state.drawn[b] = disturbance.draw(rng)
        if start is not None:
            state.x[:, chosen] = np.broadcast_to(start, (len(chosen), self.fleet.n)).T
        for zeros in (state.t, state.u, *self.running_extremes):
            zeros[..., chosen] = 0.0
        self.plant.effect(state)
        self.observers.reset(state, chosen, generators, self.initial.center)
        self.plant.actuate(state)
        self.observers.raise_extremes(state, self.running_extremes)
        if not np.all(self.running_extremes.input_normalized[chosen] < 1.0):
            away = np.where(np.isfinite(self.g), np.abs(self.g), 0.0).max(axis=0)
            self.design.require_feasible_start(np.zeros(self.fleet.n), away)
        return self

    def step(self, dt: float, u: ArrayLike | None = None) -> None:
        """Advance every environment by `dt` seconds.

        Args:
            dt: step in s, positive; divided into equal parts where it is too long for a drift
                (`AgentModel.explicit_step`).
            u: (m,) or (B, m) inputs held over the step, where the simulator has no law; the last ones if left out.
                They are not clipped: keep them within `input_limit` if the design assumes a bounded input map. Over a
                network certified bounds assume it, and inputs beyond are refused.

        Raises:
            ValueError: for a step that isn't positive or would have too many parts, or inputs that are passed to a
                simulator with a law, of a wrong shape or not finite; the state is unchanged.
            FunnelError: if an explicit step leaves the funnel; the state is the last one inside.
            SolveError: if a right-hand side gives numbers that aren't finite; likewise.
        """
        if not 0.0 < dt < math.inf:
            raise ValueError(f"dt must be positive and finite; got {dt!r}")
        parts = self.parts_of(dt)
        if u is not None:
            self.state.u.T[...] = self.plant.checked_inputs(u)
            self.plant.actuate(self.state)
        self.step_unchecked(float(dt), parts)

    def advance(self, until: float, *, tolerance: float, u: ArrayLike | None = None) -> StepCount:
        """Advance every environment to a time, in steps that are as long as their estimated errors allow.

        For the proximal step of order 2 or 3; order 3 takes the fewest steps. All environments take the same ones, so
        that they have to be at the same time, and an environment's result depends on the others, within the tolerance.

        Args:
            until: time since reset in s, not before the present.
            tolerance: largest estimated error of a step in every state and estimate, relative to 1 + |value|.
            u: as in `step`.

        Returns:
            How many steps were taken, and how many taken back.

        Raises:
            ValueError: for a time that isn't finite or is past, a tolerance that isn't from 1e-9 to 1, other observers,
                environments at different times, or inputs as in `step`; the state is unchanged.
            SolveError: if a right-hand side gives numbers that aren't finite; the state is that of the last step.
        """
        self._require_whole()
        control = StepControl(self, tolerance)
        control.require(until)
        if u is not None:
            self.state.u.T[...] = self.plant.checked_inputs(u)
            self.plant.actuate(self.state)
        control.run(until)
        return StepCount(control.accepted, control.rejected)

    def parts_of(self, dt: float) -> int:
        """Number of equal parts into which `step` divides a step, so that the plant's drift is stable in each of them.

        Raises:
            ValueError: for more than `MOST_PARTS`.
        """
        parts = parts_of_step(dt, self.longest_step, f"the drift of {self.fleet.ids[self._stiffest]!r}")
        return max(parts, parts_of_step(dt, self.observers.longest_step, "the period of messages"))

    def step_unchecked(self, dt: float, parts: int, u: FloatArray | None = None) -> None:
        """`step` without checks: for callers that have checked the step and the inputs.

        Args:
            dt: step in s.
            parts: `parts_of(dt)`.
            u: (m, B) physical inputs to hold from now on, batch last and finite, where there is no law.
        """
        self._require_whole()
        self._in_one_call = self._compiled is not None and self._compiled.ready(self.running_extremes)
        held = False
        if u is not None:
            self.state.u[...] = u
            held = self._in_one_call and parts == 1  # the compiled step computes their effect itself
            if not held:
                self.plant.actuate(self.state)
        whole = self.observers.copied or parts > 1  # otherwise a step can be undone that fails at its beginning only
        start = (self.state.copy(), self.running_extremes.copied()) if parts > 1 else None
        self._keep()  # not in the block below: where it is interrupted halfway nothing has to be restored
        try:
            for part in range(parts):
                if part:
                    self._keep()
                self._one_step(dt / parts, held)
        except BaseException as error:
            self.take_back(whole)
            if start is not None:
                start[0].copy_step(self.state, whole)
                start[1].copy_to(self.running_extremes)
            self._interrupted = not whole and not isinstance(error, FunnelError | SolveError)
            raise

    def try_step(self, dt: float) -> None:
        """Advance by a single step of `dt` seconds, and raise the extremes. `before` is the state before it.

        Where this raises, `take_back` has to follow.

        Raises:
            FunnelError: as `step`, or `SolveError`; the state is undefined then.
        """
        self._in_one_call = self._compiled is not None and self._compiled.ready(self.running_extremes)
        self._keep()
        self._one_step(dt, False)

    def take_back(self, memory: bool = True) -> None:
        """Return to the state and the extremes before the last step, wherever that was interrupted.

        Args:
            memory: whether the observers' memory was copied, too.
        """
        begun = self.before.t == self.before.t  # not where the compiled step was interrupted before it began
        where = True if begun.all() else begun
        self.before.copy_step(self.state, memory, where)
        self._extremes_before.copy_to(self.running_extremes, where)
        if where is not True:
            self.plant.effect(self.state)  # of inputs that are new in the others

    def _keep(self) -> None:
        """Note the present state and extremes, unless the compiled step does."""
        if not self._in_one_call:
            self.state.copy_step(self.before, self.observers.copied)
            self.running_extremes.copy_to(self._extremes_before)

    def _one_step(self, dt: float, held: bool) -> None:
        if self._in_one_call:
            assert self._compiled is not None
            self._compiled(dt, self.running_extremes, held)
        else:
            self.observers.advance(self.plant, self.before, self.state, dt)
            self.observers.raise_extremes(self.state, self.running_extremes)

    def warm_up(self, long: bool = False) -> None:
        """Compile all code that the next step runs; the state is unchanged.

        Args:
            long: whether to compile what only runs of thousands of steps would compile, too.
        """
        if long and self._compiled is not None:
            self._compiled.ready(self.running_extremes, now=True)
        saved, extremes = self.save(), self.running_extremes.copied()
        try:
            self.step_unchecked(_WARM_UP_STEP, 1)
        except (FunnelError, SolveError):
            pass  # the first real step will raise it again
        finally:
            self.restore(saved)
            extremes.copy_to(self.running_extremes)

    def save(self) -> SimulatorState:
        """Everything needed to continue bit for bit."""
        return self.state.copy()

    def restore(self, saved: SimulatorState) -> None:
        """Continue from a saved state; `extremes` start anew.

        Raises:
            ValueError: if it was saved by a simulator of other dimensions or other observers.
        """
        self.state.assign(saved)
        self._interrupted = False
        self.restart_extremes()
        self.observers.raise_extremes(self.state, self.running_extremes)

    def restart_extremes(self) -> None:
        """Reset the running maxima: `extremes` are then those of the steps to come."""
        for running in self.running_extremes:
            running[...] = 0.0

    def resized(self, num_envs: int) -> Simulator:
        """A simulator of the same closed loop with another number of environments, reset with seed 0."""
        return Simulator(
            self.design,
            self.initial,
            disturbance=self.disturbance,
            law=self.plant.law,
            task=self.task_graph,
            observe=self._observe,
            observers=self.observers,
            num_envs=num_envs,
        )

    def _require_whole(self) -> None:
        if self._interrupted:
            raise RuntimeError(
                "the last step was interrupted half-way: reset all environments, or restore a saved state, to go on"
            )
