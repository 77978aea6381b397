"""From the records of all processes to one recording, as a simulator's run has it, by their common clock."""

from __future__ import annotations

import math
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from khop_env.deploy.record import Columns, rows_of
from khop_env.deploy.robot import Robot, grid_time
from khop_env.network import Network
from khop_env.observers import Extremes, FloatArray, IntArray
from khop_env.observers.merging import largest_share
from khop_env.results import MessageRecord, Recording
from khop_env.results.metrics import violations
from khop_env.results.recording import MOST_ROWS, Failure
from khop_env.scenarios import Scenario

_SAMPLES = 100.0  # per s


@dataclass(frozen=True)
class Rounds:
    """When one agent's rounds took place.

    Attributes:
        began: (R,) time from when a round was due until it began, in s; nan for one that didn't take place.
        ended: (R,) likewise until it ended.
        cpu: (R,) CPU time, in s.
        away: (R,) whether the agent had no process then.
    """

    began: FloatArray
    ended: FloatArray
    cpu: FloatArray
    away: np.ndarray


@dataclass(frozen=True)
class Collected:
    """What became of a run.

    Attributes:
        recording: its samples.
        violations: errors above their certified bounds by more than rounding, over all steps.
        pair_steps: pairs and steps that were looked at.
        rounds: by agent.
        x: (steps + 1, n) true states after every step, of which the recording has some.
        u: (steps + 1, m) inputs in force from then on.
    """

    recording: Recording
    violations: int
    pair_steps: int
    rounds: list[Rounds]
    x: FloatArray
    u: FloatArray


def collect(
    scenario: Scenario,
    folder: Path,
    network: Network,
    estimator: str,
    *,
    steps: int,
    last_step: int,
    x0: FloatArray,
    drawn: FloatArray,
    exact: bool,
    killed: list[list[float]],
    wall_time: float,
    error: Failure | None,
) -> Collected:
    """Read all records, and compare all estimates with the true states of the same time.

    While an agent has no process, or rounds are missed, its last estimates stay, without a bound (inf), and their age
    grows. The plant of an agent that has ended moves on with its input at 0.

    Args:
        scenario: that was run.
        folder: of the records.
        network: over which messages went, as drawn.
        estimator: its name.
        steps: of the plant per round.
        last_step: with which the run ended.
        x0: (n,) initial states.
        drawn: (draws,) random numbers of the disturbance.
        exact: as for `Robot`.
        killed: by agent the times, in s, at which its process was gone; it is away until the next round on record.
        wall_time: of the run, in s.
        error: what ended it early, or None.
    """
    design, fleet, layout = scenario.design, scenario.fleet, scenario.design.knowledge
    h, count = network.period / steps, last_step + 1
    x, u = np.full((count, fleet.n), math.nan), np.zeros((count, fleet.m))
    estimate = np.repeat(scenario.initial.center[layout.column_source][None], count, axis=0)
    bound, age = np.full((count, layout.size), math.inf), np.full((count, layout.pairs), math.inf)
    newest = np.full((count, len(design.links)), -1.0)
    time = np.array([grid_time(step, h) for step in range(count)])
    rounds = []
    for agent in range(len(fleet)):
        columns = Columns.of(design, agent)
        own, acting = fleet.state_slice(agent), fleet.input_slice(agent)
        states = rows_of(folder, fleet, agent, "states", columns.state_width)
        states = states[states[:, 0] <= last_step]
        at = states[:, 0].astype(int)
        x[at, own] = states[:, 1 : 1 + columns.n]
        u[np.maximum(at - 1, 0), acting] = states[:, 1 + columns.n :]
        last = int(at.max(initial=-1))
        robot = Robot(fleet, agent, h, x0[own] if last < 0 else x[last, own], scenario.disturbance, drawn, exact)
        robot.step = max(last, 0)
        x[robot.step, own] = robot.x
        while robot.step < last_step:
            robot.advance()
            x[robot.step, own], u[robot.step - 1, acting] = robot.x, 0.0
        known = rows_of(folder, fleet, agent, "known", columns.knowledge_width)
        known = known[known[:, 0] <= last_step]
        rounds.append(_rounds(known, steps, last_step, network.period, killed[agent]))
        if not len(known):
            continue
        at = known[:, 0].astype(int)
        row = np.full(count, -1)
        row[at] = np.arange(len(at))
        fresh = row >= 0
        row = np.maximum.accumulate(row)
        since, held = row >= 0, known[row]
        u[at, acting] = known[:, 4 : 4 + columns.m]
        first = 4 + columns.m
        for sender in columns.senders:
            newest[since, design.links.index[sender, agent]] = held[since, first]
            first += 1
        for target, n in columns.targets.items():
            start = layout.slot[agent, target]
            place, pair = slice(start, start + n), layout.column_pair[start]
            age[since, pair] = (held[:, first] + time - time[np.maximum(at[row], 0)])[since]
            estimate[since, place] = held[since, first + 1 : first + 1 + n]
            bound[fresh, place] = held[fresh, first + 1 + n : first + 1 + 2 * n]
            first += 1 + 2 * n
    return _collected(
        scenario, network, estimator, (time, x, u, estimate, bound, age, newest), steps, wall_time, error, rounds
    )


def _rounds(known: FloatArray, steps: int, last_step: int, period: float, killed: list[float]) -> Rounds:
    count = last_step // steps + 1
    found = np.full((3, count), math.nan)
    ends = known[known[:, 0] % steps == 0]
    found[:, (ends[:, 0] / steps).astype(int)] = ends[:, 1:4].T
    away, due = np.zeros(count, bool), np.arange(count) * period
    for time in killed:
        back = np.flatnonzero((due > time) & ~np.isnan(found[0]))
        away |= (due > time - period) & (np.arange(count) < (back[0] if back.size else count))
    began, ended, cpu = found
    return Rounds(began, ended, cpu, away & np.isnan(began))


def _collected(
    scenario: Scenario,
    network: Network,
    estimator: str,
    arrays: tuple[FloatArray, ...],
    steps: int,
    wall_time: float,
    error: Failure | None,
    rounds: list[Rounds],
) -> Collected:
    time, x, u, estimate, bound, age, newest = arrays
    layout, count = scenario.design.knowledge, len(time)
    largest = np.zeros(count)
    largest_share(layout.column_source, estimate.T, x.T, bound.T, largest, 0, len(x))
    wrong = violations(np.abs(estimate - x[:, layout.column_source]).T, bound.T, x.T, layout)
    h = float(time[1] - time[0]) if count > 1 else network.period
    most = max(2, MOST_ROWS // max(1, layout.size))
    stride = max(1, math.ceil(1.0 / (h * _SAMPLES) - 1e-9), math.ceil((count - 1) / (most - 1)))
    chosen: IntArray = np.unique(np.append(np.arange(0, count, stride), count - 1))
    missed = np.maximum((np.arange(count) // steps)[:, None] - newest - network.most_rounds_late, 0.0)
    missed[newest < 0] = math.inf
    nothing = np.zeros(1)
    record = MessageRecord(
        layout=layout,
        time=time[chosen],
        truth=x[chosen],
        estimate=estimate[chosen],
        bound=bound[chosen],
        age=age[chosen],
        missed=missed[chosen],
        network=network,
        estimator=estimator,
    )
    recording = Recording(
        design=scenario.design,
        x=x[chosen],
        u=u[chosen],
        states=record,
        inputs=None,
        extremes=Extremes(nothing, np.array([largest.max()]), nothing, nothing),
        steps=count - 1,
        wall_time=wall_time,
        error=error,
    )
    return Collected(recording, wrong, layout.pairs * count, rounds, x, u)


def measured(
    collected: Collected, counts: list[dict[str, Any]], ids: tuple[str, ...], period: float, lockstep: bool
) -> dict[str, Any]:
    """Periods, messages and CPU time of a run, as plain JSON.

    Args:
        collected: the run.
        counts: by agent what `Agent.counts` returned last.
        ids: of the agents.
        period: of rounds, in s.
        lockstep: whether rounds waited for each other; then there are no periods.

    Returns:
        cpu_us_per_round: mean over agents and rounds; in lockstep of all steps of a round.
        message_bytes: of the longest message, envelope included.
        messages: sent (one for each receiver), received, lost (by the simulated network), and refused, by kind.
        period_kept: share of the rounds that ended before the next was due, of those of agents that had a process;
            missed: how many didn't take place. lateness_ms: from when rounds were due until they began, median, 99 %
            and largest. These are null in lockstep.
        agents: the same by id, without lateness.
    """
    agents = {}
    for agent_id, rounds, count in zip(ids, collected.rounds, counts, strict=True):
        kept, missed = _kept(rounds, period)
        agents[agent_id] = {
            "cpu_us_per_round": _microseconds(rounds.cpu),
            "message_bytes": count.get("message_bytes", 0),
            "messages": {
                **{name: count.get(name, 0) for name in ("sent", "received", "lost")},
                "refused": count.get("refused", {}),
            },
            "period_kept": None if lockstep else kept,
            "missed": None if lockstep else missed,
            "away_rounds": int(rounds.away.sum()),
        }
    refused: dict[str, int] = {}
    for each in agents.values():
        for kind, number in each["messages"]["refused"].items():
            refused[kind] = refused.get(kind, 0) + number
    everything = Rounds(*(np.concatenate([getattr(each, name) for each in collected.rounds]) for name in _FIELDS))
    kept, missed = _kept(everything, period)
    began = 1e3 * everything.began[~np.isnan(everything.began)]
    late = None
    if not lockstep and began.size:
        late = {"median": float(np.median(began)), "p99": float(np.quantile(began, 0.99)), "max": float(began.max())}
    return {
        "cpu_us_per_round": _microseconds(everything.cpu),
        "message_bytes": max((each["message_bytes"] for each in agents.values()), default=0),
        "messages": {
            **{name: sum(each["messages"][name] for each in agents.values()) for name in ("sent", "received", "lost")},
            "refused": refused,
        },
        "period_kept": None if lockstep else kept,
        "missed": None if lockstep else missed,
        "lateness_ms": late,
        "agents": agents,
    }


_FIELDS = ("began", "ended", "cpu", "away")


def _kept(rounds: Rounds, period: float) -> tuple[float | None, int]:
    """Share of rounds that ended within their period, and how many didn't take place."""
    present = ~rounds.away
    if not present.any():
        return None, 0
    with np.errstate(invalid="ignore"):
        return float((rounds.ended[present] <= period).mean()), int(np.isnan(rounds.ended[present]).sum())


def _microseconds(cpu: FloatArray) -> float | None:
    found = cpu[~np.isnan(cpu)][1:]  # the first round tabulates what later ones look up
    return round(1e6 * float(found.mean()), 1) if found.size else None
