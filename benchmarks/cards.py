"""Cards of the policies that come with the library: how each was trained, what it reaches, and where it fails."""

from __future__ import annotations

import re
from collections.abc import Iterator, Mapping, Sequence
from dataclasses import fields
from datetime import date
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from agents.comparison import Comparison, Row, compare
from agents.learning.config import TrainingConfig
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
UP = 0.8  # probability that a link is there, where each episode draws its own graph
NETWORKS = ("ideal", "wifi", "lossy:loss=0.3,burst=5")
"""Over which policies that were trained over a network are played."""


HEAD = """# Cards of the pretrained policies

<!-- written by python -m benchmarks.pretrained; the sentences on failures are in index.toml -->

Each policy is measured on episodes on which none was trained or selected, beside the script that is best of all under
the first condition (with the parameters that `khop tune` found). Returns are means over agents of an episode's sum,
larger is better; ± is the 95 % interval over episodes. The difference is learned minus script, paired by episode; it is
in bold where its interval excludes 0.

| name | environment | scenario | network | difference from the best script |
|---|---|---|---|---|"""


class Condition(NamedTuple):
    """A row of a card.

    Attributes:
        label: in the table.
        observe: what is known of agents that aren't neighbours.
        arguments: of the environment.
        inside: the safety filter in which policies act, "filter:OPTIONS:"; "" for none.
        up: whether each episode has only some of the links, each with probability `UP`.
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
    if shield is None or not shield.startswith("certified"):  # which needs to know where others may be
        yield Condition("on neighbours only", "local", own, inside)
    if network is None:
        yield Condition(f"{100.0 * (1.0 - UP):.0f} % of the links down, drawn anew for each episode", up=True)


def write_cards(path: Path, episodes: int, workers: int, *, again: bool = False) -> None:
    """Write all cards in Markdown; policies whose file has a card with as many episodes aren't measured again.

    The file is written after each policy, so that an interrupted command can be continued.

    Args:
        path: of the cards; what was measured is taken from there.
        episodes: of each row, from seed 0.
        workers: number of processes.
        again: whether to measure all.
    """
    written = path.read_text(encoding="utf-8") if path.exists() else ""
    policies = shipped()
    blocks = {name: _kept(name, written, episodes) for name in policies}
    with Progress("measuring policies") as progress:
        for number, policy in enumerate(policies.values()):
            if again or blocks[policy.name] is None:
                blocks[policy.name] = _measured(policy, episodes, workers)
                progress.say(f"{policy.name}: {_verdict(blocks[policy.name] or '')}")
            path.write_text(_text(policies, blocks), encoding="utf-8")
            progress((number + 1) / len(policies))


def _kept(name: str, written: str, episodes: int) -> str | None:
    """What was measured of the file that is there now; None if nothing was."""
    card = re.search(rf"(?ms)^## `{name}`\n(.*?)(?=^## |\Z)", written)
    if card is None or f"`{digest(name)}`" not in card[1]:
        return None
    block = re.search(rf"(?ms)^\*\*Reaches\*\* on {episodes} episodes .*?(?=\n\n\*\*Fails)", card[1])
    return None if block is None else block[0]


def _verdict(block: str) -> str:
    """The difference from the script under the first condition."""
    found = re.search(r"(?m)^\| as trained \|.*?\|.*?\| (.*?) \|", block)
    return "" if found is None else found[1]


def _measured(policy: Shipped, episodes: int, workers: int) -> str:
    """The table of a card, and what it was measured with."""
    navigation = policy.environment == "navigation_v0"
    rows, best = [], ""
    for condition in conditions(policy):
        candidates = (best,) if best else IN_NAVIGATION if navigation else SCRIPTS
        learned, *scripts = _compared(policy, condition, candidates, episodes, workers).rows
        script = max(scripts, key=lambda row: float(row.episodes.returns.mean()))
        best = script.policy.removeprefix(condition.inside)
        rows.append(_row(condition, learned, script))
    header = ["", "learned: return", f"`{best}`: return", "difference", "error at the end, learned / script"]
    header += ["collided, learned / script", "all arrived, learned / script"] * navigation
    head = f"**Reaches** on {episodes} episodes (measured on {date.today().isoformat()}, {commit()}; errors in "
    return "\n".join(
        [f"{head}{learned.env.error_unit})", "", f"| {' | '.join(header)} |", f"{'|---' * len(header)}|", *rows]
    )


def _text(policies: Mapping[str, Shipped], blocks: Mapping[str, str | None]) -> str:
    """All cards of the policies that were measured."""
    lines, cards = [HEAD], []
    for policy in policies.values():
        if (block := blocks[policy.name]) is not None:
            where = f"| `{policy.name}` | `{policy.environment}` | `{policy.scenario}` | {_network(policy)} |"
            lines.append(f"{where} {_verdict(block)} |")
            cards.append(_card(policy, block))
    return "\n".join([*lines, "", *cards])


def _card(policy: Shipped, block: str) -> str:
    about = LearnedPolicy.load(policy.path).about
    bounds = " with bounds" if about["bounds"] else ""
    versions = ", ".join(f"{name} {version}" for name, version in about["versions"].items())
    since = [f"`{each.name}`" for each in fields(TrainingConfig) if each.name not in about]
    made = "\n".join(policy.train)
    if since:
        made += (
            f"\n```\n\nThese settings are newer than it, and the commands train differently now: {', '.join(since)}."
        )
    else:
        made += "\n```"
    return f"""## `{policy.name}`

For `{policy.environment}` on `{policy.scenario}`, network: {_network(policy)}. File `{policy.name}.npz`, \
{policy.path.stat().st_size / 1000:.0f} kB, SHA-256 `{digest(policy.name)}`.

**Trained** on {policy.trained.isoformat()} with seed {about["seed"]}, on observations of kind \
`{about["observe"]}`{bounds}; the best evaluation of {about["timesteps"]:,} agent-steps, after {about["trained"]:,}. \
{versions}:

```
{made}

{block}

**Fails.** {policy.fails.strip()}
"""


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


def _row(condition: Condition, learned: Row, script: Row) -> str:
    pair = [row.summary() for row in (learned, script)]
    returns = [f"{each['mean_return']:.3g} ± {_short(each['ci95'] or 0.0)}" for each in pair]
    cells = [condition.label, *returns, _difference(learned, script)]
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
    text = f"{_short(mean, '+')} ± {_short(half)} ({_short(percent, '+')} %)"
    return f"**{text}**" if abs(mean) > half else text


def _short(value: float, sign: str = "") -> str:
    """Two digits, or all before the point."""
    return f"{value:{sign}.0f}" if abs(value) >= 10.0 else f"{value:{sign}.2g}"


def _network(policy: Shipped) -> str:
    """The network of the training, for a table."""
    if policy.network is not None:
        return f"`{policy.network}`"
    network, _ = policy.over(scenario(policy.scenario))
    return "none" if network is None else "the scenario's own"
