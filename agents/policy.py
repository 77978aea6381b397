"""The policy interface, and the description of an environment that a policy gets before its observations."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from khop_env.brief import brief
from khop_env.env import BatchedEnv, ObservationLayout
from khop_env.env.layout import Float32Array
from khop_env.network import Network
from khop_env.objects import described
from khop_env.observers import FloatArray, Networked
from khop_env.physics import AgentModel
from khop_env.simulation import Observe
from khop_env.tasks import Navigation

Observations = Mapping[str, Float32Array]
"""(..., D_i) by agent: a single observation, or a batch with one row per environment."""


@dataclass(frozen=True, eq=False)
class EnvDescription:
    """Static description of an environment: names, models and layouts, but no state.

    Attributes:
        environment: e.g. "consensus_v0".
        scenario: name of the scenario.
        observe: what the slots of k-hop targets hold: estimates, true states, or nothing.
        control_period: time between actions in s.
        models: model of each acting agent, by id, in the environment's order.
        layouts: layout of each agent's observation, by id.
        action_sizes: number of entries of each agent's action, padding included, by id.
        error_unit: unit of the task error.
        disturbance: bound on |w| of each acting agent by id, (n,) in state units per second.
        message_size: entries at the end of each agent's action that are sent with its messages.
        shielded: whether a safety filter corrects the actions.
        steps: Euler steps of the simulator in a control period; 0 if it integrates otherwise.
        apart: distance in m from which two acting agents start; None where that isn't known.
        radius: of agents' bodies in m, in navigation and where the scenario has an arena; else None.
        network: over which agents know of each other; None for exchange in continuous time.
        estimator: name of the one that makes estimates of its messages; None without a network.
    """

    environment: str
    scenario: str
    observe: Observe
    control_period: float
    models: Mapping[str, AgentModel]
    layouts: Mapping[str, ObservationLayout]
    action_sizes: Mapping[str, int]
    error_unit: str = "m"
    disturbance: Mapping[str, FloatArray] = field(default_factory=dict)
    message_size: int = 0
    shielded: bool = False
    steps: int = 1
    apart: float | None = None
    radius: float | None = None
    network: Network | None = None
    estimator: str | None = None

    __repr__ = brief

    @property
    def agents(self) -> tuple[str, ...]:
        """Ids of the acting agents."""
        return tuple(self.models)


class Policy(Protocol):
    """Maps observations to actions; it has access to nothing else."""

    def reset(self, env: EnvDescription, seeds: Sequence[int]) -> None:
        """Prepare for new episodes.

        Args:
            env: static description of the environment.
            seeds: one per environment of the batch, for policies that draw random numbers; they differ from the
                environments' own seeds (`policy_seeds`).

        Raises:
            ValueError: if the policy doesn't fit the environment; the message says why.
        """
        ...

    def act(self, observations: Observations) -> dict[str, Float32Array]:
        """Choose actions.

        Args:
            observations: (..., D_i) by agent.

        Returns:
            (..., m_i) in [-1, 1] by agent, padding included.
        """
        ...


def describe(env: object) -> EnvDescription:
    """The static description of an environment of any kind of this library, wrapped or not.

    That of an environment with a safety filter, e.g. a `ShieldedEnv`, is what the filter leaves of the one inside.

    Raises:
        TypeError: if `env` isn't an environment of khop_env.
    """
    if (inside := _inside_filter(env)) is not None:
        return inside
    batched = batched_of(env)
    fleet, sizes = batched.fleet, batched.action_offset[1:] - batched.action_offset[:-1]
    disturbance = batched.simulator.disturbance
    initial = batched.world.initial
    arena = None if initial is None else initial.arena
    if isinstance(batched.task, Navigation):  # which has one on every scenario
        arena = batched.task.arena
    observers = batched.simulator.observers
    pushed = np.zeros(fleet.n) if disturbance is None else disturbance.attach(fleet).bound
    return EnvDescription(
        environment=batched.task.environment,
        scenario=batched.scenario,
        observe=batched.settings.observe,
        control_period=batched.settings.control_period,
        models={agent: fleet.models[fleet.agent(agent)] for agent in batched.agents},
        layouts=dict(zip(batched.agents, batched.layouts, strict=True)),
        action_sizes=dict(zip(batched.agents, sizes.tolist(), strict=True)),
        error_unit=batched.task.error_unit(batched.world),
        disturbance={agent: pushed[fleet.state_slice(fleet.agent(agent))] for agent in batched.agents},
        message_size=batched.settings.message_size,
        steps=_euler_steps(batched),
        apart=_apart(batched),
        radius=None if arena is None else arena.radius,
        network=observers.network if isinstance(observers, Networked) else None,
        estimator=observers.estimator.name if isinstance(observers, Networked) else None,
    )


def _inside_filter(env: object) -> EnvDescription | None:
    """The description that a safety filter has left of an environment; None for one without a filter."""
    for _ in range(100):  # nested wrappers
        found = getattr(getattr(env, "filter", None), "inside", None)
        if isinstance(found, EnvDescription):
            return found
        env = next((layer for name in ("env", "venv") if (layer := getattr(env, name, None)) is not None), None)
    return None


def require_policy(policy: object, name: str | None = None) -> None:
    """Check that an object has the methods of a policy.

    Args:
        policy: the object.
        name: by which the caller knows it.

    Raises:
        TypeError: if it doesn't; the message says what a policy needs.
    """
    which = "the policy" if name is None else f"policy {name!r}"
    if isinstance(policy, type):
        raise TypeError(f"{which} is the class {policy.__name__}: pass an instance")
    if not all(callable(getattr(policy, method, None)) for method in ("reset", "act")):
        how = "a policy has reset(env, seeds) and act(observations); agents.make_policy makes one from a name"
        if callable(getattr(policy, "predict", None)):
            how = "agents.sb3_policy turns a Stable-Baselines3 model into a policy"
        raise TypeError(f"{which} is of type {type(policy).__name__}: {how}")


def require_description(env: object) -> None:
    """Refuse what isn't the description of an environment, which `reset` of a policy takes.

    Raises:
        TypeError: naming what it is, and what to do.
    """
    if not isinstance(env, EnvDescription):
        raise TypeError(
            f"policy.reset(env, seeds): expected an EnvDescription, describe(env); got {type(env).__name__}"
        )


def require_reset(policy: object, attribute: str) -> None:
    """Refuse to act before the reset.

    Args:
        policy: that is to act.
        attribute: that its reset sets.

    Raises:
        ValueError: if it isn't there.
    """
    if not hasattr(policy, attribute):
        raise ValueError(f"{type(policy).__name__} knows no environment yet: call reset(describe(env), seeds) first")


def _euler_steps(batched: BatchedEnv) -> int:
    settings, simulator = batched.settings, batched.simulator
    if settings.order != 1 and not simulator.observers.by_messages:
        return 0
    return settings.substeps * simulator.parts_of(settings.control_period / settings.substeps)


def _apart(batched: BatchedEnv) -> float | None:
    """By the boxes in which they start, or the scenario's arena if it asks for more."""
    initial = batched.world.initial
    if initial is None:
        return None
    places = batched.fleet.position_index[[batched.fleet.agent(agent) for agent in batched.agents]]
    center, half = initial.center[places], initial.radius[places]  # (N, d)
    gaps = np.maximum(np.abs(center[:, None] - center) - (half[:, None] + half), 0.0)
    first, second = np.triu_indices(len(places), 1)
    nearest = float(np.linalg.norm(gaps[first, second], axis=1).min(initial=math.inf))
    return nearest if initial.arena is None else max(nearest, initial.arena.apart)


def policy_seeds(seeds: Sequence[int]) -> list[int]:
    """Seeds for a policy's own random numbers, from which the episodes' seeds can't be inferred."""
    return [int(np.random.SeedSequence([int(seed), 1]).generate_state(1, np.uint64)[0]) for seed in seeds]


def in_words(error: Exception, spec: str = "") -> str:
    """An error on the way, with the name of the policy that was playing, unless the error's own text has it."""
    ours = isinstance(error, ValueError) or type(error).__module__.partition(".")[0] in ("khop_env", "agents")
    if not spec:
        return str(error) if ours else described(error)
    if not ours:
        return f"policy {spec!r} raised {described(error, spec.partition(':')[0])}"
    return str(error) if repr(spec) in str(error) else f"policy {spec!r}: {error}"


def batched_of(env: object) -> BatchedEnv:
    """The `BatchedEnv` inside an environment of any kind of this library; wrappers are bypassed.

    Raises:
        TypeError: if `env` isn't an environment of khop_env.
    """
    found = env
    for _ in range(100):  # nested wrappers
        if isinstance(found, BatchedEnv):
            return found
        inner = (getattr(found, name, None) for name in ("batched", "unwrapped", "venv", "env", "par_env"))
        found = next((layer for layer in inner if layer is not None and layer is not found), None)
        if found is None:
            break
    raise TypeError(
        f"expected an environment of khop_env, e.g. consensus_v0.parallel_env() or make_vec('consensus_v0', 32); got "
        f"{type(env).__name__}"
    )


def by_agent(batched: BatchedEnv, observations: Float32Array) -> dict[str, Float32Array]:
    """A `BatchedEnv`'s observations as (B, D_i) by agent."""
    if batched.settings.uniform:
        return {agent: observations[:, number] for number, agent in enumerate(batched.agents)}
    offset = batched.observation_offset.tolist()
    return {
        agent: observations[:, first:end]
        for agent, first, end in zip(batched.agents, offset[:-1], offset[1:], strict=True)
    }
