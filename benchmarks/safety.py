"""Count collisions under the safety filter: swap and crossing, over networks and changing graphs, with adversaries.

python -m benchmarks.safety --episodes 10000         # a quarter of an hour on a core
"""

from __future__ import annotations

import argparse
import json
import math
import sys
from collections.abc import Callable, Iterator, Mapping, Sequence
from dataclasses import replace
from types import MappingProxyType
from typing import Any, NamedTuple

import numpy as np

from agents import make_policy, play, shielded
from agents.navigation import GoToGoal
from agents.policies import needs
from agents.policy import EnvDescription, Policy
from benchmarks.report import Report
from khop_env.env import BatchedEnv
from khop_env.network import Network, Outage, RandomLinks, Range, Schedule
from khop_env.observers import FloatArray
from khop_env.registry import make_batched, scenario
from khop_env.results.recording import Progress as Fraction
from khop_env.scenarios.teams import TEAM_MODELS
from khop_env.terminal import Progress, print_table, print_text, say

FAMILIES = ("swap", "crossing")
DURATIONS: Mapping[int, float] = MappingProxyType({8: 15.0, 16: 30.0, 32: 30.0})
"""Numbers of agents, and the length of their episodes in s."""
SHARE = 5  # of as many episodes one is played on point estimates, too
_LEAST = 20  # episodes that make it worth it to build an environment
_BATCH = 128


class Condition(NamedTuple):
    """How messages get through; a changing graph has three links per agent at most, otherwise it is a tree."""

    network: Network
    schedule: Schedule | None = None


CONDITIONS: Mapping[str, Condition] = MappingProxyType(
    {
        "nothing lost": Condition(Network()),
        "30 % lost": Condition(Network(loss=0.3)),
        "30 % lost in bursts of 5": Condition(Network(loss=0.3, burst=5.0)),
        "30 % lost in bursts of 20": Condition(Network(loss=0.3, burst=20.0)),
        "50 % lost in bursts of 1": Condition(Network(loss=0.5, burst=1.0)),
        "50 % lost in bursts of 5": Condition(Network(loss=0.5, burst=5.0)),
        "50 % lost in bursts of 20": Condition(Network(loss=0.5, burst=20.0)),
        "20 to 140 ms late, 10 % lost": Condition(Network(loss=0.1, latency=0.08, jitter=0.06)),
        "a random graph per episode": Condition(Network(loss=0.1), RandomLinks((0.5, 1.0))),
        "links up to 3 m": Condition(Network(loss=0.1), Range(3.0)),
        "outages of an agent": Condition(
            Network(loss=0.1), Outage(start=(0.0, 3.0), duration=(1.0, 4.0)) & Outage(start=(3.0, 6.0), duration=2.0)
        ),
    }
)


class RammingPolicy(GoToGoal):
    """At full speed straight at the nearest other, as far as it is known: an adversary of the filter."""

    def reset(self, env: EnvDescription, seeds: Sequence[int]) -> None:
        """Look up the columns of others' positions."""
        super().reset(env, seeds)
        self._ways, self._known = {}, {}
        for agent, layout in env.layouts.items():
            slots = range(len(layout.slots))
            self._ways[agent] = np.stack([layout.columns(f"slot{number}.position") for number in slots])
            self._known[agent] = np.array([layout.index(f"slot{number}.valid") for number in slots])

    def way(self, agent: str, position: FloatArray, seen: FloatArray) -> FloatArray:
        """Far beyond the nearest other."""
        ways = seen[:, self._ways[agent]]
        far = np.where(seen[:, self._known[agent]] > 0.5, np.square(ways).sum(axis=2), np.inf)
        nearest: FloatArray = np.take_along_axis(ways, np.argmin(far, axis=1)[:, None, None], axis=1)[:, 0]
        return 100.0 * nearest


POLICIES: Mapping[str, Callable[[], Policy]] = MappingProxyType(
    {name: lambda name=name: make_policy(name) for name in ("keep_right", "random", "bang_bang")}
    | {"ramming": RammingPolicy}
)


FILTERS: Mapping[str, Mapping[str, Any]] = MappingProxyType(
    {"filter": {}, "filter:announce=true": {"announce": True}, "filter:margin=none": {"margin": "none"}}
)
CERTIFIED = tuple(FILTERS)[:2]
TOTALS = {"certified": "certified bounds", "estimated": "point estimates, on some of the same episodes"}


class Count(NamedTuple):
    """Episodes of one policy in one filter, under one condition.

    Attributes:
        scenario: its family.
        agents: their number.
        condition: one of `CONDITIONS`.
        policy: inside the filter.
        filter: one of `FILTERS`.
        episodes: played.
        collisions: of how many of them bodies touched, at any instant, between samples too.
        min_distance: smallest distance of two agents' centres in m.
        infeasible: in how many of them an agent's guarantee had to be begun anew.
    """

    scenario: str
    agents: int
    condition: str
    policy: str
    filter: str
    episodes: int
    collisions: int
    min_distance: float
    infeasible: int


def collisions(
    episodes: int,
    seed: int = 0,
    *,
    model: str = "integrator",
    durations: Mapping[int, float] = DURATIONS,
    progress: Fraction | None = None,
) -> Iterator[Count]:
    """Play episodes with certified bounds, half of them with announced anchors, and some of them on point estimates.

    They are spread evenly over families, numbers of agents, conditions and policies, in random order, so that results
    until an interrupt cover all; few episodes are spread over some of them.

    Args:
        episodes: with certified bounds.
        seed: of the order, and of the first episode of each combination.
        model: of all agents, as the scenarios name it; only integrators and drifters announce anchors.
        durations: numbers of agents, and the length of their episodes in s.
        progress: called with the completed fraction.
    """
    kinds = [(family, agents, name) for family in FAMILIES for agents in durations for name in CONDITIONS]
    order = np.random.default_rng(seed).permutation(len(kinds))[: max(1, episodes // (_LEAST * len(POLICIES)))]
    cells = [(*kinds[number], policy) for number in order for policy in POLICIES]
    counts = [episodes // len(cells) + (number < episodes % len(cells)) for number in range(len(cells))]
    work = np.cumsum([count * durations[cell[1]] * cell[1] for count, cell in zip(counts, cells, strict=True)])
    made: dict[str, BatchedEnv] = {}
    before = None
    for (family, agents, condition, name), count, done in zip(cells, counts, work, strict=True):
        if (family, agents, condition) != before:
            made, before = {}, (family, agents, condition)
        announced = count // 2 if model in ("integrator", "drifter") else 0
        parts = count - announced, announced, -(-count // SHARE)
        for (kind, options), part in zip(FILTERS.items(), parts, strict=True):
            if not part:
                continue
            policy, batch = shielded(POLICIES[name](), **options), min(part, _BATCH)
            if kind not in made or made[kind].num_envs < batch:
                made[kind] = environment(_scenario(family, agents, model), condition, durations[agents], batch, policy)
            found = play(made[kind], policy, range(seed, seed + part)).outcomes
            yield Count(
                family,
                agents,
                condition,
                name,
                kind,
                part,
                int(found["collision"].sum()),
                float(found["min_distance"].min()),
                int((found["infeasible"] > 0.0).sum()),
            )
        if progress is not None:
            progress(float(done / work[-1]))


def environment(name: str, condition: str, duration: float, num_envs: int, policy: Policy) -> BatchedEnv:
    """The environment of a combination, with what the policy needs."""
    network, schedule = CONDITIONS[condition]
    graph = "tree" if schedule is None else "regular3"
    chosen = scenario(f"{name},graph={graph},duration={duration:g}")
    arguments = needs(policy).among({"num_envs": num_envs, "network": network})
    return make_batched("navigation_v0", replace(chosen, schedule=schedule), **arguments)


def upper_limit(collided: int, episodes: int) -> float:
    """The rate that is exceeded with a confidence of 5 % (C. Clopper and E. Pearson, Biometrika 26, 1934).

    Args:
        collided: episodes with a collision.
        episodes: of how many.
    """
    if collided == episodes:
        return 1.0
    low, high = collided / episodes, 1.0
    while high - low > 1e-13:  # so few collisions are as improbable as that at a larger rate
        rate = (low + high) / 2.0
        terms = (
            math.lgamma(episodes + 1) - math.lgamma(k + 1) - math.lgamma(episodes - k + 1)
            + k * math.log(rate) + (episodes - k) * math.log1p(-rate)
            for k in range(collided + 1)
        )  # fmt: skip
        low, high = (rate, high) if sum(map(math.exp, terms)) > 0.05 else (low, rate)
    return high


def summary(counts: Sequence[Count]) -> dict[str, int | float]:
    """Sums over some counts, at least one."""
    episodes, collided = (sum(getattr(each, name) for each in counts) for name in ("episodes", "collisions"))
    return {
        "episodes": episodes,
        "collisions": collided,
        "upper_limit_95": upper_limit(collided, episodes),
        "min_distance": min(each.min_distance for each in counts),
        "infeasible": sum(each.infeasible for each in counts),
    }


def totals(counts: Sequence[Count]) -> dict[str, dict[str, int | float]]:
    """Sums over all episodes with certified bounds, and over those on point estimates, if there are any."""
    parts = {name: [each for each in counts if (each.filter in CERTIFIED) == (name == "certified")] for name in TOTALS}
    return {name: summary(some) for name, some in parts.items() if some}


def collision_rows(report: Report, quick: bool) -> None:
    """Collisions of a thousand episodes, and of the fifth of them that is played on point estimates, too.

    Args:
        report: takes the rows.
        quick: as `benchmark`.
    """
    counts = list(collisions(20, durations={8: 3.0})) if quick else list(collisions(1000))
    for name, found in totals(counts).items():
        certified = name == "certified"
        report.add(
            f"collisions_{name}",
            found["collisions"],
            f"of {found['episodes']} episodes",
            most=0.0 if certified else None,
        )
        report.add(f"min_distance_{name}", found["min_distance"], "m", least=0.4 if certified else None)


def print_counts(counts: Sequence[Count]) -> None:
    """A table by filter, condition, scenario and policy, and the totals."""
    groups: Sequence[tuple[Sequence[str], Callable[[Count], str]]] = (
        (CERTIFIED, lambda each: each.filter),
        (list(CONDITIONS), lambda each: each.condition),
        ([_scenario(family, agents) for family in FAMILIES for agents in DURATIONS], _scenario_of),
        (list(POLICIES), lambda each: each.policy),
    )
    rows: list[tuple[str, ...]] = []
    for names, key in groups:
        rows += [("",) * 6] * bool(rows)
        for name in names:
            if chosen := [each for each in counts if key(each) == name]:
                rows.append((name, *_cells(totals(chosen))))
    header = ("with certified bounds", "episodes", "collided", "distance", "infeasible", "on point estimates")
    print_table(header, rows, "Episodes with a collision, by filter, condition, scenario, and policy inside")
    for name, found in totals(counts).items():
        limit = f", a rate below {found['upper_limit_95']:.2g} with 95 % confidence" if name == "certified" else ""
        print_text(
            f"{TOTALS[name]}: {found['collisions']} of {found['episodes']} episodes with a collision{limit}; smallest "
            f"distance {found['min_distance']:.4f} m, bodies touch at 0.4 m; {found['infeasible']} episodes in which a "
            "guarantee had to be begun anew"
        )


def _scenario(family: str, agents: int, model: str = "integrator") -> str:
    return f"{family}:agents={agents}" + ("" if model == "integrator" else f",model={model}")


def _scenario_of(count: Count) -> str:
    return _scenario(count.scenario, count.agents)


def _cells(found: Mapping[str, Mapping[str, int | float]]) -> tuple[str, ...]:
    certified, points = ("", "", "", ""), ""
    if some := found.get("certified"):
        distance = f"{some['min_distance']:.4f} m"
        certified = (str(some["episodes"]), str(some["collisions"]), distance, str(some["infeasible"]))
    if some := found.get("estimated"):
        points = f"{some['collisions']} of {some['episodes']}"
    return (*certified, points)


def main() -> None:
    """Print the counts; after an interrupt those until then."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("--episodes", type=int, default=1000, help="with certified bounds; 1000 by default")
    parser.add_argument("--seed", type=int, default=0, help="of the first episode")
    parser.add_argument(
        "--model", choices=TEAM_MODELS, default="integrator", help="of all agents; by default integrator"
    )
    parser.add_argument("--json", action="store_true", help="print one JSON object with every count")
    chosen = parser.parse_args()
    if chosen.episodes < 1 or chosen.seed < 0:
        parser.error("--episodes must be at least 1, and --seed at least 0")
    counts: list[Count] = []
    interrupted = False
    try:
        with Progress("counting collisions") as progress:
            for each in collisions(chosen.episodes, chosen.seed, model=chosen.model, progress=progress):
                counts.append(each)
    except KeyboardInterrupt:
        interrupted = True
    if chosen.json:
        rows = [each._asdict() for each in counts]
        print(json.dumps({"model": chosen.model, "interrupted": interrupted, "totals": totals(counts), "rows": rows}))
    elif counts:
        print_counts(counts)
    if interrupted:
        say(f"interrupted after {sum(each.episodes for each in counts)} episodes")
        sys.exit(130)


if __name__ == "__main__":
    main()
