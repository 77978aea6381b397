"""The parts of `khop deploy`: what processes have to know, the table while they run, and what became of them."""

from __future__ import annotations

import math
import secrets
import sys
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import asdict
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from khop_env.brief import BOUND_REACHED, ratio_text
from khop_env.commands.common import networked
from khop_env.commands.episodes import Episode
from khop_env.terminal import print_text, say

if TYPE_CHECKING:
    from khop_env.deploy.collect import Collected
    from khop_env.deploy.setup import Setup
    from khop_env.deploy.supervisor import Kill, Supervisor, Watch
    from khop_env.observers import Networked
    from khop_env.scenarios import LawChoice, Scenario

MAKE_LAW = "agents.laws:make_law"
_CLOCKS = 1  # random numbers of clocks: a stream of their own


def over_network(scenario: Scenario, network: str | None, estimator: str | None) -> Networked:
    """The observers over a network: the option's, the scenario's, or one in which nothing is lost.

    Raises:
        ValueError: without messages, for an estimator that a robot's node doesn't have, or for links that come and go.
    """
    from typing import get_args

    from khop_env.observers.wire import EstimatorName

    chosen = network or ("ideal" if scenario.network is None else None)
    over = networked(scenario, chosen, estimator)
    if over is None:
        raise ValueError(f"--network {network}: processes know of each other by messages only; choose one, e.g. wifi")
    known = get_args(EstimatorName)
    if over.estimator.name not in known or not type(over.estimator).__module__.startswith("khop_env."):
        raise ValueError(
            f"estimator {over.estimator.name!r}: ObserverNode, which robots run, has {' and '.join(known)}"
        )
    if scenario.schedule is not None:
        raise ValueError(
            f"scenario {scenario.name!r} has links that come and go (schedule); khop deploy runs fixed graphs only"
        )
    return over


def steps_per_round(episode: Episode, period: float, dt: float | None) -> int:
    """Steps of the plant in a period.

    Raises:
        ValueError: for a step that doesn't divide the period, or is too long.
    """
    least = episode.simulator.parts_of(period)
    if dt is None:
        return int(least)
    parts = round(period / dt) if dt > 0.0 else 0
    if parts < least or abs(parts * dt - period) > 1e-9 * period:
        raise ValueError(
            f"--dt {dt:g}: the period of messages, {period:g} s, must be a whole number of steps, {least} or more; "
            f"take {period / least:.6g}, {period / (least + 1):.6g}, ..."
        )
    return parts


def kill_of(scenario: Scenario, text: str, duration: float) -> Kill:
    """A kill as it is written: AGENT@T or AGENT@T:RESTART_T.

    Raises:
        ValueError: for anything else, an unknown agent, or times that aren't in order or not within the run.
    """
    from khop_env.deploy.supervisor import Kill

    agent, at, times = text.rpartition("@")
    try:
        values = [float(value) for value in times.split(":")]
    except ValueError:
        values = []
    if not at or len(values) not in (1, 2):
        raise ValueError(f"--kill {text}: write AGENT@T or AGENT@T:RESTART_T, times in s, e.g. cart_2@3:5")
    if not all(math.isfinite(value) for value in values) or not 0.0 < values[0] <= values[-1] < duration:
        raise ValueError(f"--kill {text}: times must be in order, after 0 and before the end, {duration:g} s")
    number = scenario.fleet.agent(int(agent) if agent.isdecimal() else agent)
    return Kill(number, *values)


def left_out_of(scenario: Scenario) -> list[str]:
    """Disturbances that a process can't simulate, since they depend on the states of others; said on stderr, too."""
    from khop_env.deploy.robot import depends_on_others

    terms = () if scenario.disturbance is None else scenario.disturbance.terms
    found = [repr(term) for term in terms if depends_on_others(term, scenario.fleet)]
    for text in found:
        say(f"khop: {text} is left out: it depends on the states of all agents, and a process has its own only")
    return found


def simulated_part(
    name: str, scenario: Scenario, episode: Episode, law: LawChoice, steps: int, rounds: int
) -> dict[str, Any]:
    """What all setups have in common, the same as of the simulator that has been reset."""
    simulator, observers = episode.simulator, episode.observers
    estimator: Any = observers.estimator  # type: ignore[attr-defined]
    return {
        "scenario": name,
        "network": asdict(observers.network),  # type: ignore[attr-defined]
        "network_key": int(simulator.state.memory["channel.key"][0]),
        "estimator": estimator.name,
        "steps": steps,
        "last_step": rounds * steps,
        "law": MAKE_LAW,
        "law_name": law.name,
        "law_parameters": dict(law.parameters),
        "drawn": simulator.state.drawn[0].tolist(),
        "x": [simulator.x[0][scenario.fleet.state_slice(i)].tolist() for i in range(len(scenario.fleet))],
    }


def setups_of(
    scenario: Scenario,
    common: Mapping[str, Any],
    *,
    seed: int,
    skew: float,
    transport: str,
    records: Path,
    policies: Sequence[Mapping[str, Any]] | None = None,
) -> list[Setup]:
    """What each process has to know.

    Args:
        scenario: that is run.
        common: from `simulated_part`.
        seed: of the clocks.
        skew: their largest difference, in s.
        transport: between processes.
        records: folder.
        policies: by agent what its process has to know of a policy; None for a law.
    """
    from khop_env.deploy.setup import Setup

    agents = range(len(scenario.fleet))
    offsets = np.random.default_rng([seed, _CLOCKS]).uniform(0.0, skew, len(agents)).tolist()
    states = common["x"]
    of_run = {"run": secrets.token_hex(4), "key": secrets.token_hex(32), "folder": str(records.resolve())}
    return [
        Setup(
            **{**common, **of_run, "x": states[agent]},
            agent=agent,
            offset=offsets[agent],
            skew=skew,
            transport=transport,
            policy=None if policies is None else policies[agent],
        )
        for agent in agents
    ]


def run_all(supervisor: Supervisor) -> None:
    """Run all processes; an error after their first round is one of the run, whose results up to then are kept.

    Raises:
        OSError: if nothing is on record.
    """
    try:
        supervisor.run()
    except OSError as error:
        if not any(path.stat().st_size for path in supervisor.folder.glob("*.known")):
            raise
        if str(error) not in supervisor.errors:
            supervisor.errors.append(str(error))


def collected_of(
    supervisor: Supervisor, scenario: Scenario, over: Networked, setups: Sequence[Setup], lockstep: bool
) -> tuple[Collected, dict[str, Any]]:
    """All records as one recording, and measured values as JSON."""
    from khop_env.deploy.collect import collect, measured
    from khop_env.deploy.record import Columns, rows_of
    from khop_env.results.recording import StoppedError

    fleet, setup = scenario.fleet, setups[0]
    last = setup.last_step
    if supervisor.interrupted or (lockstep and supervisor.errors):
        on_record = []
        for agent in range(len(fleet)):
            width = Columns.of(scenario.design, agent).knowledge_width
            on_record.append(int(rows_of(supervisor.folder, fleet, agent, "known", width)[:, 0].max(initial=0.0)))
        last = min(last, max(on_record))
    errors = supervisor.errors or (["ended by Ctrl-C"] if supervisor.interrupted else [])
    collected = collect(
        scenario,
        supervisor.folder,
        over.network.drawn(setup.network_key),
        setup.estimator,
        steps=setup.steps,
        last_step=last,
        x0=np.concatenate([each.x for each in setups]),
        drawn=np.array(setup.drawn),
        exact=setup.skew > 0.0,
        killed=supervisor.killed,
        wall_time=supervisor.wall_time,
        error=StoppedError("; ".join(errors)) if errors else None,
    )
    return collected, measured(collected, supervisor.counts(), fleet.ids, over.network.period, lockstep)


@contextmanager
def live_table(scenario: Scenario, records: Path, period: float) -> Iterator[Watch | None]:
    """A table on stderr that is renewed twice a second; only on a terminal."""
    if not sys.stderr.isatty():
        yield None
        return
    from rich.console import Console
    from rich.live import Live as Screen

    from khop_env.deploy.live import Live

    live = Live(scenario, records, period)
    with Screen(console=Console(stderr=True), transient=True, auto_refresh=False) as screen:

        def watch(fraction: float, supervisor: Supervisor) -> None:
            screen.update(_table(fraction, supervisor, live, scenario), refresh=True)

        yield watch


def _table(fraction: float, supervisor: Supervisor, live: Any, scenario: Scenario) -> Any:
    from rich.box import SIMPLE_HEAD
    from rich.table import Table

    table = Table(title=f"{scenario.name}: {100.0 * fraction:.0f} % of {supervisor.duration:g} s", box=SIMPLE_HEAD)
    for header in ("agent", "period kept", "sent", "received", "lost", "refused", "error/bound", "age (s)"):
        table.add_column(header, justify="left" if header == "agent" else "right")
    now = live.read([process.setup.start for process in supervisor.processes])
    for process, each in zip(supervisor.processes, now, strict=True):
        counts, name = process.counts, scenario.fleet.ids[process.setup.agent]
        messages = [str(counts.get(key, 0)) for key in ("sent", "received", "lost")]
        table.add_row(
            f"{name} ({process.state})" if process.state else name,
            "" if math.isnan(each.period_kept) else f"{100.0 * each.period_kept:.1f} %",
            *messages,
            str(sum(counts.get("refused", {}).values())),
            "" if math.isnan(each.ratio) else ratio_text(each.ratio, BOUND_REACHED),
            "nothing yet" if math.isinf(each.age) else f"{each.age:.3f}",
        )
    return table


def print_deployed(found: Mapping[str, Any], period: float) -> None:
    """Periods, messages and CPU time in a few lines."""
    messages = found["messages"]
    refused = ", ".join(f"{count} {kind}" for kind, count in messages["refused"].items()) or "none"
    print_text(
        f"messages: {messages['sent']} sent, {messages['received']} received, of which the network lost "
        f"{messages['lost']}; refused: {refused}; {found['message_bytes']} bytes at most"
    )
    cpu = found["cpu_us_per_round"]
    used = "" if cpu is None else f"CPU time per agent and round {cpu:.0f} us"
    if found["period_kept"] is None:
        print_text(f"in lockstep, one process per agent; {used}")
        return
    late = found["lateness_ms"]
    began = "no round" if late is None else f"{late['median']:.2g} ms late (99 %: {late['p99']:.2g}, {late['max']:.3g})"
    print_text(
        f"{100.0 * found['period_kept']:.4g} % of the rounds ended within their {1e3 * period:g} ms, {found['missed']} "
        f"didn't take place; they began {began}; {used}"
    )
    for agent, each in found["agents"].items():
        if each["away_rounds"]:
            print_text(f"{agent} was away for {each['away_rounds']} rounds")
