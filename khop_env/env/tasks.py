"""What the agents are to do: directed task edges, the displacement to keep along each, and who leads."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass

import networkx as nx
import numpy as np
from numpy.typing import ArrayLike

from khop_env.observers import FloatArray, IntArray
from khop_env.physics import AgentModel, Fleet, did_you_mean, hop_distances

MOST_ON_A_RING = 12  # agents; more of them stand in a square grid


@dataclass(frozen=True, eq=False)
class Task:
    """Agent i wants p_j - p_i = d_ij for each of its edges (i, j).

    Attributes:
        name: what the task is called.
        edges: (E, 2) directed edges (i, j), sorted.
        displacement: (E, d) d_ij in m.
        leaders: agents that take no part in the environment: they are driven along routes that nobody is told.
        leader_speed: (leaders,) root mean square speed of each in m/s.
    """

    name: str
    edges: IntArray
    displacement: FloatArray
    leaders: tuple[int, ...] = ()
    leader_speed: tuple[float, ...] = ()


def consensus(fleet: Fleet, graph: nx.Graph) -> Task:
    """Meet: p_j = p_i along the edges of the task graph."""
    edges = _both_ways(graph)
    return Task("consensus", edges, np.zeros((len(edges), fleet.position_dim)))


def formation(fleet: Fleet, graph: nx.Graph, points: ArrayLike | None = None, spacing: float = 1.0) -> Task:
    """Keep d_ij = r_j - r_i along the edges of the task graph, wherever the formation stands.

    Args:
        fleet: the agents.
        graph: the task graph.
        points: (N, d) the points r_i in m; by default a ring, or a square grid of many agents.
        spacing: distance of neighbouring default points in m.

    Raises:
        ValueError: for points of a wrong shape or not finite, or a spacing that isn't positive.
    """
    shape = (len(fleet), fleet.position_dim)
    if points is None:
        _require_positive("spacing", spacing)
        placed = _ring_or_grid(*shape) * spacing
    else:
        placed = np.asarray(points, dtype=float)
        if placed.shape != shape or not np.isfinite(placed).all():
            raise ValueError(
                f"points must be finite, of shape (agents, position axes) = {shape}, in m; got {placed.shape}"
            )
    edges = _both_ways(graph)
    return Task("formation", edges, placed[edges[:, 1]] - placed[edges[:, 0]])


def leader_following(
    fleet: Fleet,
    communication: nx.Graph,
    k: int,
    *,
    leaders: int | Sequence[str | int] | None = None,
    follow: Mapping[str, str] | None = None,
    leader_speed: float | None = None,
    spacing: float = 1.0,
) -> Task:
    """Each follower keeps its place around a leader that it can't hear, if there is one within k hops.

    Args:
        fleet: the agents.
        communication: who hears whom.
        k: agents up to k hops away are estimated.
        leaders: their ids, or how many; by default as many of the fastest as it takes for every follower to have one
            out of its earshot, and at least two.
        follow: the leader of each follower by id; by default the nearest out of earshot.
        leader_speed: root mean square speed in m/s; by default half of a leader's limit where its input is a velocity
            in m/s, and 0.5 m/s otherwise.
        spacing: radius of the ring around a leader on which its followers have their places, in m; 0 to meet it.

    Raises:
        ValueError: for unknown agents, no follower, or a leader that its follower neither hears nor observes.
    """
    hops = hop_distances(communication, k)
    chosen = _choose_leaders(fleet, hops, leaders)
    if not chosen or len(chosen) == len(fleet):
        raise ValueError(
            f"leader following needs at least one leader and one follower; got {len(chosen)} leaders of {len(fleet)} "
            "agents"
        )
    if leader_speed is not None:
        _require_positive("leader_speed", leader_speed)
    if not 0.0 <= spacing < math.inf:
        raise ValueError(f"spacing must be finite and not negative; got {spacing!r}")
    pairs = _who_follows_whom(fleet, hops, chosen, dict(follow or {}))
    displacement = np.zeros((len(pairs), fleet.position_dim))
    for leader in chosen:
        mine = [number for number, (_, other) in enumerate(pairs) if other == leader]
        displacement[mine] = -spacing * _ring(len(mine), fleet.position_dim)
    speeds = [float(_speed(fleet.models[i])) if leader_speed is None else float(leader_speed) for i in chosen]
    return Task("leader_following", np.array(pairs, np.int64), displacement, tuple(chosen), tuple(speeds))


def _both_ways(graph: nx.Graph) -> IntArray:
    return np.array(sorted([*graph.edges, *((j, i) for i, j in graph.edges)]), np.int64).reshape(-1, 2)


def _require_positive(name: str, value: float) -> None:
    if not 0.0 < value < math.inf:
        raise ValueError(f"{name} must be positive and finite; got {value!r}")


def _ring(count: int, dim: int) -> FloatArray:
    """`count` points on a circle of radius 1 in the first two axes; on a line alternately left and right."""
    points = np.zeros((count, dim))
    if dim == 1:
        points[:, 0] = [(1 + q // 2) * (-1) ** q for q in range(count)]
    else:
        angle = 2.0 * math.pi * np.arange(count) / max(count, 1)
        points[:, 0], points[:, 1] = np.cos(angle), np.sin(angle)
    return points


def _ring_or_grid(count: int, dim: int) -> FloatArray:
    """Points whose nearest neighbours are 1 apart: a line, a ring, or a square grid."""
    points = np.zeros((count, dim))
    if dim == 1:
        points[:, 0] = np.arange(count)
    elif 1 < count <= MOST_ON_A_RING:
        points = _ring(count, dim) / (2.0 * math.sin(math.pi / count))
    else:
        side = math.ceil(math.sqrt(count))
        points[:, 0], points[:, 1] = np.arange(count) % side, np.arange(count) // side
    return points


def _speed(model: AgentModel) -> float:
    """What a leader of this model can follow smoothly, in m/s rms."""
    limits = [limit for limit, unit in zip(model.input_limit, model.inputs.values(), strict=True) if unit == "m/s"]
    return 0.5 * min(limits) if limits and math.isfinite(min(limits)) else 0.5


def _choose_leaders(
    fleet: Fleet, hops: Sequence[Mapping[int, int]], leaders: int | Sequence[str | int] | None
) -> list[int]:
    if leaders is not None and not isinstance(leaders, int | np.integer):
        if isinstance(leaders, str):
            leaders = [leaders]
        return sorted({fleet.agent(one) for one in leaders})
    most = len(fleet) - 1
    if leaders is not None and not 1 <= leaders <= most:
        raise ValueError(f"leaders must be 1 to {most} of {len(fleet)} agents, or a list of ids; got {leaders!r}")
    out_of_earshot = [{j for j, distance in reached.items() if distance >= 2} for reached in hops]
    waiting = set(range(len(fleet)))
    chosen: list[int] = []
    rest = list(range(len(fleet)))
    while len(chosen) < (most if leaders is None else leaders):
        if leaders is None and len(chosen) >= min(2, most) and not any(waiting & out_of_earshot[i] for i in rest):
            break
        # the fastest first, and of these the one that most followers still wait for
        best = max(rest, key=lambda i: (_speed(fleet.models[i]), len(waiting & out_of_earshot[i]), -i))
        chosen.append(best)
        rest.remove(best)
        waiting -= {best} | out_of_earshot[best]
    return sorted(chosen)


def _who_follows_whom(
    fleet: Fleet, hops: Sequence[Mapping[int, int]], leaders: Sequence[int], follow: dict[str, str]
) -> list[tuple[int, int]]:
    names = [fleet.ids[i] for i in leaders]
    followers = [name for i, name in enumerate(fleet.ids) if i not in leaders]
    for follower, leader in follow.items():
        if follower not in followers:
            raise ValueError(f"follow: {follower!r} isn't a follower; {did_you_mean(follower, followers)}")
        if leader not in names:
            raise ValueError(f"follow: {leader!r} isn't a leader; {did_you_mean(leader, names)}")
    load = dict.fromkeys(leaders, 0)
    pairs = []
    for name in followers:
        i = fleet.agent(name)
        known = {j: hops[i][j] for j in leaders if j in hops[i]}
        if name in follow:
            j = fleet.agent(follow[name])
            if j not in known:
                raise ValueError(f"follow: {name!r} knows nothing of {follow[name]!r}, which is more than k hops away")
        elif not known:
            raise ValueError(
                f"no leader within k hops of {name!r}; name more leaders (now {', '.join(names)}) or take a larger k"
            )
        else:  # out of earshot if there is one, then the nearest, then the one with fewer followers
            j = min(known, key=lambda j: (known[j] < 2, known[j], load[j], j))
        load[j] += 1
        pairs.append((i, j))
    return pairs
