"""Agents on a circle change places with the one on the other side."""

from __future__ import annotations

import math

import numpy as np

from khop_env.scenarios.scenario import Scenario
from khop_env.scenarios.teams import named, require_agents, team
from khop_env.simulation import Arena


def swap(
    agents: int = 8,
    speed: float = 1.0,
    radius: float = 0.2,
    model: str = "integrator",
    graph: str = "tree",
    disturbance: float = 0.1,
    loss: float = 0.3,
    burst: float = 5.0,
    continuous: bool = False,
    duration: float = 15.0,
    seed: int = 0,
) -> Scenario:
    """Agents on a circle go to the opposite side, all through the middle: no way is free.

    They start within 0.1 m of equal distances on a circle of 2.5 m, or of a radius of a quarter of a metre per agent if
    that is more, and their goals are their starting points mirrored at its centre. Agents are out of range of most
    others' radios, and estimate them from messages that are passed on. Hard: `swap:agents=16,duration=30`.

    Args:
        agents: N, even.
        speed: limit on an agent's speed along each axis, in m/s.
        radius: of an agent in m.
        model: "integrator", "drifter", "cart", "unicycle" or "vessel", for all agents.
        graph: of communication: "tree" (random, for 8 agents the paper's), "ring", or "regular3", where all have 3
            links.
        disturbance: amplitude of a sinusoid in m/s along each axis (on accelerations, in m/s^2, where there are some;
            of a unicycle on its heading only, in rad/s).
        loss: mean share of lost messages, of which every agent sends 20 a second.
        burst: mean number of messages lost in a row.
        continuous: exchange in continuous time instead, without messages: the paper's observers and their bounds.
        duration: of an episode in s.
        seed: of the graph.

    Raises:
        ValueError: for numbers out of range, or an unknown model or graph.
    """
    chosen = dict(locals())
    require_agents("swap", agents, even=True)
    scale = max(1.0, radius / 0.2)
    angle = 2.0 * math.pi * np.arange(agents) / agents
    center = scale * max(2.5, agents / 4.0) * np.column_stack([np.cos(angle), np.sin(angle)])
    half_width = np.full((agents, 2), 0.1 * scale)
    arena = Arena(radius, apart=2.5 * radius, goals="opposite")
    return team(
        named(swap, chosen),
        f"{agents} agents on a circle go to the opposite side: for navigation",
        center,
        half_width,
        arena,
        speed=speed,
        model=model,
        graph=graph,
        disturbance=disturbance,
        loss=loss,
        burst=burst,
        continuous=continuous,
        duration=duration,
        seed=seed,
    )
