"""A batch of environments as arrays, on which the PettingZoo, Gymnasium and SB3 classes are built."""

from __future__ import annotations

import copy
import functools
import reprlib
from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import ArrayLike, NDArray

from khop_env.brief import spread
from khop_env.env.actions import ActionReader
from khop_env.env.actuators import compiled_form
from khop_env.env.columns import ObservationColumns, global_state
from khop_env.env.layout import Float32Array, ObservationLayout
from khop_env.env.options import completed, seeds
from khop_env.env.period import OTHER, actuate, as_fractions, end_period, larger_for_all
from khop_env.env.readout import Sources, summarize
from khop_env.env.settings import Settings
from khop_env.env.state import EnvState, Infos, Step, signature
from khop_env.observers import FloatArray, IntArray
from khop_env.simulation import Simulator
from khop_env.simulation.received import ReceivedStates, links_up
from khop_env.simulation.state import selected
from khop_env.tasks import Outcome, Task, World
from khop_env.tasks.checks import require_columns, require_outcome
from khop_env.threads import Threads


class BatchedEnv:
    """B environments, each a fleet with its observers and a task, stepped together in compiled code.

    Arrays are (B, N, ...): environments, then agents; observations and actions (B, N, D) and (B, N, m) where they are
    uniform, otherwise (B, sum of D_i) and (B, sum of m_i), agents side by side. There is no autoreset:
    `reset(env_ids=...)` the environments that ended.

    Args:
        simulator: of B environments, without a law, built with a task graph.
        task: acting agents, rewards, termination, and additional columns of observations.
        settings: all other arguments.
        scenario: name of the scenario that the simulator was built from.

    Attributes:
        task: this environment's own copy, bound to the fleet.
        world: the true state, as an argument of the task's methods.
        agents: ids of the N agents that act.
        fleet: all agents.
        num_envs: number of environments B.
        layouts: names, units and bounds of the columns of each agent's observation.
        observation_offset: (N + 1,) where each agent's columns begin in the flat observation.
        action_offset: (N + 1,) where each agent's entries begin in the flat action.
        state_fields: names, units and bounds of the columns of `state`.

    Raises:
        ValueError: for acting agents whose inputs have no limit, or a task edge to an agent more than k hops away.
    """

    def __init__(self, simulator: Simulator, task: Task, settings: Settings, scenario: str = "") -> None:
        self.simulator, self.settings, self.scenario = simulator, settings, scenario
        self.fleet, self.num_envs = simulator.fleet, simulator.num_envs
        inputs, state = np.zeros((self.fleet.m, self.num_envs)), simulator.state
        shared, wanted = simulator.plant.threads, settings.threads_for(self.num_envs)
        self.world = World(
            simulator.design,
            simulator.task_graph,
            self.num_envs,
            settings.control_period,
            settings.limit,
            t=state.t,
            x=state.x,
            inputs=inputs,
            initial=simulator.initial,
            threads=shared if shared.count == wanted else Threads(wanted),
        )
        self.task = copy.deepcopy(task)
        self.task.memory = {}  # for those that override `bind` and have none
        self.task.bind(self.world)
        members = [int(i) for i in self.task.acting(self.world)]
        self.agents = tuple(self.fleet.ids[i] for i in members)
        observed = ObservationColumns(
            self.world,
            simulator.observers,
            self.task,
            members,
            observe=settings.observe,
            bounds=settings.bounds,
            uniform=settings.uniform,
            inputs=settings.inputs_are_states,
            message_size=settings.message_size,
        )
        self.layouts: tuple[ObservationLayout, ...] = tuple(observed.layouts)
        self.observation_offset, self._read_observations = observed.offset, observed.readout
        named = {layout.agent: layout.names for layout in self.layouts}
        require_columns(self.task, self._read_observations.task_rows, named)
        self.state_fields, self._read_state = global_state(self.fleet, settings.limit, settings.inputs_are_states)
        self._actions = ActionReader(self.fleet, members, settings.uniform, self.num_envs, settings.message_size)
        self.action_offset: IntArray = self._actions.offset
        acting = np.zeros(self.fleet.m, bool)
        for i in members:
            acting[self.fleet.input_slice(i)] = True
        self._driven = np.flatnonzero(~acting)
        self._limit = self.fleet.input_limit[:, None]
        self._scale = np.where(np.isfinite(self._limit), self._limit, 1.0)
        observers = simulator.observers
        nothing = np.zeros((0, self.num_envs))
        self._said, data = (state.memory.get(name, nothing) for name in ("said", "data"))
        bounded = len(state.memory["estimate"]) if self._read_observations.uses_bounds else 0
        changing = simulator.design.schedule is not None and not observers.by_messages
        self._received = ReceivedStates(simulator.design, observers, self.num_envs) if changing else None
        known = len(simulator.design.links) if changing else 4 * observers.layout.pairs * observers.by_messages
        self._sources = Sources(
            state.x,
            state.memory["estimate"],
            np.zeros((bounded, self.num_envs)),
            inputs,
            np.zeros((self._read_observations.task_rows, self.num_envs)),
            np.zeros((known, self.num_envs)),
            data,
        )
        self._substeps, self._dt = settings.substeps, settings.control_period / settings.substeps
        self._parts = simulator.parts_of(self._dt)
        self._command, self._physical = np.zeros_like(inputs), np.zeros_like(inputs)
        self._cycles, self._over = np.zeros(self.num_envs, np.int64), np.ones(self.num_envs, bool)
        self._some_over = True
        self._generators: list[np.random.Generator | None] = [None] * self.num_envs
        self._seeded = np.zeros(self.num_envs, bool)
        self._clipped_actions = np.zeros((self.num_envs, len(members)), np.int64)

    def __str__(self) -> str:
        act = "" if len(self.agents) == len(self.fleet) else f", of which {len(self.agents)} act"
        made = f"{self.task.environment} on {self.scenario!r}{act}: {self.simulator.design}"
        if self.simulator.observers.by_messages:
            made += f", {self.simulator.observers!r}"
        return f"{made}; observe={self.settings.observe!r}, num_envs={self.num_envs}, {spread(self.world.t)}"

    def __repr__(self) -> str:
        return f"BatchedEnv({self})"

    # -- the episode ---------------------------------------------------------------------------------------------

    def reset(
        self,
        seed: int | Sequence[int | None] | None = None,
        env_ids: Sequence[int] | IntArray | None = None,
        initial_states: ArrayLike | None = None,
    ) -> tuple[Float32Array, Infos]:
        """Start a new episode in all environments, or in some.

        Args:
            seed: environment b starts from seed + b, or from one seed per environment that is reset. Without a seed an
                environment goes on with its generator; if it never was seeded, it draws fresh entropy.
            env_ids: (R,) indices of the environments to reset; all by default.
            initial_states: (n,) or (R, n) states of all agents, leaders included; nan where they are drawn.

        Returns:
            Observations and infos of all environments.

        Raises:
            ValueError: for a seed that isn't a non-negative integer, not R of them, or initial states of a wrong shape
                or infinite; nothing has been reset then.
            DesignError: for initial states outside the funnels; likewise.
        """
        chosen = selected(env_ids, self.num_envs)
        chosen_seeds = seeds(seed, chosen)
        generators = [self._generator(int(b), own) for b, own in zip(chosen, chosen_seeds, strict=True)]
        if initial_states is not None:
            initial_states = completed(initial_states, self.simulator.initial, generators)
        self.simulator.reset(generators, initial_states, chosen)
        for b, own, generator in zip(chosen.tolist(), chosen_seeds, generators, strict=True):
            self._generators[b] = generator
            self._seeded[b] |= own is not None
        self.world.inputs[:, chosen] = 0.0
        self._cycles[chosen] = 0
        self._over[chosen] = False
        self._some_over = bool(self._over.any())
        self._clipped_actions[chosen] = 0
        self.task.reset(self.world, chosen, generators)
        return self._observed(self._evaluate())

    def step(self, actions: ArrayLike, ended: NDArray[np.bool_] | None = None) -> Step:
        """Advance all environments by one control period.

        Args:
            actions: (B, N, m) or (B, A); clipped to [-1, 1], padded entries are ignored.
            ended: (B,) environments whose episode may be over already. They are stepped with the others, their results
                are meaningless, and the caller resets them.

        Returns:
            Observations, rewards (B, N), terminated (B,), truncated (B,), infos (arrays (B, N)).

        Raises:
            ValueError: for actions of a wrong shape or not finite, or an environment whose episode is over; nothing has
                changed.
            SolveError: if a state becomes infinite.
        """
        self._require_running(ended)
        self._clipped_actions = self._actions.read(actions, self._command, self._said)
        self.simulator.restart_extremes()
        for number in range(self._substeps):
            self._advance(number)
        outcome, truncated = self._evaluate(), np.empty(self.num_envs, bool)
        self._some_over = end_period(self._cycles, self.settings.horizon, outcome.terminated, truncated, self._over)
        observations, infos = self._observed(outcome)
        return observations, outcome.reward, outcome.terminated, truncated, infos

    def observations(self) -> Float32Array:
        """Observations at the present time, in new memory."""
        return self._observe()[0]

    @property
    def over(self) -> NDArray[np.bool_]:
        """(B,) True where the episode has ended, or none has begun."""
        return self._over.copy()

    @property
    def running(self) -> bool:
        """Whether an episode is running in all environments."""
        return not self._some_over

    @property
    def begun(self) -> NDArray[np.bool_]:
        """(B,) True where the environment has been reset at least once."""
        return np.array([generator is not None for generator in self._generators])

    def task_errors(self) -> FloatArray:
        """(B, N) each agent's present task error, in the task's unit."""
        return self._evaluate().infos["task_error"]

    def state(self) -> Float32Array:
        """(B, S) the true global state, `state_fields` by name, in new memory."""
        out = self._read_state.empty(self.num_envs)
        self._read_state.write(self._sources, out, np.zeros((self.num_envs, 1), np.int64), 0, self.num_envs)
        return out

    def get_state(self) -> EnvState:
        """A copy of everything that the next steps depend on, generators included."""
        return EnvState(
            self.simulator.save(),
            self.world.inputs.copy(),
            self._cycles.copy(),
            self._over.copy(),
            self._signature,
            {name: values.copy() for name, values in self.task.memory.items()},
            copy.deepcopy(self._generators),
            self._seeded.copy(),
        )

    def set_state(self, state: EnvState) -> None:
        """Continue from `get_state()`'s result, which stays as it is.

        Raises:
            TypeError: if it isn't an `EnvState`; nothing has changed then.
            ValueError: if it is of an environment of another task, actuator or size, naming the difference; likewise.
        """
        if not isinstance(state, EnvState):
            raise TypeError(
                f"set_state() takes what get_state() returned, an EnvState; got {reprlib.repr(state)} "
                f"({type(state).__name__})"
            )
        state.require_of(self._signature)
        self.simulator.restore(state.simulator)
        self.world.inputs[...] = state.inputs
        self._cycles, self._over, self._seeded = state.cycles.copy(), state.over.copy(), state.seeded.copy()
        self._some_over = bool(self._over.any())
        self._generators = copy.deepcopy(state.generators)
        for name, values in state.task.items():
            self.task.memory[name][...] = values

    # -- parts ---------------------------------------------------------------------------------------------------

    @functools.cached_property
    def _signature(self) -> dict[str, tuple[str, ...]]:
        return signature(self.task, self.world, self.settings, self.simulator.disturbance, self.simulator.observers)

    def _generator(self, b: int, seed: int | None) -> np.random.Generator:
        own = self._generators[b]  # must not repeat the draws of the environment it was copied from, unless seeded
        if seed is not None or own is None or not self._seeded[b]:
            return np.random.default_rng(seed)
        return own

    def _require_running(self, ended: NDArray[np.bool_] | None) -> None:
        if self._some_over and (over := np.flatnonzero(self._over if ended is None else self._over & ~ended)).size:
            raise ValueError(
                f"no episode is running in {len(over)} of {self.num_envs} environments, the first {over[0]}: call "
                "reset() first"
            )

    def _advance(self, number: int) -> None:
        """One simulator step of the control period."""
        actuator: Any = self.settings.actuator
        inputs, physical = self.world.inputs, self._physical
        kind, parameter = compiled_form(actuator, self._dt, number, self._substeps)
        if kind == OTHER:
            inputs[...] = actuator(self._command.T, inputs.T, self._dt, number, self._substeps).T
        actuate(kind, parameter, self._command, self._scale, inputs, physical)
        if self._driven.size:
            self.task.drive(self.world, physical)
            as_fractions(self._driven, physical, self._limit, inputs)
        self.simulator.step_unchecked(self._dt, self._parts, physical)
        self.task.moved(self.world, number)

    def _evaluate(self) -> Outcome:
        outcome = self.task.evaluate(self.world)
        require_outcome(self.task, outcome, self.num_envs, len(self.agents))
        return outcome

    def _observe(self) -> tuple[Float32Array, IntArray]:
        """Observations, and the number of clipped entries of each agent's."""
        sources, clipped = self._sources, np.zeros((self.num_envs, len(self.agents)), np.int64)
        readout, flat = self._read_observations, self._read_observations.empty(self.num_envs)
        observers, state = self.simulator.observers, self.simulator.state
        information = observers.information(state) if observers.by_messages else None
        if sources.bound.size:
            observers.bound(state, sources.bound)
        if self._received is not None:
            up = links_up(self.simulator.design, observers, state)
            sources.known[...] = up
            if self.settings.observe == "estimate":
                sources = sources._replace(estimate=self._received.states(state, up))
                if sources.bound.size:
                    self._received.bounds(sources.bound, up)
        if sources.task.size:
            self.task.observe(self.world, sources.task)

        def write(low: int, high: int) -> None:
            if information is not None:
                summarize(*information, state.t, sources.known, self.settings.control_period, low, high)
            readout.write(sources, flat, clipped, low, high)

        self.world.each(write, readout.size)
        if self.settings.uniform:
            return flat.reshape(self.num_envs, len(self.agents), -1), clipped
        return flat, clipped

    def _observed(self, outcome: Outcome) -> tuple[Float32Array, Infos]:
        observations, clipped = self._observe()
        extremes = self.simulator.running_extremes
        normalized, relative = (np.empty((self.num_envs, len(self.agents))) for _ in range(2))
        larger_for_all(tuple(extremes), normalized, relative)
        return observations, {
            **outcome.infos,
            "max_normalized_disagreement": normalized,
            "max_error_to_bound": relative,
            "clipped_observations": clipped,
            "clipped_actions": self._clipped_actions.copy(),
        }
