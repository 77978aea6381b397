"""The command line's output: tables and summaries on stdout, progress and messages on stderr."""

from __future__ import annotations

import itertools
import re
import sys
import textwrap
import time
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import typer

from khop_env.brief import BOUND_REACHED, ratio_text

SHOWN_TARGETS = 20
_SHOWN_IDS = 6  # of a k-hop set
_PAGE = 80  # columns
_NEARLY = 0.99  # of a certified bound: from here on a sentence says that this is normal
NEARLY_REACHED = "close to 1 is normal over a network: an agent that drives at its limit reaches its bound"
_LONGEST_NAME = 18  # characters in a table; longer ones are folded

_UNSURE = 0.5  # s of work before it is guessed how long it will take
_LONG = 2.0  # s: work that takes longer gets a progress bar


def say(text: str) -> None:
    """A message on stderr."""
    typer.echo(text, err=True)


class Progress:
    """A progress bar on stderr for work that takes more than two seconds; called with the fraction that is done."""

    def __init__(self, label: str) -> None:
        self._label, self._start, self._bar = label, time.perf_counter(), None
        self._task: Any = None

    def __enter__(self) -> Progress:
        return self

    def __exit__(self, *_: object) -> None:
        if self._bar is not None:
            self._bar.stop()

    def __call__(self, fraction: float) -> None:
        """Show that `fraction` of the work is done."""
        elapsed = time.perf_counter() - self._start
        if self._bar is None and elapsed > _UNSURE and elapsed > _LONG * fraction:
            self._bar, self._task = _bar(self._label)
        if self._bar is not None:
            self._bar.update(self._task, completed=fraction)

    def say(self, text: str) -> None:
        """A message on stderr, above the bar where there is one."""
        if self._bar is not None:
            self._bar.console.print(text, markup=False, highlight=False, soft_wrap=True)
        else:
            say(text)


def _bar(label: str) -> tuple[Any, Any]:
    from rich import progress
    from rich.console import Console

    console = Console(stderr=True)
    columns = (progress.TextColumn("{task.description}"), progress.BarColumn(), progress.TaskProgressColumn())
    bar = progress.Progress(
        *columns, progress.TimeRemainingColumn(), console=console, transient=True, disable=not console.is_terminal
    )
    bar.start()
    return bar, bar.add_task(label, total=1.0)


@contextmanager
def waiting(label: str) -> Iterator[None]:
    """A spinner on stderr while something of unknown length happens; only on a terminal."""
    if not sys.stderr.isatty():
        yield
        return
    from rich.console import Console

    with Console(stderr=True).status(f"{label} ..."):
        yield


def print_table(
    header: Sequence[str],
    rows: Sequence[Sequence[str]],
    title: str | None = None,
    *,
    width: int = _PAGE,
    whole: Sequence[str] = (),
) -> None:
    """A table on stdout; cells are folded between words.

    Args:
        header: names of the columns.
        rows: their cells; those that are left out at the end are empty.
        title: above it.
        width: in characters, where stdout is no terminal that has one.
        whole: columns that aren't folded at all.

    Where the longest words don't fit, the table is wider than asked for: words aren't broken.
    """
    from rich.box import SIMPLE_HEAD
    from rich.console import Console
    from rich.table import Table

    rows = [(*row, *[""] * (len(header) - len(row))) for row in rows]
    columns = [[name, *(row[number] for row in rows)] for number, name in enumerate(header)]
    lengths = [[max(map(len, ["", *cell.splitlines()])) for cell in cells] for cells in columns]
    words = [max(len(word) for cell in cells for word in [*cell.split(), ""]) for cells in columns]
    least = [max(full) if name in whole else few for name, full, few in zip(header, lengths, words, strict=True)]
    available = Console().width if sys.stdout.isatty() else width
    widths = _narrowed(lengths, least, available - 2 * (len(header) - 1))
    table = Table(title=title, title_justify="left", title_style="bold", box=SIMPLE_HEAD, padding=(0, 1, 0, 0))
    table.pad_edge, table.show_edge = False, False
    for name, chosen in zip(header, widths, strict=True):
        table.add_column(name, width=chosen, overflow="fold")
    for row in rows:
        table.add_row(*row)
    total = max(available, sum(widths) + 2 * len(widths))
    Console(width=total, markup=False, highlight=False).print(table)


def folded(name: str) -> str:
    """A long name in several lines, which end at its own separators; the last ones are filled first.

    So "filter:" and "nav.py:Swirl" stay whole.
    """
    lines = [""]
    for piece in reversed(re.split(r"(?<=[/:,@-])", name)):
        if lines[0] and len(lines[0]) + len(piece) > _LONGEST_NAME:
            lines.insert(0, "")
        lines[0] = piece + lines[0]
    return "\n".join(lines)


def _narrowed(lengths: Sequence[Sequence[int]], least: Sequence[int], room: int) -> list[int]:
    """Widths of columns that fit into `room` as far as their least widths let them.

    Columns whose header alone is folded are narrowed first, then those with fewest folded cells, then the widest.

    Args:
        lengths: of each column's cells, the header first.
        least: width of each column.
        room: for all.
    """
    widths = [max(cells) for cells in lengths]

    def cost(q: int) -> tuple[int, int]:
        return sum(length >= widths[q] for length in lengths[q][1:]), -widths[q]

    while sum(widths) > room and (rest := [q for q in range(len(widths)) if widths[q] > least[q]]):
        widths[min(rest, key=cost)] -= 1
    return widths


def print_text(text: str) -> None:
    """A paragraph on stdout, in lines of 80 columns that break between words only."""
    typer.echo(textwrap.fill(text, _PAGE, break_long_words=False, break_on_hyphens=False, subsequent_indent="  "))


def print_summary(summary: Mapping[str, Any], files: Mapping[str, Path]) -> None:
    """A run in a few lines."""
    observed = {"estimate": "estimates", "oracle": "true states (oracle)", "local": "neighbours only"}[
        summary["observe"]
    ]
    networked = "network" in summary
    how = summary["estimator"] if networked else f"{summary['integrator']}, order {summary['order']}"
    if "tolerance" not in summary:
        steps = f"steps of {summary['dt']:g} s"
    else:
        steps = f"steps of controlled size, tolerance {summary['tolerance']:g}"
    print_text(
        f"{summary['scenario']}: {summary['agents']} agents, {summary['pairs']} pairs of observer and target, "
        f"{summary['duration']:.6g} s in {steps} ({how}), {summary['controller']} on {observed}, "
        f"seed {summary['seed']}"
    )
    if networked:
        _print_certified(summary)
    else:
        _print_guarantee(summary)
    _print_end(summary, files)


def _print_certified(summary: Mapping[str, Any]) -> None:
    """What became of the certified bounds."""
    age = summary["mean_age"]
    known = "nothing arrived" if age is None else f"states that agents know are {1e3 * age:.4g} ms old on average"
    print_text(f"network: {summary['network']}; {known}")
    largest = ratio_text(summary["max_error_to_bound"], BOUND_REACHED if summary["bounds_kept"] else 0.0)
    ratio = f"largest |error| / certified bound {largest}"
    if summary["max_normalized_disagreement"] is not None:
        ratio += f"; |xi|/rho of what agents hold {ratio_text(summary['max_normalized_disagreement'])}"
    kept = "kept" if summary["bounds_kept"] else "not kept"
    violated = f"{summary['violations']} violations in {summary['pair_samples']} pairs and samples"
    print_text(f"certified bounds {kept}: {ratio}; {violated}")
    if summary["bounds_kept"] and (summary["max_error_to_bound"] or 0.0) > _NEARLY:
        print_text(f"({NEARLY_REACHED})")
    for agent, reason in itertools.islice(summary["uncertified"].items(), _SHOWN_IDS):
        print_text(f"{agent}: {reason}")
    if summary["error"] is not None or summary.get("terminated"):
        how = "the episode stopped early" if summary["error"] is not None else "the task ended the episode"
        print_text(f"{how}, at t = {summary['duration']:.6g} s")


def _print_guarantee(summary: Mapping[str, Any]) -> None:
    """What became of the funnels."""
    ratios = f"|xi|/rho {ratio_text(summary['max_normalized_disagreement'])}, "
    ratios += f"|x_tilde|/bound {ratio_text(summary['max_error_to_bound'])}"
    if summary["max_error_to_bound_input"] is not None:
        ratios += f"; of the inputs |mu|/omega {ratio_text(summary['max_normalized_disagreement_input'])}, "
        ratios += f"|g_tilde|/bound {ratio_text(summary['max_error_to_bound_input'])}"
    if summary["funnel_kept"]:
        print_text(f"guarantee kept: largest {ratios} (all below 1)")
        if cut_off := summary.get("cut_off"):
            print_text(
                f"no guarantee for {100.0 * cut_off:.3g} % of pairs and samples, cut off by links that were down"
            )
        if summary["error"] is not None or summary.get("terminated"):
            how = "the episode stopped early" if summary["error"] is not None else "the task ended the episode"
            print_text(f"{how}, at t = {summary['duration']:.6g} s")
    elif summary["error"] is not None:
        print_text(f"guarantee not kept: stopped at t = {summary['duration']:.6g} s; until then largest {ratios}")
    else:
        print_text(f"guarantee not kept: largest {ratios} (should be below 1)")


def _print_end(summary: Mapping[str, Any], files: Mapping[str, Path]) -> None:
    if "environment" in summary:
        error = _number(summary["final_task_error"], summary["task_error_unit"])
        print_text(
            f"{summary['environment']}: return {_number(summary['return'])}, task error at the end {error} (both means "
            "over the agents)"
        )
        if "outcomes" in summary:
            _print_outcomes(summary["outcomes"])
    else:
        error = _number(summary["final_consensus_error"], summary["position_unit"])
        print_text(f"consensus error at the end: {error} (|Pi p|: distance of all positions together from their mean)")
    if summary["diverged"]:
        smaller = "--tolerance" if "tolerance" in summary else "--dt"
        print_text(
            f"the states grew without bound: it seems that the plant diverged; try a smaller {smaller}, or another law"
        )
    rejected = f", and {summary['rejected_steps']} that were taken back" if summary.get("rejected_steps") else ""
    print_text(f"wall time: {summary['wall_time_s']:.3g} s for {summary['steps']} steps{rejected}")
    for name in ("estimates", "states", "summary", "figure", "video"):
        if name in files:
            typer.echo(f"{name}: {files[name]}")


def _print_outcomes(found: Mapping[str, float | None]) -> None:
    """Of an episode in which agents may collide."""
    text = (
        f"{'a collision' if found['collision'] else 'no collision'}, smallest distance {found['min_distance']:.4g} m; "
    )
    arrived = found["arrival_time"]
    text += "not all at their goals" if arrived is None else f"all at their goals, after {arrived:.3g} s in the mean"
    if found["intervention"] is not None:
        text += f"; inputs changed by {found['intervention']:.3g} m/s in the mean"
    if found["infeasible"]:
        text += f", a guarantee begun anew in {100.0 * found['infeasible']:.2g} % of agents and time"
    print_text(text)


def _number(value: float | None, unit: str = "") -> str:
    return "not finite" if value is None else f"{value:.4g} {unit}".strip()


def print_design(report: Mapping[str, Any]) -> None:
    """The design report as tables."""
    one_way = report["one_way_links"]
    edges = f"{report['edges']} {'link' if one_way else 'edge'}{'s' * (report['edges'] != 1)}"
    edges += f", {one_way} of them one way" if one_way else ""
    print_text(
        f"{report['scenario']}: {report['agents']} agents, {edges}, k = {report['k']}, "
        f"{'with' if report['relay'] else 'without'} relay, design rule {report['design_rule']}"
        f"{' (the paper rule needs links both ways)' if one_way and report['design_rule'] != 'paper' else ''}"
    )
    targets = report["targets"]
    if targets:
        shown, spectrum = targets[:SHOWN_TARGETS], "|lambda(M)|" if one_way else "lambda(M)"
        print_table(
            ("target", "k-hop set", "eta", spectrum, "bound / delta"),
            [_spectrum_row(target) for target in shown],
            "Observers, by the agent that they estimate, and their own bounds over delta",
            whole=("target", spectrum, "bound / delta"),
        )
        typer.echo()
        print_table(
            ("target", "of", "delta, theta", "rho, omega", "rate (1/s)", "start / funnel"),
            [row for target in shown for row in _funnel_rows(target)],
            "Bounds on errors and funnels on disagreements, at t = 0 -> infinity",
            whole=("target", "delta, theta", "rho, omega"),
        )
        if len(targets) > SHOWN_TARGETS:
            print_text(_all_targets(targets))
        bound = {kind: value for kind, value in report["explicit_step_bound_s"].items() if value is not None}
        values = ", ".join(f"{value:.3g} s ({kind} observers)" for kind, value in bound.items())
        print_text(f"explicit integrator: no step longer than {values} is stable; take a tenth of it or less")
    if report["plant_step_s"] is not None:
        print_text(
            f"plant: steps longer than {report['plant_step_s']:.3g} s are divided, since the drift of "
            f"{report['plant_agent']} takes no longer ones"
        )
    if report["assumptions"]:
        typer.echo()
        rows = [
            (each["number"], each["status"], f"{each['statement']}: {each['why']}") for each in report["assumptions"]
        ]
        print_table(("", "status", "assumption of the paper, and why"), rows, whole=("", "status"))
    for warning in report["warnings"]:
        print_text(f"warning: {warning}")
    if report["feasible"]:
        shares = [group["start_share"] for target in targets for kind in ("state", "input") for group in target[kind]]
        later = "; where |g| is unbounded, a run checks at its start that inputs begin inside" if None in shares else ""
        print_text(f"feasible: every condition of the observers that can be checked before the start holds{later}")
    else:
        print_text(f"not feasible: {report['error']}")


def _spectrum_row(target: Mapping[str, Any]) -> tuple[str, ...]:
    ids = target["k_hop"]
    members = ", ".join(ids[:_SHOWN_IDS]) + (f" and {len(ids) - _SHOWN_IDS} more" if len(ids) > _SHOWN_IDS else "")
    spectrum = f"{target['lambda_min']:.4g} .. {target['lambda_max']:.4g}"
    own = " .. ".join(f"{share:.3f}" for share in dict.fromkeys(target["own_bound"]))
    return target["agent"], members, str(target["eta"]), spectrum, own


def _funnel_rows(target: Mapping[str, Any]) -> Iterator[tuple[str, ...]]:
    who = target["agent"]
    for kind, bound, funnel in (("state", "delta", "rho"), ("input", "theta", "omega")):
        for group in target[kind]:
            share = group["start_share"]
            yield (
                who,
                f"{kind} {', '.join(group['components'])}",
                _span(group[bound]),
                _span(group[funnel]),
                "" if group[funnel]["rate"] is None else f"{group[funnel]['rate']:g}",
                "at reset" if share is None else f"{ratio_text(share)}{'' if share < 1.0 else ': no'}",
            )
            who = ""


def _span(function: Mapping[str, float | None]) -> str:
    return " -> ".join("?" if function[end] is None else f"{function[end]:.4g}" for end in ("initial", "final"))


def _all_targets(targets: Sequence[Mapping[str, Any]]) -> str:
    etas = [target["eta"] for target in targets]
    shares = [group["start_share"] for target in targets for kind in ("state", "input") for group in target[kind]]
    worst = ratio_text(max((share for share in shares if share is not None), default=0.0))
    worst += " (where |g| is bounded)" if None in shares else ""
    return (
        f"... and {len(targets) - SHOWN_TARGETS} more (--json has all). Over all {len(targets)}: eta {min(etas)} to "
        f"{max(etas)}, lambda_min from {min(target['lambda_min'] for target in targets):.4g}, lambda_max to "
        f"{max(target['lambda_max'] for target in targets):.4g}, start/funnel at most {worst}"
    )
