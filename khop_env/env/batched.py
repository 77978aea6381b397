"""B copies of one environment as arrays: what the PettingZoo, Gymnasium and SB3 classes are made of."""

from __future__ import annotations

import copy
import functools
import reprlib
from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike, NDArray

from khop_env.env.columns import ObservationColumns, global_state
from khop_env.env.kernels import judge, read_actions
from khop_env.env.layout import Float32Array, ObservationLayout
from khop_env.env.leaders import LeaderRoutes
from khop_env.env.options import seeds
from khop_env.env.settings import Settings
from khop_env.env.state import INFO_KEYS, EnvState, Infos, Step, signature
from khop_env.env.tasks import Task
from khop_env.observers import FloatArray, IntArray
from khop_env.simulation import Simulator


class BatchedEnv:
    """B copies of a fleet with its observers and a task, stepped together in compiled code.

    Arrays are (B, N, ...): copies, then agents; observations and actions (B, N, D) and (B, N, m) where they are
    uniform, otherwise (B, sum of D_i) and (B, sum of m_i), agents side by side. There is no autoreset:
    `reset(copies=...)` those that ended.

    Args:
        simulator: B copies, without a law.
        task: task edges and leaders.
        settings: everything else.
        scenario: name of the scenario that it was assembled from.

    Attributes:
        agents: ids of the N agents that act.
        fleet: all agents, leaders included.
        layouts: per agent what its observation holds.
        observation_offset: (N + 1,) where each agent's columns begin in the flat observation.
        action_offset: (N + 1,) where each agent's entries begin in the flat action.
        state_fields: what `state` holds.

    Raises:
        ValueError: for agents whose inputs have no limit, or a task edge to an agent more than k hops away.
    """

    def __init__(self, simulator: Simulator, task: Task, settings: Settings, scenario: str = "") -> None:
        self.simulator, self.task, self.settings, self.scenario = simulator, task, settings, scenario
        self.fleet, self.batch = simulator.fleet, simulator.batch
        self._members = [i for i in range(len(self.fleet)) if i not in task.leaders]
        self.agents = tuple(self.fleet.ids[i] for i in self._members)
        observed = ObservationColumns(
            simulator.design,
            task,
            self._members,
            observe=settings.observe,
            bounds=settings.bounds,
            uniform=settings.uniform,
            limit=settings.limit,
            inputs=settings.inputs_are_states,
        )
        self.layouts: tuple[ObservationLayout, ...] = tuple(observed.layouts)
        self.observation_offset, self._read_observations = observed.offset, observed.readout
        self.state_fields, self._read_state = global_state(self.fleet, settings.limit, settings.inputs_are_states)
        self._prepare_actions()
        self._prepare_rewards()
        agents = len(self._members)
        self._routes = LeaderRoutes(self.fleet, task, self.batch) if task.leaders else None
        rows = simulator.design.states.layout.rows if self._read_observations.uses_delta else 0
        self._delta = np.zeros((rows, self.batch))
        self._inputs, self._command, self._physical = (np.zeros((self.fleet.m, self.batch)) for _ in range(3))
        self._cost = np.zeros((2, agents, self.batch))
        self._cycles, self._over = np.zeros(self.batch, np.int64), np.ones(self.batch, bool)
        self._generators: list[np.random.Generator | None] = [None] * self.batch
        self._seeded = np.zeros(self.batch, bool)
        self._clipped_actions = np.zeros((self.batch, agents), np.int64)

    # -- the episode ---------------------------------------------------------------------------------------------

    def reset(
        self,
        seed: int | Sequence[int | None] | None = None,
        copies: Sequence[int] | IntArray | None = None,
        initial_states: ArrayLike | None = None,
    ) -> tuple[Float32Array, Infos]:
        """Start a new episode in all copies, or in some.

        Args:
            seed: copy b starts from seed + b, or from one seed per copy that is reset. Without a seed a copy goes on
                drawing from the generator that it was seeded with; one that never was draws fresh entropy.
            copies: (R,) which; all if left out.
            initial_states: (n,) or (R, n) states of all agents, leaders included; what is nan there is drawn.

        Returns:
            Observations and infos of all copies.

        Raises:
            ValueError: for a seed that isn't a non-negative integer, not R of them, or initial states of a wrong shape
                or infinite; nothing has been reset then.
            DesignError: for initial states that the observers can't start from; likewise.
        """
        which = self.simulator.chosen(copies)
        chosen = seeds(seed, which)
        generators = [self._generator(int(b), one) for b, one in zip(which, chosen, strict=True)]
        if initial_states is not None:
            initial_states = self._completed(np.asarray(initial_states, dtype=float), generators)
        self.simulator.reset(generators, initial_states, which)
        for b, one, generator in zip(which.tolist(), chosen, generators, strict=True):
            self._generators[b] = generator
            self._seeded[b] |= one is not None
            if self._routes is not None:
                self._routes.draw(b, generator, self.simulator.x[b])
        self._inputs[:, which] = 0.0
        self._cycles[which] = 0
        self._over[which] = False
        self._clipped_actions[which] = 0
        return self._observed(self._judge()[1])

    def step(self, actions: ArrayLike, ended: NDArray[np.bool_] | None = None) -> Step:
        """Advance all copies by one control period.

        Args:
            actions: (B, N, m) or (B, A), in [-1, 1]; what is outside is clipped, padded entries are ignored.
            ended: (B,) copies whose episode may be over already. They are stepped with the others, what is returned for
                them means nothing, and the caller resets them.

        Returns:
            Observations, rewards (B, N), terminated (B,), truncated (B,), infos (arrays (B, N)).

        Raises:
            ValueError: for actions of a wrong shape or not finite, or a copy whose episode is over; nothing has
                changed.
            SolveError: if a state becomes infinite.
        """
        over = np.flatnonzero(self._over if ended is None else self._over & ~ended)
        if over.size:
            raise ValueError(
                f"no episode is running in {len(over)} of {self.batch} copies, the first {over[0]}: call reset() first"
            )
        self._take(actions)
        self.simulator.restart_extremes()
        for number in range(self.settings.substeps):
            self._advance(number)
        self._cycles += 1
        reward, info = self._judge()
        terminated = np.zeros(self.batch, bool)
        if self.settings.success_radius is not None:
            terminated = info[0].max(axis=1) <= self.settings.success_radius
        truncated = (self._cycles >= self.settings.max_cycles) & ~terminated
        self._over = terminated | truncated
        observations, infos = self._observed(info)
        return observations, reward, terminated, truncated, infos

    def observations(self) -> Float32Array:
        """What the agents observe now, in new memory."""
        return self._observe()[0]

    @property
    def over(self) -> NDArray[np.bool_]:
        """(B,) whether a copy's episode has ended, or none has begun."""
        return self._over.copy()

    @property
    def begun(self) -> NDArray[np.bool_]:
        """(B,) whether a copy was ever reset."""
        return np.array([generator is not None for generator in self._generators])

    def task_errors(self) -> FloatArray:
        """(B, N) each agent's root mean square error along its task edges now, in m."""
        return self._judge()[1][0]

    def state(self) -> Float32Array:
        """(B, S) the true global state, `state_fields` by name, in new memory."""
        simulator, uncounted = self.simulator, np.zeros((self.batch, 1), np.int64)
        return self._read_state(simulator.x.T, simulator.estimates.T, self._delta, self._inputs, uncounted)

    def get_state(self) -> EnvState:
        """A copy of everything that the next steps depend on, generators included."""
        return EnvState(
            self.simulator.save(),
            self._inputs.copy(),
            self._cycles.copy(),
            self._over.copy(),
            self._signature,
            () if self._routes is None else (self._routes.drawn.copy(), self._routes.start.copy()),
            copy.deepcopy(self._generators),
            self._seeded.copy(),
        )

    def set_state(self, state: EnvState) -> None:
        """Continue from `get_state()`'s result, which stays as it is.

        Raises:
            TypeError: if it isn't one; nothing has changed then.
            ValueError: if it is of an environment of another task, actuator or size, saying what differs; likewise.
        """
        if not isinstance(state, EnvState):
            raise TypeError(
                f"set_state() takes what get_state() returned, an EnvState; got {reprlib.repr(state)} "
                f"({type(state).__name__})"
            )
        state.require_of(self._signature)
        self.simulator.restore(state.simulator)
        self._inputs[...] = state.inputs
        self._cycles, self._over, self._seeded = state.cycles.copy(), state.over.copy(), state.seeded.copy()
        self._generators = copy.deepcopy(state.generators)
        if self._routes is not None:
            self._routes.drawn, self._routes.start = (one.copy() for one in state.routes)

    # -- parts ---------------------------------------------------------------------------------------------------

    @functools.cached_property
    def _signature(self) -> dict[str, tuple[str, ...]]:
        return signature(self.fleet, self.task, self.settings.actuator)  # type: ignore[arg-type]

    def _generator(self, b: int, seed: int | None) -> np.random.Generator:
        mine = self._generators[b]
        if seed is not None or mine is None or not self._seeded[b]:
            return np.random.default_rng(seed)
        return mine

    def _completed(self, x0: FloatArray, generators: Sequence[np.random.Generator]) -> FloatArray:
        """Initial states with what the simulator would draw in place of nan."""
        if not np.isnan(x0).any() or x0.shape[-1:] != (self.fleet.n,):
            return x0
        drawn = np.array([self.simulator.initial.draw(copy.deepcopy(one)) for one in generators])
        return np.where(np.isnan(x0), drawn, x0)

    def _prepare_actions(self) -> None:
        """Which entry of the flat action is which input."""
        fleet, models = self.fleet, [self.fleet.models[i] for i in self._members]
        unlimited = [
            name for name, model in zip(self.agents, models, strict=True) if not np.isfinite(model.input_limit).all()
        ]
        if unlimited:
            raise ValueError(
                f"actions are fractions of the input limits, and {', '.join(unlimited[:4])} has none: give its model "
                "an input_limit"
            )
        sizes = np.array([model.m for model in models])
        shown = np.full(len(sizes), sizes.max()) if self.settings.uniform else sizes
        self.action_offset: IntArray = np.concatenate([[0], np.cumsum(shown)])
        parts = [(number, c) for number, size in enumerate(sizes) for c in range(size)]
        self._action_owner = np.array([number for number, _ in parts], np.int64)
        self._action_entry = np.array([self.action_offset[number] + c for number, c in parts], np.int64)
        offset = fleet.input_offset[self._members]
        self._action_column = np.array([offset[number] + c for number, c in parts], np.int64)
        self._input_owner = np.full(fleet.m, -1, np.int64)
        self._input_owner[self._action_column] = self._action_owner
        self._led = np.flatnonzero(self._input_owner < 0)
        self._input_limit = fleet.input_limit[:, None]
        self._scale = np.where(np.isfinite(self._input_limit), self._input_limit, 1.0)

    def _prepare_rewards(self) -> None:
        """Whose edge it is and where its two positions are; edges of leaders don't count."""
        number = {i: place for place, i in enumerate(self._members)}
        mine = np.array([i in number for i in self.task.edges[:, 0].tolist()], bool)
        edges, position = self.task.edges[mine], self.fleet.position_index
        owner = np.array([number[i] for i in edges[:, 0].tolist()], np.int64)
        count = np.bincount(owner, minlength=len(self._members))
        self._edges = (
            owner,
            np.ascontiguousarray(position[edges[:, 0]]),
            np.ascontiguousarray(position[edges[:, 1]]),
            np.ascontiguousarray(self.task.displacement[mine]),
            1.0 / count[owner],
        )

    def _take(self, actions: ArrayLike) -> None:
        """Write actions into the commands, or refuse them and change nothing."""
        given = np.asarray(actions)
        width = int(self.action_offset[-1])
        shapes: list[tuple[int, ...]] = [(self.batch, width)]
        if self.settings.uniform:
            shapes.insert(0, (self.batch, len(self.agents), width // len(self.agents)))
        if given.shape not in shapes or given.dtype.kind not in "fiu":
            raise ValueError(f"actions must be numbers of shape {shapes[0]}; got {given.dtype} of shape {given.shape}")
        flat = np.ascontiguousarray(given.reshape(self.batch, width), np.float64)
        clipped = np.zeros_like(self._clipped_actions)
        bad = read_actions(flat, self._action_entry, self._action_column, self._action_owner, self._command, clipped)
        if bad >= 0:
            env, entry = divmod(bad, len(self._action_entry))
            owner = self._action_owner[entry]
            where = f" in copy {env}" if self.batch > 1 else ""
            raise ValueError(
                f"the action of {self.agents[owner]!r}{where} isn't finite: entry "
                f"{self._action_entry[entry] - self.action_offset[owner]} is {flat[env, self._action_entry[entry]]}"
            )
        self._clipped_actions = clipped

    def _advance(self, number: int) -> None:
        """One simulator step of the control period."""
        settings, simulator = self.settings, self.simulator
        dt = settings.control_period / settings.substeps
        self._inputs[...] = settings.actuator(self._command.T, self._inputs.T, dt, number, settings.substeps).T  # type: ignore[operator]
        np.multiply(self._inputs, self._scale, out=self._physical)
        if self._routes is not None:
            self._routes.command(simulator.t, simulator.x, self._physical.T)
            self._inputs[self._led] = self._physical[self._led] / self._input_limit[self._led]
        simulator.step(dt, self._physical.T)

    def _judge(self) -> tuple[FloatArray, FloatArray]:
        """Rewards (B, N), and the first three infos (3, B, N)."""
        settings = self.settings
        simulator, shape = self.simulator, (self.batch, len(self.agents))
        reward, info = np.empty(shape), np.empty((3, *shape))
        scale = settings.control_period, float(settings.effort)
        seen = simulator.extremes
        ratios = seen.normalized, seen.relative, seen.input_normalized, seen.input_relative
        judge(*self._edges, simulator.x.T, self._input_owner, self._inputs, scale, ratios, self._cost, reward, info)
        if settings.reward == "team":
            reward[...] = reward.mean(axis=1, keepdims=True)
        return reward, info

    def _observe(self) -> tuple[Float32Array, IntArray]:
        """Observations, and how many entries of each agent's were clipped."""
        simulator = self.simulator
        clipped = np.zeros((self.batch, len(self.agents)), np.int64)
        if len(self._delta):
            simulator.design.states.delta.evaluate(simulator.t, self._delta)
        flat = self._read_observations(simulator.x.T, simulator.estimates.T, self._delta, self._inputs, clipped)
        if self.settings.uniform:
            return flat.reshape(self.batch, len(self.agents), -1), clipped
        return flat, clipped

    def _observed(self, info: FloatArray) -> tuple[Float32Array, Infos]:
        observations, clipped = self._observe()
        values = (*info, clipped, self._clipped_actions.copy())
        return observations, dict(zip(INFO_KEYS, values, strict=True))
