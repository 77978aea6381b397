"""Figures of many episodes: median and spread over time, ultimate distances over bounds, learning curves."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from khop_env.observers import FloatArray
from khop_env.results.figures import COLORS, STYLE

if TYPE_CHECKING:
    from khop_env.results.networks import NetworkRow

_DASHES: tuple[Any, ...] = ("-", (0, (5, 2)), (0, (1.5, 1.5)))


def error_over_time(
    time: FloatArray, errors: Mapping[tuple[str, str], FloatArray], path: str | Path, title: str, unit: str = "m"
) -> Path:
    """Task error over time per row: the median over episodes, and the band that holds the middle half.

    Args:
        time: (T,) in s.
        errors: (T, E) in `unit` by (policy, observation mode): policies differ in colour and modes in dashes; the
            modes of a single policy in both.
        path: path of the image file.
        title: title of the figure.
        unit: unit of the task error.

    Returns:
        The path.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    policies = list(dict.fromkeys(policy for policy, _ in errors))
    modes = list(dict.fromkeys(mode for _, mode in errors))
    with rc_context(STYLE):
        figure = Figure(figsize=(8.4, 4.6), layout="constrained")
        axes = figure.subplots()
        for (policy, mode), values in errors.items():
            number = policies.index(policy) if len(policies) > 1 else modes.index(mode)
            color, dashes = COLORS[number % len(COLORS)], _DASHES[modes.index(mode) % len(_DASHES)]
            low, middle, high = np.quantile(values, (0.25, 0.5, 0.75), axis=1)
            axes.plot(time, middle, color=color, linestyle=dashes)
            axes.fill_between(time, low, high, color=color, alpha=0.12, linewidth=0.0)
        axes.set_yscale("log")
        axes.set_xlim(0.0, float(time[-1]))
        axes.set_xlabel("time (s)")
        axes.set_ylabel(f"task error, mean over agents ({unit})")
        figure.suptitle(title, fontsize=10.5, color="#333333")
        # one legend entry per colour and per line style; curves may coincide, e.g. of policies that ignore observations
        entries = [
            Line2D([], [], color=COLORS[number % len(COLORS)], label=policy)
            for number, policy in enumerate(policies)
            if len(policies) > 1
        ]
        for number, mode in enumerate(modes):
            color = "#333333" if entries else COLORS[number % len(COLORS)]
            name = f"on {mode}" if len(policies) > 1 else f"{policies[0]} on {mode}"
            entries.append(Line2D([], [], color=color, linestyle=_DASHES[number % len(_DASHES)], label=name))
        figure.legend(handles=entries, loc="outside right center", fontsize=8.5, handlelength=3.0)
        figure.savefig(path, dpi=150)
    return Path(path)


def set_iss_figure(
    injected: Sequence[Mapping[str, Any]],
    swept: Sequence[Mapping[str, Any]],
    path: str | Path,
    title: str,
    unit: str = "m",
) -> Path:
    """Theorem 4 in two panels: ultimate distance to the goal set against errors, and against delta(inf).

    Args:
        injected: rows of `agents.set_iss.injected_errors`.
        swept: rows of `agents.set_iss.swept_bounds`.
        path: path of the image file.
        title: title of the figure.
        unit: unit of positions.

    Returns:
        The path.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure

    with rc_context(STYLE):
        figure = Figure(figsize=(11.0, 4.6), layout="constrained")
        left, right = figure.subplots(1, 2)
        patterns = list(dict.fromkeys(row["pattern"] for row in injected))
        for color, pattern, marker in zip(COLORS, patterns, "osD", strict=False):
            rows = [row for row in injected if row["pattern"] == pattern]
            points = [row["error"] for row in rows], [row["distance"] for row in rows]
            left.plot(*points, color=color, marker=marker, markersize=5, label=f"{pattern} errors")
        bound = {row["error"]: row["bound"] for row in injected if row["bound"] is not None}
        if bound:
            left.plot(
                [*bound], [*bound.values()], color="black", linestyle=(0, (5, 2)), label=r"analytical gain $\gamma$"
            )
        left.set_title("(a) Injected errors, no disturbance", loc="left")
        left.set_xlabel(f"norm of the errors in the law's arguments ({unit})")
        left.set_ylabel(f"ultimate distance to the goal set ({unit})")
        for color, (observers, disturbed), marker in zip(
            (*COLORS[:3], COLORS[4]),
            dict.fromkeys((row["observers"], row["disturbed"]) for row in swept),
            "osD^",
            strict=False,
        ):
            rows = [row for row in swept if (row["observers"], row["disturbed"]) == (observers, disturbed)]
            quantity = "excess" if disturbed else "distance"
            points = (
                [row["delta"] for row in rows if row[quantity] > 0.0],
                [row[quantity] for row in rows if row[quantity] > 0.0],
            )
            calm = "with" if disturbed else "no"
            label = f"{quantity}, observers {observers}, {calm} disturbance"
            right.plot(*points, color=color, marker=marker, markersize=5, label=label)
        floors = [row["floor"] for row in swept if row["disturbed"]]
        if floors:
            right.axhline(
                float(np.mean(floors)), color=COLORS[3], linestyle=(0, (1.5, 1.5)), label="floor of the oracle"
            )
        right.set_title(r"(b) Estimates, with the bound's final value $\delta(\infty)$ swept", loc="left")
        right.set_xlabel(rf"$\delta(\infty)$ ({unit})")
        right.set_ylabel(f"ultimate distance, or its excess over the oracle's ({unit})")
        for axes in (left, right):
            axes.set_xscale("log")
            axes.set_yscale("log")
            low, high = axes.get_ylim()
            axes.set_ylim(low, high * (high / low) ** 0.3)  # room for the legend
            axes.legend(loc="upper left", fontsize=8.5)
        figure.suptitle(title, fontsize=10.5, color="#333333")
        figure.savefig(path, dpi=150)
    return Path(path)


def network_figure(
    by_period: Sequence[NetworkRow],
    by_loss: Sequence[NetworkRow],
    continuous: NetworkRow,
    path: str | Path,
    title: str,
    unit: str = "m",
) -> Path:
    """Errors and certified bounds in two panels: against the period of messages, and against their loss.

    Args:
        by_period: rows of `measure_networks` that differ in estimator and period.
        by_loss: rows that differ in estimator and loss.
        continuous: the row of continuous exchange.
        path: path of the image file.
        title: title of the figure.
        unit: unit of positions.

    Returns:
        The path.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    with rc_context(STYLE):
        figure = Figure(figsize=(11.0, 4.8), layout="constrained")
        panels = figure.subplots(1, 2, sharey=True)
        estimators = list(dict.fromkeys(row.estimator for row in by_period))
        colors = dict(zip(estimators, (COLORS[3], COLORS[0], *COLORS[1:3]), strict=False))
        for axes, rows, key in zip(panels, (by_period, by_loss), ("period", "loss"), strict=True):
            for estimator in estimators:
                chosen = [row for row in rows if row.estimator == estimator]
                at = [getattr(row, key) for row in chosen]
                for quantity, style in _NETWORK_LINES.items():
                    values = [np.nan if (y := getattr(row, quantity)) is None else y for row in chosen]
                    axes.plot(at, np.where(np.array(values) > 0.0, values, np.nan), color=colors[estimator], **style)
            limits = [(row.mean_bound or np.nan) / (row.bound_to_limit or np.nan) for row in rows]
            spots = [getattr(row, key) for row in rows]
            axes.plot(spots[:: len(estimators)], limits[:: len(estimators)], color="#BBBBBB", linewidth=4.0, zorder=1)
            if continuous.mean_error:
                axes.axhline(continuous.mean_error, color="#777777", linestyle=(0, (1.5, 1.5)))
            axes.set_xscale("log")
            axes.set_yscale("log")
        panels[0].set_title("(a) against the period of messages", loc="left")
        panels[0].set_xlabel("period (s)")
        panels[0].set_ylabel(f"error of estimated positions, and its bound ({unit})")
        panels[1].set_title("(b) against their loss", loc="left")
        panels[1].set_xlabel("share of lost messages")
        panels[0].yaxis.set_tick_params(labelleft=True)
        entries = [Line2D([], [], color=color, label=name) for name, color in colors.items()]
        largest = _largest_error([*by_period, *by_loss])
        names = {"mean_bound": "mean certified bound", "max_error": largest, "mean_error": "mean error"}
        entries += [Line2D([], [], color="#333333", label=name, **_NETWORK_LINES[key]) for key, name in names.items()]
        entries += [
            Line2D([], [], color="#BBBBBB", linewidth=4.0, label="information limit"),
            Line2D([], [], color="#777777", linestyle=(0, (1.5, 1.5)), label="continuous exchange,\nmean error"),
        ]
        figure.legend(handles=entries, loc="outside right center", fontsize=8.5, handlelength=3.0)
        figure.suptitle(title, fontsize=10.5, color="#333333")
        figure.savefig(path, dpi=150)
    return Path(path)


def _largest_error(rows: Sequence[NetworkRow]) -> str:
    """Its entry in a legend, beside mean bounds: an error above the mean bound needn't be above its own."""
    violations = sum(row.violations for row in rows)
    if violations:
        return f"largest error ({violations} errors\nare above their own bounds)"
    if all(row.mean_bound is None for row in rows):
        return "largest error"
    return "largest error (no error is\nabove its own bound, which\nmay be above the mean)"


_NETWORK_LINES: dict[str, dict[str, Any]] = {
    "mean_bound": {"linestyle": (0, (5, 2)), "marker": "s", "markersize": 4},
    "max_error": {"linestyle": (0, (1.5, 1.5)), "marker": "^", "markersize": 4},
    "mean_error": {"linestyle": "-", "marker": "o", "markersize": 4},
}


def learning_curves(curves: Mapping[str, Mapping[str, tuple[FloatArray, FloatArray]]], path: str | Path) -> Path:
    """Learning curves, a panel per task: the median over training seeds, and the band between the extremes.

    Of five seeds this band is a 94 % interval of the median (1 - 2 / 2^5, the interval of the sign test). Costs are on
    a logarithmic axis; where a return is positive, returns are on a linear one.

    Args:
        curves: by title and name, the agent-steps (T,) and the mean returns (seeds, T).
        path: path of the image file.

    Returns:
        The path.
    """
    from matplotlib import rc_context
    from matplotlib.figure import Figure
    from matplotlib.lines import Line2D

    names = list(dict.fromkeys(name for named in curves.values() for name in named))
    styles = {
        name: {"color": COLORS[number % len(COLORS)], "linestyle": (*_DASHES, "-.")[number % (len(_DASHES) + 1)]}
        for number, name in enumerate(names)
    }
    rows = max(1, math.ceil(len(curves) / 2))
    with rc_context(STYLE):
        figure = Figure(figsize=(10.0, 3.1 * rows), layout="constrained")
        panels = figure.subplots(rows, 2, squeeze=False).ravel()
        for axes, (title, named) in zip(panels, curves.items(), strict=False):
            costs = all((returns < 0.0).all() for _, returns in named.values())
            sign = -1.0 if costs else 1.0
            for name, (steps, returns) in named.items():
                axes.plot(steps / 1e6, sign * np.median(returns, axis=0), label=name, **styles[name])
                low, high = (sign * extreme(returns, axis=0) for extreme in (np.min, np.max))
                axes.fill_between(steps / 1e6, low, high, color=styles[name]["color"], alpha=0.12, linewidth=0.0)
            axes.set_yscale("log" if costs else "linear")
            axes.set_title(title, loc="left")
            axes.set_xlabel("million agent-steps")
            axes.set_ylabel("cost (minus the return)" if costs else "return")
        for axes in panels[len(curves) :]:
            axes.set_axis_off()
        entries = [Line2D([], [], label=name, **styles[name]) for name in names]
        figure.legend(handles=entries, loc="outside right center", fontsize=8.5, handlelength=3.0, title="training")
        figure.savefig(path, dpi=130)
    return Path(path)
