"""The study in words: the tables of each task in Markdown, the comparisons below them, and what became of the aims."""

from __future__ import annotations

import math
from collections.abc import Container, Iterator, Sequence
from typing import NamedTuple

import numpy as np

from agents.outcomes import interval95, wilson95
from agents.tuned import OVER
from benchmarks.study import CONTINUOUS, FAST, FILTER, LOSSY, NETWORKED, NETWORKS, RECIPES, SEEDS, Play
from benchmarks.study_measured import FLOORS, Block, Row
from benchmarks.study_statistics import LEVEL, Difference, difference, iqm, iqm95, short
from khop_env.observers import Exponential
from khop_env.registry import scenario
from khop_env.simulation import OBSERVE

WITHIN = f"within {LEVEL:g} % of the truth"
WITHIN_FAST = f"the same, bounds falling at {FAST:g} 1/s"
WITHIN_SWAPPED = "the same, trained on the truth and played on estimates"
AT_LEAST = "level with the best script"
ON_TOP = "residual: level with the best script"
PAY = "bounds pay, MLP"
PAY_ATTENTION = "bounds pay, attention"
NO_COLLISION = "shielded: no collision"
ABOVE = "shielded: best return"
ARRIVE = "shielded: most successes"
THREE = "better on three tasks"
NOT_YET = "not trained yet"
AIMS = (WITHIN, WITHIN_SWAPPED, WITHIN_FAST, AT_LEAST, ON_TOP, PAY, PAY_ATTENTION, NO_COLLISION, ABOVE, ARRIVE)
"""What is aimed at, in the order of the summary; `THREE` is counted from the others."""


class Finding(NamedTuple):
    """One comparison.

    Attributes:
        title: what is compared.
        result: numbers.
        aim: of `AIMS`; "" where nothing was aimed at.
        verdict: what became of it, beginning with "reached", "missed" or "open".
        brief: numbers for the summary.
    """

    title: str
    result: str
    aim: str = ""
    verdict: str = ""
    brief: str = ""


def summary(blocks: Sequence[Block]) -> Iterator[str]:
    """A table of aims and tasks: reached, missed by how much, or open."""
    found = [(_of(block, finding), finding) for block in blocks for finding in findings(block)]
    yield "| aim | task | verdict | difference, % |"
    yield "|---|---|---|---|"
    for aim in AIMS:
        for label, finding in found:
            if finding.aim == aim:
                verdict = finding.verdict.replace("missed", "**missed**")
                yield f"| {aim} | {label} | {verdict} | {finding.brief} |"
    for kind, aim in (("", AT_LEAST), ("residual: ", ON_TOP)):
        chosen = [(label, finding) for label, finding in found if finding.aim in (aim, ABOVE)]
        better = [label for label, finding in chosen if finding.verdict.startswith("reached: better")]
        undecided = sum(finding.verdict.startswith("open") for _, finding in chosen)
        if len(better) >= 3:
            verdict = "reached"
        else:
            verdict = "open" if len(better) + undecided >= 3 else f"**missed** by {3 - len(better)}"
        yield f"| {kind}{THREE} | {', '.join(better) or 'none'} | {verdict} | {len(better)} of {len(chosen)} |"


def _of(block: Block, finding: Finding) -> str:
    """The task of a finding; in navigation with the kind of training, of which several are aimed at."""
    return f"{block.task.short}, {finding.title.partition(',')[0]}" if block.navigates else block.task.short


def table(block: Block) -> Iterator[str]:
    """The tables and comparisons of one task."""
    yield f"## {block.task.label}\n"
    if block.navigates:
        yield f"In the filter: as `{FILTER}:POLICY`. Alone: without it, where returns count no collisions.\n"
        yield "| policy | seeds | return | over seeds | IQM | collided % | success % | arrival (s) |"
        yield "|---|---|---|---|---|---|---|---|"
        for row in block.rows:
            if row.seeds:
                yield _cells(_inside(row), row, _outcomes(row))
    else:
        yield f"In continuous exchange; bounds on estimates fall at {rates_of(block.task.scenario)} 1/s.\n"
        yield "| policy | seeds | return | over seeds | IQM | error at the end | largest \\|e\\|, late |"
        yield "|---|---|---|---|---|---|---|"
        for row in _shown(block, [*map(Play, OBSERVE), Play(rate=FAST)], CONTINUOUS):
            largest = f"{_most(row, 'max_normalized_disagreement')}, {_most(row, 'late_normalized_disagreement')}"
            yield _cells(_label(row, block), row, (_error(row), largest))
        yield f"\nOver networks; scripts have the parameters found over `{OVER}`.\n"
        yield "| policy | on | seeds | return | over seeds | IQM | error at the end | error/certificate |"
        yield "|---|---|---|---|---|---|---|---|"
        for row in _shown(block, [Play(network=network) for network in NETWORKS], NETWORKED):
            on = (row.play.network or "").partition(":")[0]
            yield _cells(f"{_label(row, block)} | {on}", row, (_error(row), _most(row, "max_error_to_bound")))
    yield ""
    if missing := dict.fromkeys(row.name for row in block.rows if not row.seeds):
        yield f"Not trained yet: {', '.join(missing)}.\n"
    for finding in findings(block):
        if finding.result == NOT_YET:
            continue
        aim = f" (aim: {finding.aim}: {finding.verdict})" if finding.aim else ""
        yield f"- {finding.title}: {finding.result}{aim}"
    yield ""


def rates_of(name: str) -> str:
    """The rates at which a scenario's bounds on state estimates fall, in 1/s."""
    bounds = scenario(name).design.states.bounds
    return " to ".join(
        f"{rate:g}" for rate in sorted({bound.rate for bound in bounds if isinstance(bound, Exponential)})
    )


def largest_ratios(blocks: Sequence[Block]) -> tuple[float, float, float]:
    """Largest |e| in continuous exchange, over all time and after the transient, and largest error over its bound."""
    runs = [(row.play, run) for block in blocks for row in block.rows for run in row.runs]
    keys = ("max_normalized_disagreement", "late_normalized_disagreement", "max_error_to_bound")
    continuous = [
        max((float(run[key].max()) for play, run in runs if play.network is None), default=0.0) for key in keys
    ]
    return continuous[0], continuous[1], max((float(run[keys[2]].max()) for _, run in runs), default=0.0)


def findings(block: Block) -> Iterator[Finding]:
    """All comparisons of one task, those with an aim first."""
    if block.navigates:
        yield from _navigation(block)
        return
    here, lossy = Play(), Play(network=LOSSY)
    best, best_local = block.best(here), block.best(Play("local"))
    leader = block.task.environment == "leader_following_v0"

    def against(
        title: str, ours: str, where: Play, theirs: str | Row, aim: str = "", other: Play | None = None
    ) -> Finding:
        reference = block.row(theirs, other or where) if isinstance(theirs, str) else theirs
        return _compared(title, block.row(ours, where), reference, aim)

    script = f"the best tuned script on estimates ({best.name})"
    yield against(
        "learned on estimates, against learned on the truth", "estimate", here, "oracle", WITHIN, Play("oracle")
    )
    title = "trained on the truth: played on estimates, against played on the truth"
    yield against(title, "oracle", here, "oracle", WITHIN_SWAPPED, Play("oracle"))
    if "faster bounds" in block.task.recipes:
        title = f"with bounds that fall at {FAST:g} 1/s, against learned on the truth"
        yield against(title, "faster bounds", Play(rate=FAST), "oracle", WITHIN_FAST, Play("oracle"))
    for play in (here, Play(rate=FAST)):
        title = f"{best.name} on estimates{_bounds(play)}, against itself on the truth"
        yield against(title, best.name, play, best.name, "", Play("oracle"))
    yield against(f"learned on estimates, against {script}", "estimate", here, best, AT_LEAST)
    yield against(f"residual, against {script}", "residual", here, best, ON_TOP)
    for kind, aim in (("lossy", PAY), ("lossy attention", PAY_ATTENTION)):
        title = f"{kind}: with certificates in the observation, against without"
        yield against(title, f"{kind} + bounds", lossy, kind, aim if leader else "")
    yield against("residual, against learned from nothing", "residual", here, "estimate")
    yield against(
        "trained on the truth but played on estimates, against trained on estimates", "oracle", here, "estimate"
    )
    if "critic on the state" in block.task.recipes:
        yield against(
            "with a critic on the true state, against one on estimates", "critic on the state", here, "estimate"
        )
        title = "with a critic on the true state, against learned on the truth"
        yield against(title, "critic on the state", here, "oracle", "", Play("oracle"))
    yield against("with the guaranteed bounds, against without", "estimate + bounds", here, "estimate")
    title = f"learned on estimates, against the best tuned script on neighbours only ({best_local.name})"
    yield against(title, "estimate", here, best_local)
    yield against(
        "learned on estimates, against learned on neighbours only", "estimate", here, "local", "", Play("local")
    )
    yield against("played lossy: trained ideal, against trained lossy", "ideal", lossy, "lossy")
    yield against("played lossy: trained on random networks, against trained lossy", "random", lossy, "lossy")
    yield against("played lossy: trained on random networks, against trained ideal", "random", lossy, "ideal")
    yield against("played lossy: attention, against an MLP", "lossy attention", lossy, "lossy")
    for name in ("ideal", "wifi", "lossy", "lossy attention"):
        reference = block.best(RECIPES[name].plays[0])  # on what it was trained
        yield against(f"{name}, against the best script there ({reference.name})", name, reference.play, reference)


def _navigation(block: Block) -> Iterator[Finding]:
    inside = Play(inside=FILTER)
    by_return, by_success = block.best(inside), block.best(inside, "success")
    for name in ("shielded", "shielded residual"):
        if name not in block.task.recipes:
            continue
        shielded = block.row(name, inside)
        if shielded is None:
            yield Finding(f"{name}, collisions", NOT_YET, NO_COLLISION, "open: not trained yet")
        else:
            collided = shielded.values("collision")
            text = f"{int(collided.sum())} of {collided.size} episodes"
            verdict = "missed" if collided.any() else "reached" if _complete(shielded) else "open: seeds are missing"
            yield Finding(f"{name}, collisions", text, NO_COLLISION, verdict, text.removesuffix(" episodes"))
        title = f"{name}, return against {_script(by_return)} in the same filter"
        yield _compared(title, shielded, by_return, ABOVE)
        title = f"{name}, share of successes against {_script(by_success)} in the same filter"
        yield _compared(title, shielded, by_success, ARRIVE, "success")
    shielded = block.row("shielded", inside)
    other = block.row("not shielded", inside)
    for key, what in (("returns", "return"), ("success", "share of successes")):
        yield _compared(f"in the filter, {what}: trained in it, against trained alone", shielded, other, "", key)


def _compared(title: str, ours: Row | None, theirs: Row | None, aim: str, key: str = "returns") -> Finding:
    found = None if ours is None or theirs is None else difference(ours, theirs, key)
    if ours is None or found is None:
        return Finding(title, NOT_YET, aim, "open: not trained yet", "")
    half = f" ± {short(found.half)}" if math.isfinite(found.half) else ""
    brief = found.relative.removesuffix(" %") + half
    return Finding(title, str(found), aim, outcome_of(aim, found, _complete(ours)) if aim else "", brief)


def outcome_of(aim: str, found: Difference, complete: bool) -> str:
    """What became of an aim: reached, missed by how much, or open.

    Args:
        aim: of `AIMS`, one that is about a difference.
        found: from what it is compared with.
        complete: whether all training seeds have finished.
    """
    if found.over_seeds is None:
        return "open: one seed"
    low, high = found.percent - found.half, found.percent + found.half
    if aim in (WITHIN, WITHIN_SWAPPED, WITHIN_FAST):
        if high < -LEVEL:
            return f"missed by {short(-LEVEL - found.percent)} %"
        return "reached" if low > -LEVEL else "open"
    if found.word == "worse":
        return f"missed by {short(-found.percent)} %"
    if found.word == "better":
        return "reached: better"
    if aim in (AT_LEAST, ON_TOP):
        return "reached: level" if low > -LEVEL else "open"
    return "missed: no clear difference" if complete else "open: no clear difference yet"


def _complete(row: Row) -> bool:
    return len(row.seeds) >= len(SEEDS)


def _shown(block: Block, plays: Sequence[Play], recipes: Container[str]) -> Iterator[Row]:
    """On each of these: the best script, the proportional and the paper's law, floors; and then what was trained."""
    for row in block.rows:
        if row.play in plays and not row.learned and row.name in ("tanh", "linear", *FLOORS, block.best(row.play).name):
            yield row
    yield from (row for row in block.rows if row.seeds and row.learned and row.play in plays and row.name in recipes)


def _label(row: Row, block: Block) -> str:
    """Name of a row of a task other than navigation; that of the best script stands out."""
    name = f"PPO {row.name}" if row.learned else f"**{row.name}**" if row is block.best(row.play) else row.name
    shown = row.play.network is not None or row.name in FLOORS or row.play.observe in row.name.split()
    return name if shown else f"{name}, on {row.play.observe}{_bounds(row.play)}"


def _bounds(play: Play) -> str:
    return "" if play.rate is None else f", bounds at {play.rate:g} 1/s"


def _inside(row: Row) -> str:
    """Name of a row in navigation."""
    name = f"PPO {row.name}" if row.learned else _script(row)
    return f"{name}, {'in the filter' if row.play.inside else 'alone'}"


def _script(row: Row) -> str:
    """Name of a script, which may be in the filter."""
    return row.name.removeprefix(FILTER).removeprefix(":") or "keep_right"


def _cells(first: str, row: Row, rest: Sequence[str]) -> str:
    """A line of a table."""
    seeds = f"{len(row.seeds)}/{len(SEEDS)}" if row.learned else ""
    returns = row.returns
    mean, over_episodes = returns.mean(), interval95(returns.mean(axis=0)) or 0.0
    over_seeds = interval95(returns.mean(axis=1))
    low, high = iqm95(returns)
    cells = (
        f"{short(mean, 4)} ± {short(over_episodes)}",
        "" if over_seeds is None else f"± {short(over_seeds)}",
        f"{short(iqm(returns), 4)} [{short(low, 3)}, {short(high, 3)}]",
        *rest,
    )
    return f"| {first} | {seeds} | {' | '.join(cells)} |"


def _error(row: Row) -> str:
    return f"{row.values('final_task_error').mean():.3g}"


def _most(row: Row, key: str) -> str:
    return f"{row.values(key).max():.3f}"


def _outcomes(row: Row) -> tuple[str, str, str]:
    """Collisions and successes with Wilson's intervals, of all seeds' episodes together, and the time of arrival."""
    texts = []
    for key in ("collision", "success"):
        values = row.values(key).ravel()
        low, high = wilson95(values)
        texts.append(f"{100 * values.mean():.1f} [{100 * low:.1f}, {100 * high:.1f}]")
    times = row.values("arrival_time")[row.values("success") > 0.5]
    return texts[0], texts[1], f"{np.mean(times):.2f}" if times.size else ""
