"""What a policy is, and what it is told of the environment beside its observations."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from khop_env.env import BatchedEnv, ObservationLayout
from khop_env.env.layout import Float32Array
from khop_env.physics import AgentModel
from khop_env.simulation import Observe

Observations = Mapping[str, Float32Array]
"""Per agent (..., D_i): one observation, or one per environment of a batch."""


@dataclass(frozen=True, eq=False)
class EnvDescription:
    """The environment as its designer knows it beforehand: names, models, layouts, and no state.

    Attributes:
        environment: e.g. "consensus_v0".
        scenario: name of the scenario.
        observe: what the slots of agents beyond the neighbours hold.
        control_period: time between actions in s.
        models: the model of each agent that acts, by id, in the environment's order.
        layouts: what each agent's observation holds.
        action_sizes: entries of each agent's action, padding included.
        error_unit: unit of the task error.
    """

    environment: str
    scenario: str
    observe: Observe
    control_period: float
    models: Mapping[str, AgentModel]
    layouts: Mapping[str, ObservationLayout]
    action_sizes: Mapping[str, int]
    error_unit: str = "m"

    @property
    def agents(self) -> tuple[str, ...]:
        """Ids of the agents that act."""
        return tuple(self.models)


class Policy(Protocol):
    """A decision maker: all it sees are observations."""

    def reset(self, env: EnvDescription, seeds: Sequence[int]) -> None:
        """Get ready for new episodes.

        Args:
            env: what is known beforehand.
            seeds: one per environment of the batch, for policies that draw random numbers; not the environments' own
                (`policy_seeds`).

        Raises:
            ValueError: for an environment that the policy can't act in, saying what doesn't fit.
        """
        ...

    def act(self, observations: Observations) -> dict[str, Float32Array]:
        """Actions.

        Args:
            observations: (..., D_i) by agent.

        Returns:
            (..., m_i) in [-1, 1] by agent, padding included.
        """
        ...


def describe(env: object) -> EnvDescription:
    """What a policy is told of an environment, of any kind that `batched_of` knows."""
    batched = batched_of(env)
    fleet, sizes = batched.fleet, batched.action_offset[1:] - batched.action_offset[:-1]
    return EnvDescription(
        environment=batched.task.environment,
        scenario=batched.scenario,
        observe=batched.settings.observe,
        control_period=batched.settings.control_period,
        models={agent: fleet.models[fleet.agent(agent)] for agent in batched.agents},
        layouts=dict(zip(batched.agents, batched.layouts, strict=True)),
        action_sizes=dict(zip(batched.agents, sizes.tolist(), strict=True)),
        error_unit=batched.task.error_unit(batched.world),
    )


def policy_seeds(seeds: Sequence[int]) -> list[int]:
    """Seeds for a policy's own random numbers in episodes with these seeds, from which it can't tell them."""
    return [int(np.random.SeedSequence([int(seed), 1]).generate_state(1, np.uint64)[0]) for seed in seeds]


def batched_of(env: object) -> BatchedEnv:
    """The arrays behind an environment of any kind, wrapped or not; wrappers have no part in what is done with them.

    Raises:
        TypeError: for something else.
    """
    found = env
    for _ in range(100):  # wrappers around each other
        if isinstance(found, BatchedEnv):
            return found
        inner = (getattr(found, name, None) for name in ("batched", "unwrapped", "venv", "env", "par_env"))
        found = next((one for one in inner if one is not None and one is not found), None)
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
