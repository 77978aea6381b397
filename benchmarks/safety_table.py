"""The table of docs/benchmarks/safety.md: ways to keep apart, over networks.

python -m benchmarks.safety_table crossing swap:agents=16,duration=30 --episodes 200 --workers 2
"""

from __future__ import annotations

import argparse
from collections.abc import Iterator, Mapping, Sequence
from types import MappingProxyType
from typing import NamedTuple

import numpy as np

from agents import compare, describe
from agents.policy import by_agent
from agents.workers import Interrupted, UnfinishedError
from khop_env.registry import make_batched
from khop_env.simulation import Observe
from khop_env.terminal import Progress, say

NETWORKS: Mapping[str, str] = MappingProxyType(
    {
        "nothing lost": "ideal",
        "30 % lost": "ideal:loss=0.3",
        "30 % in bursts of 5": "ideal:loss=0.3,burst=5",
        "30 % in bursts of 20": "ideal:loss=0.3,burst=20",
    }
)
WORST = "filter:margin=WORST"


class Method(NamedTuple):
    """A row: its name in the table, the policy, in which `WORST` stands for the network's, and what it observes."""

    label: str
    policy: str
    observe: Observe = "estimate"


METHODS = (
    Method("straight to the goal", "go_to_goal"),
    Method("keep right", "keep_right"),
    Method("ORCA", "orca"),
    Method("ORCA, 0.25 m farther apart (tuned)", "orca:margin=0.25"),
    Method("robust barrier function", "robust_barrier"),
    Method("filter on the truth", "filter:margin=none", "oracle"),
    Method("filter, point estimates held", "filter:margin=none"),
    Method("filter, point estimates dead-reckoned", "filter:margin=none,dead_reckoning=true"),
    Method("the same, 0.05 m apart, gamma = 0.3 (tuned)", "filter:margin=0.05,gamma=0.3,dead_reckoning=true"),
    *(
        Method(f"the same, {margin} m apart", f"filter:margin={margin},dead_reckoning=true")
        for margin in ("0.1", "0.25", "0.5")
    ),
    Method("filter, constant margin for the oldest message", WORST),
    Method("filter, neighbours only", "filter:margin=none", "local"),
    Method("**filter, certified bounds**", "filter"),
    Method("**filter, certified bounds, anchors announced**", "filter:announce=true"),
    Method("learned, in the certified filter", "filter:ppo:pretrained"),
)
"""Rows of the table; margins are tuned by `khop tune navigation_v0 --scenario crossing:burst=1`, on other episodes."""


def oldest(scenario: str, network: str, episodes: int = 50) -> float:
    """Largest age in s of what any agent knows of another once it has heard of it, while nobody moves.

    Args:
        scenario: of navigation_v0.
        network: its name.
        episodes: from seed 0.
    """
    env = make_batched("navigation_v0", scenario, num_envs=episodes, network=network)
    layouts = describe(env).layouts
    columns = {
        agent: [[layout.index(f"slot{q}.{name}") for q in range(len(layout.slots))] for name in ("age", "valid")]
        for agent, layout in layouts.items()
    }
    largest, observations = 0.0, env.reset(range(episodes))[0]
    for _ in range(env.settings.horizon - 1):
        for agent, values in by_agent(env, observations).items():
            age, valid = (values[:, places] for places in columns[agent])
            largest = max(largest, float(np.where(valid > 0.5, age, 0.0).max()))
        observations, *_ = env.step(np.zeros((episodes, env.action_offset[-1]), np.float32))
    return largest


def cells(method: Method, scenario: str, seeds: Sequence[int], workers: int) -> list[str]:
    """A method's cells, one for each network.

    Args:
        method: of the row.
        scenario: of navigation_v0.
        seeds: one per episode.
        workers: number of processes.

    Raises:
        ValueError: if the policy isn't there, or doesn't fit.
    """
    found = []
    for network in NETWORKS.values():
        policy = method.policy
        if policy == WORST:
            policy = f"filter:margin={(1.0 + 0.1) * oldest(scenario, network):.3g}"  # the speed, and a disturbance
        (row,) = compare(
            "navigation_v0",
            [policy],
            [method.observe],
            scenario=scenario,
            seeds=seeds,
            workers=workers,
            arguments={"network": network},
        ).rows
        seen = row.summary()
        time = "-" if seen["arrival_time"] is None else f"{seen['arrival_time']:.1f}"
        found.append(f"{100 * seen['collision_rate']:.3g} / {100 * seen['success_rate']:.3g} / {time}")
    return found


def table(scenario: str, seeds: Sequence[int], workers: int = 1, methods: Sequence[Method] = METHODS) -> Iterator[str]:
    """Lines of Markdown, as they are measured; methods that aren't there are left out, with a message.

    Args:
        scenario: of navigation_v0.
        seeds: one per episode.
        workers: number of processes.
        methods: the rows.
    """
    yield from (f"**`{scenario}`**", "", f"| | {' | '.join(NETWORKS)} |", "|---" * (1 + len(NETWORKS)) + "|")
    with Progress(scenario) as progress:
        for number, method in enumerate(methods):
            try:
                yield f"| {method.label} | {' | '.join(cells(method, scenario, seeds, workers))} |"
            except (ValueError, UnfinishedError) as error:
                progress.say(f"left out: {method.label}: {error}")
            progress((number + 1) / len(methods))


def main() -> None:
    """Print the table."""
    parser = argparse.ArgumentParser(description=__doc__.partition("\n")[0])
    parser.add_argument("scenarios", nargs="+", help="of navigation_v0")
    parser.add_argument("--episodes", type=int, default=200, help="of each cell, from seed 0; 200 by default")
    parser.add_argument("--workers", type=int, default=1, help="processes")
    chosen = parser.parse_args()
    if chosen.episodes < 1 or chosen.workers < 1:
        parser.error("--episodes and --workers must be at least 1")
    limit = 100.0 * (1.0 - 0.05 ** (1.0 / chosen.episodes))
    print(
        "Episodes with a collision in % / with everybody at the goal, and no collision, in % / mean time of arrival "
        f"in s; {chosen.episodes} episodes each, the same for all (0 of {chosen.episodes}: below {limit:.2g} % with "
        "95 % confidence).\n"
    )
    try:
        for scenario in chosen.scenarios:
            for line in table(scenario, range(chosen.episodes), chosen.workers):
                print(line, flush=True)
            print()
    except (KeyboardInterrupt, Interrupted):
        say("interrupted")
        raise SystemExit(130) from None


if __name__ == "__main__":
    main()
