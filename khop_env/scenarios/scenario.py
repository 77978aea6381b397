"""A named problem: agents, graphs, bounds, disturbances and a law, from which a simulator is built."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, replace
from functools import cached_property
from typing import Any

import networkx as nx
import numpy as np
from numpy.typing import ArrayLike

from khop_env.network import Network, Schedule
from khop_env.observers import (
    Bound,
    DesignRule,
    Estimator,
    Exponential,
    Networked,
    ObserverDesign,
    Observers,
    PerformanceFunction,
    Proximal,
    TargetObservers,
    as_estimator,
)
from khop_env.observers.design import design_rule_for
from khop_env.observers.known_estimators import as_observers
from khop_env.physics import AgentModel, Disturbance, Fleet, Links, check_task_graph, did_you_mean, validate_graph
from khop_env.scenarios.bounds import check_bound, widened
from khop_env.scenarios.parts import require_parts
from khop_env.simulation import Arena, InitialSet, Law, Observe, Simulator

MOST_AGENTS = 100_000
SHORTEST_TIME, LONGEST_TIME = 1e-9, 1e9  # s
MOST_STEPS = 100_000_000
MOST_NUMBERS = 2**26  # states and estimates of all environments: about 10 GiB in all

Bounds = PerformanceFunction | Mapping[str, Bound]
"""Bounds on estimation errors: one function for all agents, or one `Bound` per agent type."""


@dataclass(frozen=True)
class LawChoice:
    """The name of a feedback law and its parameters; `agents.make_law` turns it into the law."""

    name: str
    parameters: Mapping[str, Any] = field(default_factory=dict)


@dataclass(frozen=True, eq=False, kw_only=True)
class Scenario:
    """A complete problem, from which a simulator or an environment is built.

    Attributes:
        name: of the scenario, also of its folder of results.
        description: one line.
        models: one agent model per agent; neighbours with equal models are evaluated together.
        communication: the communication graph; nodes 0..N-1, connected. A networkx.DiGraph for links that go one way,
            with an edge b -> a where agent a hears agent b.
        task: the task graph: pairs of agents that should agree, on the same nodes, within k hops.
        k: agents up to k hops away are estimated.
        relay: whether agents relay their neighbours' states (the paper's Assumption 4).
        delta: bounds on the state estimation errors.
        theta: bounds on the input estimation errors, where there are input observers.
        design_rule: from these bounds to the funnels on the disagreements: "paper", or "sharp" for the widest ones;
            None for the default of `ObserverDesign`.
        schedule: which links of the communication graph are up, and when; None for all of them, always.
        observers: per agent the options of its observers; None for the default of `ObserverDesign`.
        disturbance: w_i(x, t), or None.
        center: (n,) centre of the box that states start in, and the observers' first guess.
        radius: (n,) its half widths.
        arena: the agents' size, obstacles, goals and smallest initial distance, for tasks in which they may collide.
        law: name and parameters of the default feedback law.
        duration: length of an experiment in s.
        dt: step in s.
        order: of the proximal step; not used under a network.
        network: how messages are exchanged, also by name ("wifi") or as a mapping; None: exchange in continuous time.
        estimator: from messages to estimates under a network, "ppso" or "relay", or an `Estimator`.
        figure_agent: index of the agent whose estimates figures show; None for the agent with most observers.

    Raises:
        ValueError: if graphs, sets and agents don't match; the message names them.
    """

    name: str
    description: str
    models: tuple[AgentModel, ...]
    communication: nx.Graph
    task: nx.Graph
    k: int
    delta: Bounds
    theta: Bounds | None = None
    design_rule: DesignRule | None = None
    relay: bool = True
    schedule: Schedule | None = None
    observers: tuple[TargetObservers, ...] | None = None
    disturbance: Disturbance | None = None
    center: ArrayLike = 0.0
    radius: ArrayLike = 1.0
    arena: Arena | None = None
    law: LawChoice = LawChoice("tanh")
    duration: float = 10.0
    dt: float = 0.01
    order: int = 2
    network: Network | str | Mapping[str, object] | None = None
    estimator: str | Estimator = "ppso"
    figure_agent: int | None = None

    def __post_init__(self) -> None:
        self._check_values()
        agents = len(self.models)
        # copies without attributes: an edge counts once, whatever weight it carries
        object.__setattr__(self, "communication", validate_graph(self.communication, agents, directed=True))
        try:
            design_rule_for(self.communication, self.design_rule)
            object.__setattr__(self, "schedule", Schedule.of(self.schedule))
            if self.schedule is not None:
                self.schedule.bind(Links.of(self.communication), self.fleet.position_index)
            object.__setattr__(self, "network", Network.of(self.network))
            as_estimator(self.estimator)  # raises for an unknown name
        except ValueError as error:
            raise ValueError(f"scenario {self.name!r}: {error}") from None
        object.__setattr__(self, "task", check_task_graph(self.task, self.communication, self.k))
        for name in ("center", "radius"):
            values = np.asarray(getattr(self, name), dtype=float)
            if values.shape not in ((), (self.fleet.n,)) or not np.all(np.isfinite(values)):
                raise ValueError(
                    f"scenario {self.name!r}: {name} must be one finite number or {self.fleet.n}, one per state "
                    f"component of the fleet; got shape {values.shape}"
                )
            object.__setattr__(self, name, np.broadcast_to(values, (self.fleet.n,)).copy())
        if np.any(np.asarray(self.radius) < 0.0):
            raise ValueError(f"scenario {self.name!r}: radius must not be negative")
        if self.arena is not None and self.arena.obstacles and self.fleet.position_dim != 2:
            raise ValueError(
                f"scenario {self.name!r}: obstacles are in the plane, and positions have {self.fleet.position_dim} axes"
            )

    def _check_values(self) -> None:
        """Check the values that don't depend on fleet and graphs."""
        for key, text in (("name", self.name), ("description", self.description.replace("\n", ""))):
            if not text.isprintable():
                raise ValueError(f"scenario {self.name!r}: {key} must not have control characters; got {text!r}")
        if not 0 < len(self.name) <= 200 or "/" in self.name:
            raise ValueError(
                f"a scenario's name is also a folder's: 1 to 200 characters without '/'; got {self.name[:200]!r}"
            )
        require_parts(self.name, vars(self))
        if self.order not in (1, 2, 3):
            raise ValueError(f"scenario {self.name!r}: order must be 1, 2 or 3; got {self.order!r}")
        if not 0 < len(self.models) <= MOST_AGENTS:
            raise ValueError(
                f"scenario {self.name!r}: expected 1 to {MOST_AGENTS} models, one per agent; got {len(self.models)}"
            )
        agent = self.figure_agent
        if agent is not None and (type(agent) is not int or not 0 <= agent < len(self.models)):
            raise ValueError(
                f"scenario {self.name!r}: figure_agent must be None or an agent's index from 0 to "
                f"{len(self.models) - 1}; got {agent!r}"
            )
        try:
            number_of_steps(self.duration, self.dt)
        except ValueError as error:
            raise ValueError(f"scenario {self.name!r}: {error}") from None

    def __repr__(self) -> str:
        edges = f"{self.communication.number_of_edges()} communication and {self.task.number_of_edges()} task edges"
        network = Network.of(self.network)
        messages = "" if network is None else f", {network.described()}"
        return (
            f"Scenario({self.name!r}: {self.fleet}; k={self.k}, {edges}{messages}; law {self.law.name!r}, "
            f"{self.duration:g} s in steps of {self.dt:g} s)"
        )

    def replace(self, **changes: Any) -> Scenario:
        """A copy with some attributes changed."""
        return replace(self, **changes)

    @cached_property
    def fleet(self) -> Fleet:
        """The agents, numbered."""
        return Fleet(self.models)

    @cached_property
    def initial(self) -> InitialSet:
        """The set in which states start."""
        return InitialSet(np.asarray(self.center), np.asarray(self.radius), self.arena, self.fleet.position_index)

    @cached_property
    def longest_step(self) -> tuple[float, int]:
        """Longest step in s for which all drifts are stable (inf if every step is), and the agent that limits it."""
        reach = np.abs(self.initial.center) + self.initial.radius
        bound = np.zeros(self.fleet.n) if self.disturbance is None else self.disturbance.attach(self.fleet).bound
        return self.fleet.explicit_step(reach, bound)

    @property
    def warnings(self) -> list[str]:
        """Warnings about choices that are valid, but rarely intended."""
        parts = [[self.fleet.ids[i] for i in sorted(part)] for part in nx.connected_components(self.task)]
        if len(parts) < 2:
            return []
        first = [", ".join(part[:4]) + (", ..." if len(part) > 4 else "") for part in sorted(parts)[:4]]
        return [
            f"the task graph falls into {len(parts)} parts, which agree among themselves only: "
            f"{'; '.join(first)}{'; ...' if len(parts) > 4 else ''}"
        ]

    @cached_property
    def design(self) -> ObserverDesign:
        """The observers: k-hop sets, matrices and funnels.

        Raises:
            DesignError: if they can't be designed with these values, or a user's function isn't a performance function.
        """
        design = ObserverDesign(
            self.fleet,
            self.communication,
            self.k,
            self._per_agent(self.delta, "delta"),
            None if self.theta is None else self._per_agent(self.theta, "theta"),
            self.relay,
            self.observers,
            self.design_rule,
            self.schedule,
        )
        for name, funnels in (("delta", design.states), ("theta", design.inputs)):
            for bound in {id(f): f for f in funnels.bounds if type(f) is not Exponential}.values():
                check_bound(bound, name)
        return design

    def sized(self, margin: float = 1.25) -> Scenario:
        """A copy whose bounds start `margin` times as wide as the initial set needs; final values and rates stay.

        One bound for all agents stays one function, bounds by type get one function per component. Where |g| is
        unbounded, theta(0) isn't changed: `Simulator.reset` checks it.

        Args:
            margin: above 1.

        Raises:
            ValueError: if a bound isn't `Exponential`, or margin isn't above 1.
        """
        if not margin > 1.0:
            raise ValueError(f"margin must exceed 1, or states could start on the funnel's wall; got {margin!r}")
        design = self.design
        resized: dict[str, Bounds] = {}
        for name, funnels, radius in (
            ("delta", design.states, self.initial.radius),
            ("theta", design.inputs, self.fleet.input_map_bound),
        ):
            bounds = getattr(self, name)
            if bounds is None:
                continue
            needed = margin * funnels.smallest_initial_bound(radius)
            present = funnels.delta.evaluate(np.zeros(1), np.empty((len(needed), 1)))[:, 0]
            needed = np.where(np.isfinite(needed), needed, present)  # an unbounded g needs an infinite theta(0)
            if not isinstance(bounds, Mapping):
                resized[name] = widened(bounds, needed.max(initial=0.0))
                continue
            agent_type = np.array([self.models[i].type for i in funnels.layout.target])[funnels.layout.row_target]
            resized[name] = {
                kind: [
                    widened(function, needed[agent_type == kind].reshape(-1, n)[:, c].max(initial=0.0))
                    for c, function in enumerate(bound if isinstance(bound, Sequence) else [bound] * n)
                ]
                for kind, bound in bounds.items()
                for n in [next(model.n for model in self.models if model.type == kind)]
            }
        copy = self.replace(**resized)
        theta = None if copy.theta is None else copy._per_agent(copy.theta, "theta")
        copy.__dict__["design"] = design.with_bounds(copy._per_agent(copy.delta, "delta"), theta)
        return copy

    def build(
        self,
        *,
        law: Law | None = None,
        observe: Observe = "estimate",
        observers: Observers | None = None,
        num_envs: int = 1,
    ) -> Simulator:
        """A simulator of `num_envs` environments.

        Args:
            law: feedback law, e.g. `agents.make_law(scenario.law)`; None to pass inputs to `Simulator.step`.
            observe: source of the states of k-hop targets in the law's view, as in `Simulator`.
            observers: realisation of the observers; by default that of the scenario's `network` and `estimator`, or
                without a network `Proximal` of its `order`.
            num_envs: number of environments B.

        Raises:
            ValueError: for more environments than `MOST_NUMBERS` states and estimates allow, or observers that aren't.
        """
        realisation = self._realisation() if observers is None else as_observers(observers)
        estimated = self.design.knowledge if realisation.by_messages else self.design.states.layout
        width = self.fleet.n + estimated.size + self.design.inputs.layout.size
        if num_envs * width > MOST_NUMBERS:
            raise ValueError(
                f"{num_envs} environments of {self.name!r} have {num_envs * width:.3g} states and estimates; take "
                f"{MOST_NUMBERS // width} at most, or build several"
            )
        return Simulator(
            self.design,
            self.initial,
            disturbance=self.disturbance,
            law=law,
            task=self.task,
            observe=observe,
            observers=realisation,
            num_envs=num_envs,
        )

    def _realisation(self) -> Observers:
        return Proximal(self.order) if self.network is None else Networked(self.network, self.estimator)

    def _per_agent(self, bounds: Bounds, name: str) -> PerformanceFunction | dict[int, Bound]:
        if not isinstance(bounds, Mapping):
            return bounds
        types = {model.type for model in self.models}
        for key in bounds:
            if key not in types:
                raise ValueError(f"scenario {self.name!r}: {name} is given for {key!r}; {did_you_mean(key, types)}")
        return {i: bounds[model.type] for i, model in enumerate(self.models) if model.type in bounds}


def number_of_steps(duration: float, dt: float) -> int:
    """Steps of `dt` seconds that an experiment takes, the last one shortened.

    Raises:
        ValueError: for a duration or step that isn't positive and finite, or steps too short or too many.
    """
    for name, value in (("duration", duration), ("dt", dt)):
        if not 0.0 < value < math.inf:
            raise ValueError(f"{name} must be positive and finite; got {value!r}")
        if not SHORTEST_TIME <= value <= LONGEST_TIME:
            raise ValueError(f"{name} must be from {SHORTEST_TIME:g} to {LONGEST_TIME:g} s; got {value!r}")
    if duration / dt > MOST_STEPS:
        raise ValueError(
            f"duration = {duration:g} s in steps of dt = {dt:g} s are {duration / dt:.3g} steps, and {MOST_STEPS:g} "
            f"are the most; take dt of {duration / MOST_STEPS:.2g} s or more, or a shorter duration"
        )
    return max(1, math.ceil(duration / dt - 1e-9))
