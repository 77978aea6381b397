"""The paper's three-panel figure: trajectories, and estimates of one agent's state and input."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from khop_env.brief import ratio_text
from khop_env.observers import FloatArray
from khop_env.physics import hops_from_targets
from khop_env.results.metrics import ROUNDING
from khop_env.results.recording import Recording
from khop_env.results.records import MessageRecord, ObserverRecord
from khop_env.scenarios import Scenario

if TYPE_CHECKING:
    from matplotlib.axes import Axes

# M. Okabe and K. Ito, Color Universal Design, 2008: distinguishable for colour-blind readers; without yellow (too pale)
COLORS = ("#0072B2", "#E69F00", "#009E73", "#D55E00", "#CC79A7", "#56B4E9", "#000000", "#8C8C8C")
_ERROR, _DISAGREEMENT = COLORS[0], COLORS[3]
_PALE = 0.4
_BY_HOPS = (COLORS[2], COLORS[0], COLORS[3], *COLORS[4:])
_MOST_LABELS = 12  # agents with a colour each in panel (a)
_MOST_POINTS = 500_000  # plotted in panel (a)


def paper_figure(recording: Recording, scenario: Scenario, path: str | Path, agent: int | None = None) -> Path:
    """Draw a run in the layout of the paper's figure, and save it.

    (a) The agents' positions, from crosses (initial) to dots (final). (b) The largest |estimation error| and
    |disagreement| over all observers of one agent's state, with their bounds dashed. (c) The same for its input. Where
    the bounds differ between components, (b) and (c) show the component with the largest ratio of error to bound. Where
    links come and go the bound is the largest of the observers' own, and interrupted while an observer is cut off.

    Over a network of messages (b) shows the estimate of one observer, as many links away as there are, within its
    certified bound, and (c) the largest error of the agent's position and the largest certified bound, of all observers
    a number of links away.

    Args:
        recording: recording of the run.
        scenario: scenario of the run.
        path: path of the image file; its suffix sets the format.
        agent: index of the agent whose estimates are drawn in (b) and (c). By default the scenario's `figure_agent`, or
            the agent with most observers if that is None.

    Returns:
        The path.

    Raises:
        ValueError: if there is no agent with this index.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    target = _default_agent(recording, scenario) if agent is None else recording.fleet.agent(agent)
    name = recording.fleet.ids[target]
    with rc_context(STYLE), np.errstate(all="ignore"):  # of a diverged state the finite part is drawn
        figure = Figure(figsize=(13.0, 4.4), layout="constrained")
        left, middle, right = figure.subplots(1, 3)
        _draw_positions(left, recording)
        if isinstance(recording.states, MessageRecord):
            _draw_box(middle, recording, recording.states, target)
            _draw_bounds(right, recording, recording.states, target)
        else:
            assert recording.inputs is not None
            _draw_observers(middle, recording, recording.states, target, f"(b) Estimates of the state of {name}")
            _draw_observers(right, recording, recording.inputs, target, f"(c) Estimates of the input of {name}")
        figure.suptitle(_headline(recording, scenario), fontsize=10.5, color="#333333")
        figure.savefig(path, dpi=150)
    return Path(path)


STYLE: Any = {
    "font.size": 9.5,
    "axes.titlesize": 10.5,
    "axes.spines.top": False,
    "axes.spines.right": False,
    "axes.grid": True,
    "axes.axisbelow": True,
    "grid.color": "#E4E4E4",
    "grid.linewidth": 0.6,
    "lines.linewidth": 1.4,
    "legend.frameon": False,
}


def _default_agent(recording: Recording, scenario: Scenario) -> int:
    if scenario.figure_agent is not None:
        return scenario.figure_agent
    layout = recording.states.layout
    return int(layout.target[np.argmax(layout.arrays.observers)]) if len(layout.target) else 0


def _headline(recording: Recording, scenario: Scenario) -> str:
    extremes = recording.extremes
    if isinstance(recording.states, MessageRecord) and recording.error is None:
        largest, pairs = float(extremes.relative[0]), recording.states.layout.pairs
        kept = "inside all certified boxes" if largest <= 1.0 + ROUNDING else "a certified box was left"
        return (
            f"{scenario.name}: {kept}; largest |error| / bound = {ratio_text(largest, ROUNDING)} over all {pairs} pairs"
        )
    ratios = float(np.maximum(extremes.normalized, extremes.input_normalized)[0])  # nan if any is
    over = f"over all {recording.states.layout.pairs} pairs"
    if isinstance(recording.states, ObserverRecord) and recording.states.cut_off.any():
        over += ", while the target reaches the observer"
    if recording.error is not None:
        return f"{scenario.name}: stopped at t = {recording.time[-1]:.4g} s, {_reason(recording)}"
    kept = "inside all funnels" if ratios < 1.0 else "funnels left"
    return f"{scenario.name}: {kept}; largest |disagreement| / funnel = {ratio_text(ratios)} {over}"


def _reason(recording: Recording) -> str:
    return str(recording.error).split(":")[0]


def _draw_positions(axes: Axes, recording: Recording) -> None:
    fleet = recording.fleet
    planar = fleet.position_dim > 1
    thinning = max(1, recording.time.size * len(fleet) // _MOST_POINTS)
    chosen = np.unique(np.r_[0 : len(recording.time) : thinning, len(recording.time) - 1])
    positions = fleet.positions(recording.x[chosen])  # (T, N, d)
    times = np.broadcast_to(recording.time[chosen, None], positions.shape[:2])
    path = positions[:, :, :2] if planar else np.stack([times, positions[:, :, 0]], axis=-1)

    few = len(fleet) <= _MOST_LABELS
    types = list(dict.fromkeys(model.type for model in fleet.models))
    if few and len(types) == 1:
        groups = {fleet.ids[i].rpartition("_")[2]: [i] for i in range(len(fleet))}
        _label_starts(axes, path[0], list(groups))
    else:
        groups = {kind: [i for i, model in enumerate(fleet.models) if model.type == kind] for kind in types}
    for number, (label, members) in enumerate(groups.items()):
        style: Any = {"color": COLORS[number % len(COLORS)], "alpha": 1.0 if few else 0.5}
        # a single broken line for all members: separate lines take minutes in a large fleet
        broken = np.concatenate([path[:, members], np.full((1, len(members), 2), np.nan)]).swapaxes(0, 1).reshape(-1, 2)
        axes.plot(*broken.T, linewidth=1.2 if few else 0.5, label=label, **style)
        axes.plot(*path[0, members].T, "x", markersize=6 if few else 3.5, markeredgewidth=1.6 if few else 0.8, **style)
        axes.plot(*path[-1, members].T, "o", markersize=3.5 if few else 1.5, **style)
    dots = ", dots: final" if planar else ""
    note = " (seen from above)" if fleet.position_dim > 2 else ""
    axes.set_title(f"(a) Agents' positions{note}; crosses: initial{dots}", loc="left")
    if len(types) > 1:
        axes.legend(loc="best", fontsize=8.5)
    if planar:
        axes.set_xlabel(f"first coordinate ({fleet.position_unit(0)})")
        axes.set_ylabel(f"second coordinate ({fleet.position_unit(1)})")
        axes.set_aspect("equal", adjustable="datalim")
    else:
        axes.set_xlabel("time (s)")
        axes.set_ylabel(f"position ({fleet.position_unit(0)})")


def _label_starts(axes: Axes, starts: FloatArray, labels: list[str]) -> None:
    """Write the agents' indices beside their crosses, on the side away from the centre."""
    from matplotlib.patheffects import withStroke

    outwards = starts - starts.mean(axis=0)
    outwards /= np.maximum(np.linalg.norm(outwards, axis=-1, keepdims=True), 1e-9)
    for number, (label, start, away) in enumerate(zip(labels, starts, 9.0 * outwards, strict=True)):
        text = axes.annotate(
            label,
            tuple(start),
            tuple(away),
            textcoords="offset points",
            color=COLORS[number % len(COLORS)],
            fontsize=8.5,
            ha="center",
            va="center",
        )
        text.set_path_effects([withStroke(linewidth=2.5, foreground="white")])


def _draw_observers(axes: Axes, recording: Recording, kind: ObserverRecord, agent: int, title: str) -> None:
    axes.set_title(title, loc="left")
    layout = kind.funnels.layout
    block = next((block for block in layout.blocks if block.agent == agent), None)
    if block is None:
        _explain_absence(axes, recording, agent)
        return
    columns, rows = block.columns, block.rows
    shape = len(kind.time), block.observers, block.components
    truth = kind.truth[:, layout.column_source[columns]]
    error = np.abs(kind.estimate[:, columns] - truth).reshape(shape).max(axis=1)
    disagreement = np.abs(kind.disagreement[:, columns]).reshape(shape).max(axis=1)
    rho = kind.funnels.rho.evaluate(kind.time, np.empty((layout.rows, len(kind.time))))[rows].T
    delta = kind.funnels.delta.evaluate(kind.time, np.empty((layout.rows, len(kind.time))))[rows].T
    if kind.up is not None:
        delta = kind.bound[:, columns].reshape(shape).max(axis=1)

    names, units = (list(each) for each in zip(*recording.fleet.models[agent].states.items(), strict=True))
    if np.all(delta == delta[:, :1]):
        text, error, disagreement = "max over observers, components", error.max(axis=1), disagreement.max(axis=1)
        rho, delta = rho[:, 0], delta[:, 0]
    else:
        worst = int(np.argmax((error / delta).max(axis=0)))  # nan counts as the largest
        text = f"{names[worst]}: max over observers"
        units = [units[worst]]
        error, disagreement, rho, delta = (values[:, worst] for values in (error, disagreement, rho, delta))
    letters = (r"\delta", r"\rho") if kind is recording.states else (r"\theta", r"\omega")
    of_error = f"its bound ${letters[0]}(t)$" if kind.up is None else "its bound, if any"
    for values, bound, color, width, label, of_bound in (
        (error, delta, _ERROR, 2.0, "|error|", of_error),  # wider: the two often coincide
        (disagreement, rho, _DISAGREEMENT, 1.2, "|disagreement|", f"its bound ${letters[1]}(t)$"),
    ):
        axes.plot(kind.time, np.where(values > 0.0, values, np.nan), color=color, linewidth=width, label=f"max {label}")
        axes.plot(
            kind.time, np.where(bound < np.inf, bound, np.nan), color=color, linestyle=(0, (5, 2)), label=of_bound
        )
    axes.set_yscale("log")
    low, high = _lowest(error, disagreement, rho), float(delta.max())
    if kind.up is not None:
        highest = np.concatenate([delta, error, rho])
        high = float(highest[np.isfinite(highest)].max())
    axes.set_ylim(low, high * (high / low) ** 0.2)  # room for the legend
    axes.set_xlim(0.0, float(kind.time[-1]) or 1.0)
    axes.set_xlabel("time (s)")
    if kind is recording.inputs:
        units = [f"{unit}/s".replace("/s/s", "/s$^2$") for unit in units]
    units = list(dict.fromkeys(units))
    axes.set_ylabel(f"{text} ({', '.join(units) if len(units) < 3 else 'SI units'})")
    axes.legend(loc="upper right", ncols=2, fontsize=8.5, handlelength=2.4, columnspacing=1.2)


def _distances(recording: Recording, record: MessageRecord, agent: int) -> dict[int, int]:
    """Links from an agent to each of those that estimate it, by observer."""
    hops = hops_from_targets(recording.design.communication, recording.design.k)
    return {a: hops[a][i] for a, i in record.layout.slot if i == agent}


def _draw_box(axes: Axes, recording: Recording, record: MessageRecord, agent: int) -> None:
    """One coordinate of an agent's position as the farthest observer estimates it, within its certified bound."""
    distances, fleet = _distances(recording, record, agent), recording.fleet
    if not distances:
        _explain_absence(axes, recording, agent)
        return
    observer = max(distances, key=lambda a: (distances[a], -a))
    component = int(fleet.models[agent].position_index[0])
    column = record.layout.slot[observer, agent] + component
    truth, estimate, bound = (
        values[:, column] for values in (record.truth_per_estimate, record.estimate, record.bound)
    )
    links = f"{distances[observer]} link{'s' if distances[observer] > 1 else ''} away"
    axes.set_title(f"(b) {fleet.ids[agent]} as {fleet.ids[observer]} estimates it, {links}", loc="left")
    band = estimate - bound, estimate + bound
    axes.fill_between(record.time, *band, color=_ERROR, alpha=0.18, linewidth=0, label="certified")
    axes.plot(record.time, estimate, color=_ERROR, label="estimate")
    axes.plot(record.time, truth, color="black", linewidth=1.0, linestyle=(0, (4, 2)), label="true")
    axes.set_xlim(0.0, float(record.time[-1]) or 1.0)
    axes.set_xlabel("time (s)")
    name, unit = list(fleet.models[agent].states.items())[component]
    axes.set_ylabel(f"{name} ({unit})")
    axes.legend(loc="upper right", ncols=3, fontsize=8.5)


def _draw_bounds(axes: Axes, recording: Recording, record: MessageRecord, agent: int) -> None:
    """The largest error and the largest certified bound of an agent's position, by distance of the observers."""
    distances, fleet = _distances(recording, record, agent), recording.fleet
    axes.set_title(f"(c) Estimates of the position of {fleet.ids[agent]}", loc="left")
    if not distances:
        axes.set_axis_off()
        return
    axes.set_yscale("log")
    for color, hops in zip(_BY_HOPS, sorted(set(distances.values())), strict=False):
        columns = [
            record.layout.slot[a, agent] + c
            for a, distance in distances.items()
            if distance == hops
            for c in fleet.models[agent].position_index
        ]
        links = f"{hops} link{'s' if hops > 1 else ''}"
        error, bound = np.abs(record.error[:, columns]).max(axis=1), record.bound[:, columns].max(axis=1)
        drawn = np.where((bound > 0.0) & (bound < np.inf), bound, np.nan)  # a gap where it is 0: the axis has none
        axes.plot(record.time, drawn, color=color, alpha=_PALE)  # pale: dashes get lost in teeth of single messages
        axes.plot(record.time, np.where(error > 0.0, error, np.nan), color=color, linewidth=1.0, label=links)
    axes.plot([], [], color="#333333", label="largest |error|")
    axes.plot([], [], color="#333333", alpha=_PALE, label="largest bound")
    low, high = axes.get_ylim()
    axes.set_ylim(max(low, 1e-6 * high), high * (high / max(low, 1e-6 * high)) ** 0.2)  # room for the legend
    axes.set_xlim(0.0, float(record.time[-1]) or 1.0)
    axes.set_xlabel("time (s)")
    axes.set_ylabel(f"max over observers, coordinates ({fleet.position_unit()})")
    axes.legend(loc="upper right", ncols=2, fontsize=8.5)


def _lowest(error: FloatArray, disagreement: FloatArray, rho: FloatArray) -> float:
    """Lower end of the logarithmic axis, so that short dips and rounding errors don't stretch it over many decades."""
    values = np.concatenate([error, disagreement])
    values = values[(values > 0.0) & np.isfinite(values)]
    floor = 1e-6 * float(rho.min())
    return max(floor, float(np.quantile(values, 0.02)) / 3.0) if values.size else floor


def _explain_absence(axes: Axes, recording: Recording, agent: int) -> None:
    """Write the reason into an empty panel."""
    name, model = recording.fleet.ids[agent], recording.fleet.models[agent]
    if not recording.design.neighborhoods[agent]:
        why = f"No agent estimates {name}:\nall others are its neighbours, or more than k hops away."
    elif model.input_map_uses_state:
        why = f"{name} has no input observer:\nits input map g(x, u) depends on its state."
    else:
        why = f"{name} has no input observer:\nits input is treated as a bounded disturbance."
    axes.text(0.5, 0.5, why, ha="center", va="center", transform=axes.transAxes, color="#555555")
    axes.set_axis_off()
