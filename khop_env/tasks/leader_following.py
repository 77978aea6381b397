"""Follow leaders that are out of communication range and move along smooth random routes."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import ClassVar

import numpy as np

from khop_env.compiled import compiled
from khop_env.observers import FloatArray, IntArray
from khop_env.physics import AgentModel, Fleet, did_you_mean, hop_distances, hops_from_targets, velocity_to_input
from khop_env.physics.velocity import VELOCITY_CONTROLLERS
from khop_env.tasks.base import Signature, World
from khop_env.tasks.edges import EdgeTask, require_positive, ring

SINES = 3  # per axis
BAND = (1.5, 2.5)  # rad/s: range of the routes' frequencies
POSITION_GAIN = 1.0  # 1/s: pulls a leader back to its route, so that drift and disturbance don't carry it away
_DIRECT = VELOCITY_CONTROLLERS["integrator"]  # the library's own: the input is the velocity


@dataclass(eq=False, kw_only=True)
class LeaderFollowing(EdgeTask):
    """Each follower keeps its place around a leader that isn't its neighbour, if there is one within k hops.

    Leaders take no part in the environment, and no other agent knows their routes. Along each axis the velocity of a
    leader's route is a sum of `SINES` sines with frequencies drawn from `BAND` and random phases; the commanded
    velocity is this plus `POSITION_GAIN` times the leader's distance to the route.

    Attributes:
        leaders: their ids, or their number; by default the fastest agents, at least two and as many as are needed for
            every follower to have a leader at 2 to k hops.
        follow: the leader of each follower by id; by default the nearest at 2 hops or more.
        leader_speed: root mean square speed in m/s; by default half of a leader's limit where its input is a velocity
            in m/s, and 0.5 m/s otherwise.
        spacing: radius of the ring around a leader on which its followers have their places, in m; 0 to meet it.

    Raises:
        ValueError: for unknown agents, no follower, or a leader more than k hops away from its follower.
    """

    default_scenario: ClassVar[str] = "convoy"
    driven_label: ClassVar[str] = "leader"
    leaders: int | Sequence[str | int] | None = None
    follow: Mapping[str, str] | None = None
    leader_speed: float | None = None
    spacing: float = 1.0

    def bind(self, world: World) -> None:
        """Choose leaders, assign followers, and make room for the routes."""
        graph, k, fleet = world.design.communication, world.design.k, world.fleet
        chosen = _choose_leaders(fleet, hop_distances(graph, k), self.leaders)
        if not chosen or len(chosen) == len(fleet):
            raise ValueError(
                f"leader following needs at least one leader and one follower; got {len(chosen)} leaders of "
                f"{len(fleet)} agents"
            )
        if self.leader_speed is not None:
            require_positive("leader_speed", self.leader_speed)
        if not 0.0 <= self.spacing < math.inf:
            raise ValueError(f"spacing must be finite and not negative; got {self.spacing!r}")
        self.leader_indices = tuple(chosen)
        self.speeds = tuple(
            float(_speed(fleet.models[i])) if self.leader_speed is None else float(self.leader_speed) for i in chosen
        )
        self._pairs = _assign_followers(fleet, hops_from_targets(graph, k), chosen, dict(self.follow or {}))
        super().bind(world)
        shape = len(chosen), fleet.position_dim
        self.memory = {
            "frequency": np.ones((world.num_envs, *shape, SINES)),  # rad/s
            "phase": np.ones((world.num_envs, *shape, SINES)),
            "start": np.zeros((world.num_envs, *shape)),  # m, where the routes begin
        }
        self._amplitude = np.array(self.speeds) * math.sqrt(2.0 / (SINES * shape[1]))
        self._positions = fleet.position_index[list(chosen)]
        self._velocity = np.zeros((world.num_envs, *shape))
        self._rows, self._limit = np.full(shape, -1), np.zeros(shape)
        for number, i in enumerate(chosen):
            if VELOCITY_CONTROLLERS.get(fleet.models[i].type) is _DIRECT:
                own = fleet.input_slice(i)
                self._rows[number], self._limit[number] = range(own.start, own.stop), fleet.input_limit[own]
        self._others = [(number, i) for number, i in enumerate(chosen) if self._rows[number, 0] < 0]

    def relations(self, world: World) -> tuple[IntArray, FloatArray]:
        """An edge from each follower to its leader, with its place on the ring around it."""
        displacement = np.zeros((len(self._pairs), world.fleet.position_dim))
        for leader in self.leader_indices:
            followers = [number for number, (_, other) in enumerate(self._pairs) if other == leader]
            displacement[followers] = -self.spacing * ring(len(followers), world.fleet.position_dim)
        return np.array(self._pairs, np.int64), displacement

    def acting(self, world: World) -> Sequence[int]:
        """The followers."""
        return [i for i in range(len(world.fleet)) if i not in self.leader_indices]

    def reset(self, world: World, env_ids: IntArray, rngs: Sequence[np.random.Generator]) -> None:
        """Draw the routes, which begin where the leaders are."""
        frequency, phase = self.memory["frequency"], self.memory["phase"]
        for env, rng in zip(env_ids.tolist(), rngs, strict=True):
            frequency[env] = rng.uniform(*BAND, frequency.shape[1:])
            phase[env] = rng.uniform(0.0, 2.0 * math.pi, phase.shape[1:])
            self.memory["start"][env] = world.x[self._positions, env]

    def drive(self, world: World, u: FloatArray) -> None:
        """The leaders' inputs along their routes."""
        fleet, states, inputs, velocity, memory = world.fleet, world.x.T, u.T, self._velocity, self.memory
        routes = memory["frequency"], memory["phase"], memory["start"], self._amplitude
        arrays = world.t, world.x, self._positions, *routes, self._rows, self._limit, velocity, u

        def write(low: int, high: int) -> None:
            drive_leaders(*arrays, low, high)
            for number, i in self._others:
                own, wanted = states[low:high, fleet.state_slice(i)], velocity[low:high, number]
                inputs[low:high, fleet.input_slice(i)] = velocity_to_input(fleet.models[i], own, wanted)

        world.each(write, velocity[0].size * 20 * (1 + SINES))

    def signature(self, world: World) -> Signature:
        """Leaders with their speeds, edges and displacements."""
        ids = world.fleet.ids
        leaders = [f"{ids[i]} at {speed} m/s" for i, speed in zip(self.leader_indices, self.speeds, strict=True)]
        found = super().signature(world)
        return {"tasks": found.pop("tasks"), "leaders": tuple(leaders), **found}


@compiled
def drive_leaders(
    t: FloatArray,
    x: FloatArray,
    positions: IntArray,
    frequency: FloatArray,
    phase: FloatArray,
    start: FloatArray,
    amplitude: FloatArray,
    row: IntArray,
    limit: FloatArray,
    velocity: FloatArray,
    u: FloatArray,
    low: int,
    high: int,
) -> None:
    """Velocities along the routes, and back to them, of L leaders with d axes.

    Args:
        t: (B,) time since reset in s.
        x: (n, B) states.
        positions: (L, d) rows of the leaders' positions in the states.
        frequency: (B, L, d, sines) in rad/s.
        phase: (B, L, d, sines).
        start: (B, L, d) in m, where the routes begin.
        amplitude: (L,) of each sine in m/s.
        row: (L, d) of the inputs that are these velocities; -1 where the inputs are something else.
        limit: (L, d) of these inputs.
        velocity: (B, L, d) overwritten, in m/s.
        u: (m, B) overwritten in these rows with the velocities within the limits.
        low: first environment.
        high: one past the last.
    """
    for env in range(low, high):
        for leader in range(velocity.shape[1]):
            for axis in range(velocity.shape[2]):
                speed, moved = 0.0, 0.0
                for sine in range(SINES):
                    rate, first = frequency[env, leader, axis, sine], phase[env, leader, axis, sine]
                    angle = rate * t[env] + first
                    speed += amplitude[leader] * math.sin(angle)
                    moved += amplitude[leader] * (math.cos(first) - math.cos(angle)) / rate
                place = start[env, leader, axis] + moved - x[positions[leader, axis], env]
                wanted = speed + POSITION_GAIN * place
                velocity[env, leader, axis] = wanted
                if row[leader, axis] >= 0:
                    u[row[leader, axis], env] = min(max(wanted, -limit[leader, axis]), limit[leader, axis])


def _speed(model: AgentModel) -> float:
    """Default speed of a leader of this model, in m/s rms: half of its smallest velocity limit, or 0.5."""
    limits = [limit for limit, unit in zip(model.input_limit, model.inputs.values(), strict=True) if unit == "m/s"]
    return 0.5 * min(limits) if limits and math.isfinite(min(limits)) else 0.5


def _choose_leaders(
    fleet: Fleet, hops: Sequence[Mapping[int, int]], leaders: int | Sequence[str | int] | None
) -> list[int]:
    if leaders is not None and not isinstance(leaders, int | np.integer):
        if isinstance(leaders, str):
            leaders = [leaders]
        return sorted({fleet.agent(leader) for leader in leaders})
    most = len(fleet) - 1
    if leaders is not None and not 1 <= leaders <= most:
        raise ValueError(f"leaders must be 1 to {most} of {len(fleet)} agents, or a list of ids; got {leaders!r}")
    far = [{j for j, distance in reached.items() if distance >= 2} for reached in hops]
    waiting = set(range(len(fleet)))
    chosen: list[int] = []
    rest = list(range(len(fleet)))
    while len(chosen) < (most if leaders is None else leaders):
        if leaders is None and len(chosen) >= min(2, most) and not any(waiting & far[i] for i in rest):
            break
        # the fastest first, and of these the agent at 2 to k hops from most followers without a leader
        best = max(rest, key=lambda i: (_speed(fleet.models[i]), len(waiting & far[i]), -i))
        chosen.append(best)
        rest.remove(best)
        waiting -= {best} | far[best]
    return sorted(chosen)


def _assign_followers(
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
        else:  # not a neighbour if possible, then the nearest, then the leader with fewer followers
            j = min(known, key=lambda j: (known[j] < 2, known[j], load[j], j))
        load[j] += 1
        pairs.append((i, j))
    return pairs
