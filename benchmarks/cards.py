"""Cards of the policies that come with the library: how each was trained, what it reaches, and where it fails."""

from __future__ import annotations

from collections.abc import Iterator, Mapping, Sequence
from datetime import date
from typing import Any, NamedTuple

import numpy as np

from agents.comparison import Comparison, Row, compare
from agents.learning.learned import LearnedPolicy
from agents.learning.pretrained import Shipped, digest, shipped
from agents.outcomes import interval95
from benchmarks.publish import commit
from khop_env.network import RandomLinks
from khop_env.registry import scenario
from khop_env.simulation import Observe
from khop_env.terminal import Progress

SCRIPTS = ("tanh", "linear", "formation", "leader_following")
IN_NAVIGATION = ("keep_right", "go_to_goal", "orca")
FIRST_SEED = 0
UP = 0.8  # part of the time in which a link is up, where links come and go
NETWORKS = ("ideal", "wifi", "lossy:loss=0.3,burst=5")
"""Over which policies that were trained over a network are played."""


class Condition(NamedTuple):
    """A row of a card.

    Attributes:
        label: in the table.
        observe: what is known of agents that aren't neighbours.
        arguments: of the environment.
        inside: the safety filter in which policies act, "filter:OPTIONS:"; "" for none.
        up: whether links come and go at random, `UP`.
    """

    label: str
    observe: Observe = "estimate"
    arguments: Mapping[str, Any] = {}
    inside: str = ""
    up: bool = False


def conditions(policy: Shipped) -> Iterator[Condition]:
    """What a policy is measured under; first as it was trained."""
    about = LearnedPolicy.load(policy.path).about
    shield = about.get("shield")
    inside = "" if shield is None else f"filter:margin={shield}:"
    own = {} if policy.network is None else {"network": policy.network}
    own |= {} if policy.estimator is None else {"estimator": policy.estimator}
    network, _ = policy.over(scenario(policy.scenario))
    yield Condition("as trained", arguments=own, inside=inside)
    if shield is not None:
        if "announce=true" in shield:
            yield Condition("in the filter, anchors not announced", arguments=own, inside="filter:")
        yield Condition("without the filter", arguments=own)
    if network is None:
        yield Condition("on true states", "oracle")
    else:
        names = [name for name in NETWORKS if name != policy.network]
        for name in names:
            yield Condition(f"over `{name}`", arguments={**own, "network": name}, inside=inside)
    yield Condition("on neighbours only", "local", own, inside)
    if network is None:
        yield Condition(f"each link up {100.0 * UP:g} % of the time", up=True)


def cards(episodes: int, workers: int) -> str:
    """All cards in Markdown, measured.

    Args:
        episodes: of each row, from seed 0.
        workers: number of processes.
    """
    found = list(shipped().values())
    lines = [
        "# Cards of the pretrained policies",
        "",
        f"<!-- written by python -m benchmarks.pretrained on {date.today().isoformat()}, {commit()} -->",
        "",
        f"Each policy was measured on {episodes} episodes, seeds {FIRST_SEED} to {FIRST_SEED + episodes - 1}, on which "
        "none was trained or selected, beside the script that is best of all under the first condition (with the "
        "parameters that `khop tune` found). Returns are means over agents of an episode's sum, larger is better; ± is "
        "the 95 % interval over episodes. The difference is learned minus script, paired by episode; it is in bold "
        "where its interval excludes 0.",
        "",
        "| name | environment | scenario | network | beside the best script |",
        "|---|---|---|---|---|",
    ]
    bodies = []
    with Progress("measuring the policies") as progress:
        for number, policy in enumerate(found):
            summary, body = _card(policy, episodes, workers)
            lines.append(summary)
            bodies.append(body)
            progress((number + 1) / len(found))
    return "\n".join([*lines, "", *bodies])


def _card(policy: Shipped, episodes: int, workers: int) -> tuple[str, str]:
    """The line in the list, and the card."""
    about = LearnedPolicy.load(policy.path).about
    rows, first, best = [], None, ""
    for condition in conditions(policy):
        candidates = (IN_NAVIGATION if policy.environment == "navigation_v0" else SCRIPTS) if first is None else (best,)
        compared = _compared(policy, condition, candidates, episodes, workers)
        learned, *scripts = compared.rows
        script = max(scripts, key=lambda row: float(row.episodes.returns.mean()))
        best = script.policy.removeprefix(condition.inside)
        difference = _difference(learned, script)
        first = first or difference
        rows.append(_row(condition, learned, script, difference))
    navigation = policy.environment == "navigation_v0"
    header = ["", "learned: return", f"`{best}`: return", "difference", "error at the end, learned / script"]
    header += ["collided, learned / script", "all arrived, learned / script"] * navigation
    unit = learned.env.error_unit
    network = policy.network or ("the scenario's own" if policy.over(scenario(policy.scenario))[0] else "none")
    made = "\n".join(policy.train)
    text = f"""## `{policy.name}`

For `{policy.environment}` on `{policy.scenario}`, network: {_code(network)}. File `{policy.name}.npz`, \
{policy.path.stat().st_size / 1000:.0f} kB, SHA-256 `{digest(policy.name)}`.

**Trained** on {policy.trained.isoformat()} with seed {about["seed"]}; it is the best evaluation of \
{about["timesteps"]:,} agent-steps, after {about["trained"]:,}, on observations of kind `{about["observe"]}`\
{" with bounds" if about["bounds"] else ""}, with {_versions(about)}:

```
{made}
```

**Reaches** (errors in {unit})

| {" | ".join(header)} |
{"|---" * len(header)}|
{chr(10).join(rows)}

**Fails.** {policy.fails.strip()}
"""
    return f"| `{policy.name}` | `{policy.environment}` | `{policy.scenario}` | {_code(network)} | {first} |", text


def _compared(policy: Shipped, condition: Condition, scripts: Sequence[str], episodes: int, workers: int) -> Comparison:
    where = scenario(policy.scenario)
    return compare(
        policy.environment,
        [f"{condition.inside}{name}" for name in (f"ppo:pretrained/{policy.name}", *scripts)],
        [condition.observe],
        scenario=where.replace(schedule=RandomLinks(UP)) if condition.up else where,
        seeds=range(FIRST_SEED, FIRST_SEED + episodes),
        arguments=condition.arguments,
        workers=workers,
    )


def _row(condition: Condition, learned: Row, script: Row, difference: str) -> str:
    pair = [row.summary() for row in (learned, script)]
    returns = [f"{each['mean_return']:.3g} ± {each['ci95'] or 0.0:.2g}" for each in pair]
    cells = [condition.label, *returns, difference]
    cells.append(" / ".join(f"{each['final_task_error']:.2g}" for each in pair))
    for rate in ("collision_rate", "success_rate"):
        if rate in pair[0]:
            cells.append(" / ".join(f"{100.0 * each[rate]:.0f} %" for each in pair))
    return f"| {' | '.join(cells)} |"


def _difference(learned: Row, script: Row) -> str:
    """Paired by episode, and in percent of the script's return."""
    more = learned.episodes.returns - script.episodes.returns
    mean, half = float(more.mean()), interval95(more) or 0.0
    percent = 100.0 * mean / abs(float(np.mean(script.episodes.returns)))
    text = f"{mean:+.2g} ± {half:.2g} ({percent:+.2g} %)"
    return f"**{text}**" if abs(mean) > half else text


def _versions(about: Mapping[str, Any]) -> str:
    return ", ".join(f"{name} {version}" for name, version in about["versions"].items())


def _code(network: str) -> str:
    return f"`{network}`" if ":" in network or network in NETWORKS else network
