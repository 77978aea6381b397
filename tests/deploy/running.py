"""Agents of a whole fleet as objects in this process, over real sockets, for tests and nothing else."""

from __future__ import annotations

import importlib.util
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import networkx as nx
import numpy as np
import pytest

from agents import make_law
from khop_env.commands.deploying import setups_of, simulated_part
from khop_env.deploy.agent import Agent
from khop_env.deploy.collect import Collected, collect
from khop_env.deploy.setup import Setup, control_of
from khop_env.deploy.transport import UdpTransport
from khop_env.network import Network
from khop_env.observers import Exponential, Networked
from khop_env.physics import (
    BandLimitedNoise,
    DoubleIntegrator,
    DriftingIntegrator,
    Gust,
    SingleIntegrator,
    Sinusoid,
    Unicycle,
)
from khop_env.scenarios import LawChoice, Scenario
from khop_env.simulation import Simulator

NO_ZENOH = pytest.mark.skipif(importlib.util.find_spec("zenoh") is None, reason="eclipse-zenoh isn't installed")

LAW = LawChoice("linear", {"gain": 1.5})


def scenario_of(seed: int) -> Scenario:
    """Four to six agents of several kinds on a random graph, links in one direction included, all disturbed."""
    rng = np.random.default_rng(seed)
    count, k = int(rng.integers(4, 7)), int(rng.integers(2, 4))
    graph = nx.cycle_graph(count, create_using=nx.DiGraph)
    for a, b in [(a, (a + 1) % count) for a in range(count)]:
        graph.add_edge(b, a)
    for _ in range(2):
        graph.add_edge(*rng.choice(count, 2, replace=False).tolist())
    makers = (
        lambda: SingleIntegrator(2, 3.0),
        lambda: DriftingIntegrator(3.0),
        lambda: DoubleIntegrator(input_limit=4.0),
        Unicycle,
    )
    return Scenario(
        name=f"random_{seed}",
        description="a random fleet",
        models=tuple(makers[int(kind)]() for kind in rng.integers(len(makers), size=count)),
        communication=graph,
        task=nx.cycle_graph(count),
        k=k,
        delta=Exponential(100.0, 1.0, 1.0),
        theta=Exponential(200.0, 4.0, 1.0),
        disturbance=Sinusoid(0.2) + BandLimitedNoise(0.1, components=3) + Gust(0.2),
        radius=1.0,
        law=LAW,
    )


def simulator_of(chosen: Scenario, network: Network, estimator: str, seed: int) -> Simulator:
    """The simulator that agents are compared with."""
    simulator = chosen.build(law=make_law(chosen.law), observers=Networked(network, estimator))
    return simulator.reset(seed)


class Team:
    """All agents of a scenario.

    Args:
        chosen: the scenario.
        simulator: of it, just reset: where initial states and keys are from.
        folder: of the records.
        steps: per round.
        rounds: of the run.
        skew: of the clocks, in s.
        policies: as for `setups_of`.
    """

    def __init__(
        self,
        chosen: Scenario,
        simulator: Simulator,
        folder: Path,
        *,
        steps: int = 1,
        rounds: int = 40,
        skew: float = 0.0,
        policies: list[dict[str, Any]] | None = None,
    ) -> None:
        self.chosen, self.simulator, self.folder, self.steps = chosen, simulator, folder, steps
        episode = SimpleNamespace(simulator=simulator, observers=simulator.observers)
        common = simulated_part(chosen.name, chosen, episode, chosen.law, steps, rounds)  # type: ignore[arg-type]
        self.setups = setups_of(chosen, common, seed=0, skew=skew, transport="udp", records=folder, policies=policies)
        self.agents: list[Agent | None] = [self._made(setup) for setup in self.setups]
        self.ports = {a: agent.transport.port for a, agent in enumerate(self.agents)}
        for agent in self.agents:
            agent.transport.meet(self.ports)
        self._fresh = set(range(len(self.agents)))
        self.frozen: set[int] = set()
        self.killed: list[list[float]] = [[] for _ in self.setups]
        self.step = -1

    def __enter__(self) -> Team:
        return self

    def __exit__(self, *_: object) -> None:
        for agent in filter(None, self.agents):
            agent.writer.close()
            agent.transport.close()

    def _made(self, setup: Setup) -> Agent:
        return Agent(setup, self.chosen, control_of(setup, self.chosen), UdpTransport(setup.port))

    def kill(self, a: int) -> None:
        """As SIGKILL does."""
        agent = self.agents[a]
        agent.writer.close()
        agent.transport.close()
        self.agents[a] = None
        self.killed[a].append((self.step + 1) * agent.robot.h)
        self._last = agent.robot.step, agent.robot.x.tolist(), agent.setup

    def restart(self, a: int) -> None:
        """A new process, as the supervisor starts it."""
        step, x, old = self._last
        setup = replace(old, first_step=step, x=x, start=old.start + 1, port=self.ports[a])
        self.agents[a] = self._made(setup)
        self.agents[a].transport.meet(self.ports)
        self._fresh.add(a)

    def advance(self, in_step: bool = False) -> None:
        """One step of all agents that are neither killed nor frozen; a restarted or thawed one catches up."""
        self.step += 1
        due = self.step % self.steps == 0
        at_work = [
            (a, agent)
            for a, agent in enumerate(self.agents)
            if agent is not None and a not in self.frozen and (due or a not in self._fresh)
        ]
        for a, agent in at_work:
            agent.catch_up(self.step - (a not in self._fresh))
            agent.begin(in_step, first=a in self._fresh)
        for a, agent in at_work:
            agent.end(in_step)
            agent.write()
            self._fresh.discard(a)

    def collected(self) -> Collected:
        """All that is on record."""
        setup = self.setups[0]
        return collect(
            self.chosen,
            self.folder,
            self.simulator.observers.network.drawn(setup.network_key),
            setup.estimator,
            steps=self.steps,
            last_step=self.step,
            x0=np.concatenate([each.x for each in self.setups]),
            drawn=np.array(setup.drawn),
            exact=setup.skew > 0.0,
            killed=self.killed,
            wall_time=0.0,
            error=None,
        )
