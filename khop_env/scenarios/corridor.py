"""Two teams meet in a corridor with obstacles."""

from __future__ import annotations

import numpy as np

from khop_env.scenarios.scenario import Scenario
from khop_env.scenarios.teams import named, require_agents, team
from khop_env.simulation import Arena, Obstacle


def corridor(
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
    """Two halves of a team change sides through a corridor with two round obstacles.

    The corridor is 3 m long and 2.4 m wide, between two rooms. Positions at the start are at least 1 m apart; a goal is
    the starting point mirrored at the middle of the corridor, so that straight ways lead into walls, which don't stop
    an agent, but touching them is a collision. (All lengths are larger where agents are larger than by default.) Agents
    are out of range of most others' radios, and estimate them from messages that are passed on.

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
    require_agents("corridor", agents, even=True)
    scale = max(1.0, radius / 0.2)
    length, width, height = 1.5 * scale, 1.2 * scale, 2.4 * scale  # m: half of the corridor's, half of the rooms'
    room = 0.16 * agents * scale  # half the length of a room's part where agents start
    half_width = np.tile((room, height - 0.6 * scale), (agents, 1))
    side = np.where(np.arange(agents) % 2 == 0, -1.0, 1.0)
    center = np.column_stack([side * (length + 0.6 * scale + room), np.zeros(agents)])
    end = length + 1.2 * scale + 2.0 * room
    walls = [Obstacle((-length, y), (length, y)) for y in (-width, width)]
    walls += [Obstacle((x, s * width), (x, s * height)) for x in (-length, length) for s in (-1.0, 1.0)]
    walls += [Obstacle((s * end, -height), (s * end, height)) for s in (-1.0, 1.0)]
    walls += [Obstacle((s * length, y), (s * end, y)) for s in (-1.0, 1.0) for y in (-height, height)]
    discs = [
        Obstacle((x, y), radius=0.2 * scale) for x, y in ((-0.6 * scale, 0.3 * scale), (0.6 * scale, -0.3 * scale))
    ]
    arena = Arena(radius, apart=scale, goals="opposite", obstacles=(*walls, *discs))
    return team(
        named(corridor, chosen),
        f"{agents} agents change sides through a corridor with obstacles: for navigation",
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
