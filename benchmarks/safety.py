"""The safety filter: time of an agent's move, and collisions under it and without certified bounds."""

from __future__ import annotations

import copy
import time
from collections.abc import Sequence
from types import SimpleNamespace
from typing import cast

import networkx as nx
import numpy as np

from agents import SafetyFilter, describe, make_policy
from agents.policy import EnvDescription, Observations, Policy, by_agent
from benchmarks.environments import BATCH
from benchmarks.report import Report
from khop_env.env import BatchedEnv
from khop_env.env.layout import Float32Array
from khop_env.observers import Exponential, FloatArray, TargetObservers
from khop_env.physics import SingleIntegrator, Sinusoid, paper_tree
from khop_env.registry import make_batched
from khop_env.scenarios import Scenario

RADIUS = 0.2  # m, of a body
MARGINS = ("certified", "none")
POLICIES = ("tanh", "random", "bang_bang", "ramming")
NETWORKS = (
    "lossy:period=0.05,loss=0.3,burst=5",
    "lossy:period=0.05,loss=0,burst=1",
    "lossy:period=0.05,loss=0.5,burst=1",
    "lossy:period=0.05,loss=0.5,burst=20",
    "lossy:period=0.05,loss=0.1,latency=0.08,jitter=0.06",
)


class RammingPolicy:
    """Full inputs straight at the nearest other, as far as it is known: an adversary of the filter."""

    def reset(self, env: EnvDescription, seeds: Sequence[int]) -> None:
        """Look up the columns of others' positions."""
        self._columns = {
            agent: np.stack([layout.columns(f"slot{number}.position") for number in range(len(layout.slots))])
            for agent, layout in env.layouts.items()
        }

    def act(self, observations: Observations) -> dict[str, Float32Array]:
        """Actions of which one entry is -1 or 1."""
        actions = {}
        for agent, values in observations.items():
            ways = values[:, self._columns[agent]]
            nearest = np.argmin(np.square(ways).sum(axis=2), axis=1)
            way = np.take_along_axis(ways, nearest[:, None, None], axis=1)[:, 0]
            actions[agent] = way / np.maximum(np.abs(way).max(axis=1, keepdims=True), 1e-9)
        return actions


def meeting(agents: int = 8) -> Scenario:
    """Single integrators on a circle, which all want to be in the same place.

    Args:
        agents: number of agents; 8 on the paper's tree, others on a random tree.
    """
    angle = 2.0 * np.pi * np.arange(agents) / agents
    size = max(2.5, agents / 4.0)
    tree = paper_tree() if agents == 8 else nx.random_labeled_tree(agents, seed=0)
    return Scenario(
        name="meeting",
        description=f"{agents} single integrators on a circle",
        models=(SingleIntegrator(),) * agents,
        communication=tree,
        task=nx.complete_graph(agents),
        k=nx.diameter(tree),
        delta=Exponential(1.0, 0.117, 5.0),
        observers=(TargetObservers(input_observer=False),) * agents,
        disturbance=Sinusoid(0.1, frequency=(0.5, 2.0)),
        center=size * np.column_stack([np.cos(angle), np.sin(angle)]).ravel(),
        radius=0.1,
    ).sized()


def made(scenario: Scenario, batch: int, network: str, cycles: int = 200) -> BatchedEnv:
    """The environment in which agents meet."""
    return make_batched(
        "consensus_v0", scenario, num_envs=batch, network=network, estimator="relay", bounds=True, max_cycles=cycles
    )


def speed_rows(report: Report, quick: bool) -> None:
    """Microseconds per agent and move, apart and in a crowd, without the policy inside.

    Args:
        report: takes the rows.
        quick: as `benchmark`.
    """
    for batch, aim in ((1, "at most 20"), (64 if quick else BATCH, "at most 2")):
        env = made(meeting(), batch, "wifi")
        policy = SafetyFilter(make_policy("tanh"), radius=RADIUS)
        policy.reset(describe(env), range(batch))
        observations, _ = env.reset(0)
        for place, cycles in (("apart", 10), ("crowd", 100)):  # messages have to arrive first, then agents to meet
            for _ in range(cycles):
                actions = policy.act(by_agent(env, observations))
                observations, *_ = env.step(np.stack(list(actions.values()), axis=1))
            spent = _microseconds(policy, by_agent(env, observations), quick)
            report.add(f"filter_{place}_{'single' if batch == 1 else 'batch'}", spent, "us per agent", aim)


def collision_rows(report: Report, quick: bool) -> None:
    """Episodes in which two bodies touch, at any instant: agents meet, go anywhere at full speed, or ram each other.

    Args:
        report: takes the rows.
        quick: as `benchmark`.
    """
    for margin in MARGINS:
        sizes, networks = ((8,), NETWORKS[:1]) if quick else ((8, 16, 32), NETWORKS)
        batch, batches, cycles = (4, 1, 40) if quick else (100, 2 if margin == "certified" else 1, 200)
        found = [
            closest(env, name, margin, batch * number, cycles)
            for agents in sizes
            for network in networks
            for env in [made(meeting(agents), batch, network)]
            for name in POLICIES
            for number in range(batches)
        ]
        least = np.concatenate(found)
        aims = ("0", f"at least {2.0 * RADIUS:g}") if margin == "certified" else ("", "")
        collisions = int((least < 2.0 * RADIUS).sum())
        report.add(f"collisions_{margin}", collisions, f"of {least.size} episodes", aims[0])
        report.add(f"min_distance_{margin}", float(least.min()), "m", aims[1])


def closest(env: BatchedEnv, name: str, margin: str, seed: int, cycles: int) -> FloatArray:
    """(B,) smallest distance of two agents at any instant of an episode, exactly: they move on straight lines.

    Args:
        env: `made`, whose control period is the network's.
        name: of the policy inside the filter.
        margin: of the filter.
        seed: of the first episode.
        cycles: control periods.
    """
    policy = SafetyFilter(RammingPolicy() if name == "ramming" else make_policy(name), margin, radius=RADIUS)
    batch, agents = env.num_envs, len(env.agents)
    policy.reset(describe(env), range(seed, seed + batch))
    observations, _ = env.reset(seed)
    i, j = np.triu_indices(agents, 1)
    least = np.full(batch, np.inf)
    for _ in range(cycles):
        before = env.simulator.x.reshape(batch, agents, 2).copy()
        actions = policy.act(by_agent(env, observations))
        observations, *_ = env.step(np.stack(list(actions.values()), axis=1))
        start = before[:, i] - before[:, j]
        along = (
            env.simulator.x.reshape(batch, agents, 2)[:, i] - env.simulator.x.reshape(batch, agents, 2)[:, j] - start
        )
        length = np.maximum((along**2).sum(axis=2), 1e-300)
        share = np.clip(-(start * along).sum(axis=2) / length, 0.0, 1.0)
        least = np.minimum(least, np.linalg.norm(start + share[..., None] * along, axis=2).min(axis=1))
    return least


def _microseconds(policy: SafetyFilter, observations: Observations, quick: bool) -> float:
    """Per agent and move, the best of some, less the policy inside; anchors stay where they are."""
    kept = copy.deepcopy(policy)
    wanted = kept.policy.act(observations)
    kept.policy = cast(Policy, SimpleNamespace(act=lambda observations: wanted))
    agents = sum(values.shape[0] for values in observations.values())
    best = np.inf
    for _ in range(3 if quick else 50):
        repeated = copy.deepcopy(kept)
        begin = time.perf_counter()
        repeated.act(observations)
        best = min(best, time.perf_counter() - begin)
    return best / agents * 1e6
