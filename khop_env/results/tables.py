"""Recordings as tidy tables: one row per observation, one column per variable."""

from __future__ import annotations

from collections.abc import Sequence
from typing import TYPE_CHECKING, Any

import numpy as np

from khop_env.results.recording import Recording
from khop_env.results.records import MessageRecord, ObserverRecord

if TYPE_CHECKING:
    import polars as pl

QUANTITIES = ("state", "input")


def estimates_table(recording: Recording) -> pl.DataFrame:
    """Estimates of all observers: one row per (quantity, time, target, observer, component).

    Columns:
        quantity: "state" for x_i and the state observers, "input" for g_i and the input observers.
        time: time in s.
        target: id of the estimated agent.
        observer: id of the estimating agent.
        component: name of the state component; components of g_i have the names of those of x_i.
        state: the true value, of x_i or of g_i(x_i, u_i).
        estimate: the observer's estimate.
        error: estimate - state.
        disagreement: xi, or mu for inputs.
        rho: the funnel of the disagreement; omega for inputs.
        delta: the bound on the estimation error that was designed for; theta for inputs.
        bound: this observer's own guaranteed bound on the error, at most delta (theta) while all links are up; inf
            while the target doesn't reach it.

    Over a network of messages there are estimates of states only, of neighbours as well; disagreement, rho and delta
    are null, since they guarantee nothing there, bound is the certified one (inf where nothing is certified), and there
    is one column more, age: time since the newest state that has arrived was measured, in s; inf where none has.
    """
    import polars as pl

    kinds = zip(QUANTITIES, (recording.states, recording.inputs), strict=True)
    return pl.concat([_estimates(recording, quantity, kind) for quantity, kind in kinds if kind is not None])


def states_table(recording: Recording) -> pl.DataFrame:
    """Trajectories of all agents: one row per (time, agent, component), state components first, then inputs.

    Columns:
        time: time in s.
        agent: id of the agent.
        component: name of the state or of the input.
        x: value of the state; null in rows of inputs.
        u: value of the input; null in rows of states.
    """
    import polars as pl

    fleet = recording.fleet
    states, inputs = fleet.component_names(), fleet.input_names()
    components = _distinct([name for _, name, _ in (*states, *inputs)])
    parts = []
    for column, other, values, names in (("x", "u", recording.x, states), ("u", "x", recording.u, inputs)):
        frame = pl.DataFrame(
            {
                "time": np.repeat(recording.time, len(names)),
                "agent": _labels([agent for agent, _, _ in names], fleet.ids, len(values)),
                "component": _labels([name for _, name, _ in names], components, len(values)),
                column: values.ravel(),
            }
        )
        frame = frame.with_columns(pl.lit(None, pl.Float64).alias(other))
        parts.append(frame.select("time", "agent", "component", "x", "u"))
    return pl.concat(parts)


def _estimates(recording: Recording, quantity: str, kind: ObserverRecord | MessageRecord) -> pl.DataFrame:
    import polars as pl

    fleet, layout, samples = recording.fleet, kind.layout, len(kind.time)
    names = fleet.component_names()
    components = _distinct([name for _, name, _ in names])
    source = layout.column_source
    columns = {
        "quantity": _labels([quantity], QUANTITIES, samples * layout.size),
        "time": np.repeat(kind.time, layout.size),
        "target": _labels([names[c][0] for c in source], fleet.ids, samples),
        "observer": _labels([fleet.ids[a] for a in layout.observer[layout.column_pair]], fleet.ids, samples),
        "component": _labels([names[c][1] for c in source], components, samples),
        "state": kind.truth_per_estimate.ravel(),
        "estimate": kind.estimate.ravel(),
        "error": kind.error.ravel(),
    }
    if isinstance(kind, MessageRecord):
        nothing = {name: pl.lit(None, pl.Float64) for name in ("disagreement", "rho", "delta")}
        known = {"bound": kind.bound.ravel(), "age": kind.age[:, layout.column_pair].ravel()}
        return pl.DataFrame(columns).with_columns(**nothing).with_columns(**known)
    widths = {"rho": kind.rho.ravel(), "delta": kind.delta.ravel(), "bound": kind.bound.ravel()}
    return pl.DataFrame({**columns, "disagreement": kind.disagreement.ravel(), **widths})


def _labels(values: Sequence[str], categories: Sequence[str], times: int) -> Any:
    """`values`, repeated, as an enumeration: a few bytes per row instead of a string."""
    import polars as pl

    once = pl.Series(values, dtype=pl.Enum(list(categories)))
    return once.gather(np.tile(np.arange(len(once), dtype=np.uint32), times))


def _distinct(names: Sequence[str]) -> list[str]:
    return list(dict.fromkeys(names))
