"""The simulator: B copies of one closed loop, their seeds, and their state."""

from __future__ import annotations

import copy
import math
from collections.abc import Sequence
from dataclasses import dataclass
from typing import Any

import networkx as nx
import numpy as np
from numpy.typing import ArrayLike

from khop_env.observers import FloatArray, Funnels, IntArray, ObserverDesign
from khop_env.observers.disagreement import disagreement, extremes
from khop_env.simulation.closed_loop import ClosedLoop
from khop_env.simulation.integrators import Integrator, Proximal
from khop_env.simulation.state import SimulatorState
from khop_env.simulation.view import Law, Observe

MOST_PARTS = 10_000
"""Steps of the integrator that one `Simulator.step` may be divided into."""


@dataclass(frozen=True, eq=False)
class InitialSet:
    """Where states start: uniformly in a box. Its centre is the observers' common first guess.

    Attributes:
        center: (n,) in the states' units.
        radius: (n,) half widths, not negative.

    Raises:
        ValueError: if they differ in shape, or a number isn't finite or a half width negative.
    """

    center: FloatArray
    radius: FloatArray

    def __post_init__(self) -> None:
        center, radius = np.asarray(self.center, dtype=float), np.asarray(self.radius, dtype=float)
        if center.ndim != 1 or center.shape != radius.shape or not np.isfinite([center, radius]).all():
            raise ValueError(f"center and radius must be finite, (n,) each; got {self.center!r} and {self.radius!r}")
        if (radius < 0.0).any():
            raise ValueError(f"radius must not be negative; got {radius.min():g} for component {radius.argmin()}")
        object.__setattr__(self, "center", center)
        object.__setattr__(self, "radius", radius)

    def draw(self, rng: np.random.Generator) -> FloatArray:
        """One (n,) initial state."""
        return self.center + self.radius * rng.uniform(-1.0, 1.0, len(self.center))


@dataclass(frozen=True)
class Extremes:
    """The largest ratios since reset or `restart_extremes`, one per environment: below 1 the guarantee holds.

    Attributes:
        normalized: (B,) largest |xi| / rho over pairs, components and steps.
        relative: (B,) largest |x_tilde| / delta.
        input_normalized: (B,) largest |mu| / omega.
        input_relative: (B,) largest |g_tilde| / theta.
    """

    normalized: FloatArray
    relative: FloatArray
    input_normalized: FloatArray
    input_relative: FloatArray


def parts_of_step(dt: float, longest: float, agent: str) -> int:
    """Into how many equal parts a step is divided, so that the plant's own drift can take each of them.

    Args:
        dt: step in s.
        longest: what the drift takes (`Fleet.explicit_step`), in s.
        agent: whose drift it is, for the error.

    Raises:
        ValueError: for more than `MOST_PARTS`.
    """
    if dt > MOST_PARTS * longest:
        raise ValueError(
            f"dt = {dt:g} s is too long: the drift of {agent!r} takes {longest:.3g} s at a time, and no step is "
            f"divided into more than {MOST_PARTS} parts; take dt of {MOST_PARTS * longest:.3g} s at most"
        )
    return max(1, math.ceil(dt / longest))


class Simulator:
    """B copies of a fleet, its disturbances and its observers, advanced together.

    Args:
        design: fleet, communication graph and observers.
        initial: where states start.
        disturbance: a `physics.Disturbance`, or None.
        law: feedback law evaluated at every stage (continuous-time closed loop); None to hold the inputs given to
            `step` (sampled control).
        task: task graph; needed with a law.
        observe: what the law sees of agents out of earshot: "estimate", "oracle" or "local".
        integrator: `Proximal(order=2)` by default.
        batch: number of environments B.

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
        integrator: Integrator | None = None,
        batch: int = 1,
    ) -> None:
        if law is not None and task is None:
            raise ValueError("a law acts along the edges of a task graph; give task=")
        if batch < 1:
            raise ValueError(f"batch must be at least 1; got {batch!r}")
        self.design, self.fleet, self.initial, self.batch = design, design.fleet, initial, batch
        bound = self.fleet.input_map_bound  # an unbounded g can't be checked here; `reset` sees where it starts
        design.require_feasible_start(initial.radius, np.where(np.isfinite(bound), bound, 0.0))
        self.integrator: Integrator = copy.copy(integrator or Proximal())  # its buffers are this simulator's own
        attached = None if disturbance is None else disturbance.attach(self.fleet)
        self._loop = ClosedLoop(design, attached, law, task, observe, batch)
        draws = 0 if attached is None else attached.draws
        sizes = design.states.layout.size, design.inputs.layout.size
        self._state = SimulatorState.zeros(batch, self.fleet.n, self.fleet.m, *sizes, draws)
        self.integrator.prepare(self._loop)
        reach, pushed = np.abs(initial.center) + initial.radius, np.zeros(self.fleet.n)
        self._longest_step, self._stiffest = self.fleet.explicit_step(
            reach, pushed if attached is None else attached.bound
        )
        self._extremes = np.zeros((4, batch))
        self._rho = [np.ones((funnels.layout.rows, batch)) for funnels in (design.states, design.inputs)]
        self.reset(seed=0)

    # -- reading -------------------------------------------------------------------------------------------------

    @property
    def t(self) -> FloatArray:
        """(B,) time since reset in s."""
        return self._state.t

    @property
    def x(self) -> FloatArray:
        """(B, n) true states; `fleet.state_slice(i)` is agent i's part."""
        return self._state.x.T

    @property
    def u(self) -> FloatArray:
        """(B, m) inputs in force."""
        return self._state.u.T

    @property
    def g(self) -> FloatArray:
        """(B, n) their effect g_i(x_i, u_i) on the states."""
        return self._state.g.T

    @property
    def estimates(self) -> FloatArray:
        """(B, P) state estimates in the order of `design.states.layout`."""
        return self._state.estimate.T

    @property
    def input_estimates(self) -> FloatArray:
        """(B, Q) estimates of g in the order of `design.inputs.layout`."""
        return self._state.input_estimate.T

    @property
    def extremes(self) -> Extremes:
        """The largest ratios at any grid point since the last reset."""
        return Extremes(*self._extremes.copy())

    def errors(self) -> FloatArray:
        """(B, P) estimation errors x_tilde."""
        return self.estimates - self.x[:, self.design.states.layout.column_source]

    def disagreements(self) -> FloatArray:
        """(B, P) disagreements xi."""
        return self._disagreement(self.design.states, self._state.estimate, self._state.x).T

    def input_errors(self) -> FloatArray:
        """(B, Q) estimation errors of g."""
        return self.input_estimates - self.g[:, self.design.inputs.layout.column_source]

    def input_disagreements(self) -> FloatArray:
        """(B, Q) input disagreements mu."""
        return self._disagreement(self.design.inputs, self._state.input_estimate, self._state.g).T

    # -- writing -------------------------------------------------------------------------------------------------

    def reset(
        self,
        seed: int | Sequence[int | np.random.Generator] = 0,
        x0: ArrayLike | None = None,
        environments: Sequence[int] | IntArray | None = None,
    ) -> Simulator:
        """Start a new episode, in every environment or in some; the others keep every bit.

        Args:
            seed: environment b draws its initial state and disturbance from seed + b; or one seed for each environment
                that is reset, in their order.
            x0: (n,) or (R, n) initial states instead of drawn ones, for the R environments that are reset.
            environments: (R,) which; all B if left out.

        Raises:
            ValueError: for x0 of a wrong shape or not finite, not R seeds, or `environments` that aren't
                different ones.
            DesignError: for an x0 that the observers can't start from; nothing has been reset then.
        """
        which = self.chosen(environments)
        seeds = [seed + int(b) for b in which] if isinstance(seed, int | np.integer) else list(seed)
        if len(seeds) != len(which):
            raise ValueError(f"expected one seed or {len(which)}, one per environment; got {len(seeds)}")
        generators = [np.random.default_rng(one) for one in seeds]  # a seed that is none is refused here
        given = self._initial_states(x0, len(which))
        state, loop = self._state, self._loop
        for b, rng in zip(which, generators, strict=True):
            state.x[:, b] = self.initial.draw(rng)
            if loop.disturbance is not None:
                state.drawn[b] = loop.disturbance.draw(rng)
        if given is not None:
            state.x[:, which] = np.broadcast_to(given, (len(which), self.fleet.n)).T
        state.estimate[:, which] = self.initial.center[self.design.states.layout.column_source][:, None]
        for zeros in (state.t, state.u, state.input_estimate, state.eps, state.nu, self._extremes):
            zeros[..., which] = 0.0
        self.integrator.start(state)
        self._watch()
        if not np.all(self._extremes[2, which] < 1.0):
            away = np.where(np.isfinite(self.g), np.abs(self.g), 0.0).max(axis=0)
            self.design.require_feasible_start(np.zeros(self.fleet.n), away)
        return self

    def step(self, dt: float, u: ArrayLike | None = None) -> None:
        """Advance every environment by `dt` seconds.

        Args:
            dt: step in s, positive; done in equal parts where a drift can't take it (`AgentModel.explicit_step`).
            u: (m,) or (B, m) inputs held over the step, where the simulator has no law; the last ones if left out.
                They are used as given: whoever needs the input limits, as a bounded g does, keeps them.

        Raises:
            ValueError: for a step that isn't positive or would have too many parts, or inputs given to a simulator
                with a law, misshapen or not finite; the state is unchanged.
            FunnelError: if an explicit step leaves the funnel; the state is the last one inside.
            SolveError: if a right-hand side gives numbers that aren't finite.
        """
        if not 0.0 < dt < math.inf:
            raise ValueError(f"dt must be positive and finite; got {dt!r}")
        parts = parts_of_step(float(dt), self._longest_step, self.fleet.ids[self._stiffest])
        if u is not None:
            self._hold(u)
        self._advance(float(dt), parts)
        self._watch()

    def save(self) -> SimulatorState:
        """Everything needed to continue bit for bit."""
        return self._state.copy()

    def restore(self, saved: SimulatorState) -> None:
        """Continue from a saved state; `extremes` start anew.

        Raises:
            ValueError: if it was saved by a simulator of other dimensions.
        """
        self._state.assign(saved)
        self._extremes[...] = 0.0
        self._watch()

    def restart_extremes(self) -> None:
        """Forget the ratios seen so far: `extremes` are those of the steps to come."""
        self._extremes[...] = 0.0

    def chosen(self, environments: Sequence[int] | IntArray | None) -> IntArray:
        """The environments meant, by number; all if None.

        Raises:
            ValueError: for one that there isn't, one named twice, or anything else than whole numbers.
        """
        if environments is None:
            return np.arange(self.batch)
        which = np.asarray(environments)
        if which.dtype == bool:
            raise ValueError("environments must be numbers, not a mask: give np.flatnonzero(mask)")
        wrong = which.ndim != 1 or (which.size and which.dtype.kind not in "iu")
        if wrong or np.any((which < 0) | (which >= self.batch)) or len(np.unique(which)) < len(which):
            raise ValueError(f"environments must be different ones among 0 to {self.batch - 1}; got {environments!r}")
        return which.astype(np.int64)

    def _initial_states(self, x0: ArrayLike | None, count: int) -> FloatArray | None:
        """Check given initial states, before anything is overwritten."""
        if x0 is None:
            return None
        given = np.asarray(x0, dtype=float)
        if given.shape not in ((self.fleet.n,), (count, self.fleet.n)) or not np.all(np.isfinite(given)):
            raise ValueError(
                f"x0 must be finite, of shape ({self.fleet.n},) or ({count}, {self.fleet.n}); got shape {given.shape}"
            )
        away = np.abs(given - self.initial.center).reshape(-1, self.fleet.n).max(axis=0)
        self.design.require_feasible_start(away, np.zeros(self.fleet.n))
        return given

    def _hold(self, u: ArrayLike) -> None:
        if self._loop.law is not None:
            raise ValueError("this simulator has a law, which computes the inputs; build it with law=None to give u")
        given = np.asarray(u, dtype=float)
        if given.shape not in ((self.fleet.m,), (self.batch, self.fleet.m)):
            raise ValueError(f"u must have shape ({self.fleet.m},) or {(self.batch, self.fleet.m)}; got {given.shape}")
        if not np.isfinite(given).all():
            bad = np.flatnonzero(~np.isfinite(given.reshape(-1, self.fleet.m)).all(axis=0))
            agent, name, unit = self.fleet.input_names()[bad[0]]
            raise ValueError(f"input {name!r} ({unit}) of {agent!r} isn't finite")
        self._state.u.T[...] = given
        self.integrator.start(self._state)

    def _advance(self, dt: float, parts: int) -> None:
        before = self._state.copy() if parts > 1 else None
        try:
            for _ in range(parts):
                self.integrator.step(self._state, dt / parts)
        except BaseException:
            if before is not None:
                self._state.assign(before)
            raise

    def _disagreement(self, funnels: Funnels, estimate: FloatArray, source: FloatArray) -> FloatArray:
        out = np.zeros((funnels.layout.size, self.batch))
        disagreement(*funnels.layout.arrays, estimate, source, out)
        return out

    def _watch(self) -> None:
        """Raise the running extremes to those of the present state."""
        state = self._state
        for funnels, estimate, source, rho, running in (
            (self.design.states, state.estimate, state.x, self._rho[0], self._extremes[:2]),
            (self.design.inputs, state.input_estimate, state.g, self._rho[1], self._extremes[2:]),
        ):
            if funnels.layout.size:
                funnels.rho.evaluate(state.t, rho)
                extremes(*funnels.layout.arrays, estimate, source, rho, funnels.gain, running)
