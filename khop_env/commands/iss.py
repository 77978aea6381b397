"""`khop iss`: the closed-loop theorem, measured."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from khop_env.commands.common import (
    INTERRUPTED,
    JsonOption,
    ScenarioArgument,
    folder_name,
    load,
    mistakes,
    print_json,
)
from khop_env.terminal import Progress, print_table, say, waiting


def iss(
    name: ScenarioArgument,
    episodes: Annotated[int, typer.Option(min=1, help="Of each row.")] = 16,
    seed: Annotated[int, typer.Option(min=0, help="Of initial states, errors and disturbances.")] = 0,
    duration: Annotated[float | None, typer.Option(help="Of a run in seconds; by default the scenario's.")] = None,
    out: Annotated[Path | None, typer.Option(help="Folder for the files; by default runs/iss/SCENARIO.")] = None,
    as_json: JsonOption = False,
) -> None:
    """Measure Theorem 4: how near to its goal the team comes with errors of a given size, and with tighter bounds.

    Exits with 1 if a run came out farther than the analytical gain allows. Where it is interrupted, what was measured
    until then is written and printed all the same, but for the figure.
    """
    import polars as pl

    from agents.set_iss import analytical_gain, injected_errors, slope, swept_bounds
    from agents.workers import Interrupted, UnfinishedError
    from khop_env.results.curves import set_iss_figure

    with mistakes(name), waiting(f"designing the observers of {name}"):
        scenario = load(name)
        if duration is not None:
            scenario = scenario.replace(duration=duration)
        gain = analytical_gain(scenario)
        folder = out or Path("runs") / "iss" / folder_name(scenario.name)
        folder.mkdir(parents=True, exist_ok=True)
    measured: dict[str, list[dict[str, Any]]] = {"injected": [], "swept": []}
    unfinished: tuple[str, int] | None = None  # why, and the exit status
    with mistakes(name):
        try:
            with Progress("injecting errors") as progress:
                measured["injected"] = injected_errors(scenario, episodes=episodes, seed=seed, progress=progress)
            with Progress("sweeping the bounds") as progress:
                measured["swept"] = swept_bounds(scenario, episodes=episodes, seed=seed, progress=progress)
        except (Interrupted, UnfinishedError) as error:
            unfinished = (str(error), 2) if isinstance(error, UnfinishedError) else ("interrupted", INTERRUPTED)
            measured["swept" if measured["injected"] else "injected"] = error.partial
        files = {key: folder / f"{key}.csv" for key, rows in measured.items() if rows}
        injected, swept = measured.values()
        with waiting(f"writing {folder}"):
            for key, path in files.items():
                pl.DataFrame(measured[key], infer_schema_length=None).write_csv(path)
            if unfinished is None:
                files["figure"] = folder / "figure.png"
                title = (
                    f"{scenario.name}, law {scenario.law.name}: set-ISS with respect to estimation errors (Theorem 4)"
                )
                set_iss_figure(injected, swept, files["figure"], title)
    slopes = [
        {
            "observers": kind,
            "disturbed": disturbed,
            "slope": slope(mine, "delta", "excess" if disturbed else "distance"),
        }
        for kind, disturbed in dict.fromkeys((row["observers"], row["disturbed"]) for row in swept)
        for mine in [[row for row in swept if (row["observers"], row["disturbed"]) == (kind, disturbed)]]
    ]
    verdicts = [row["holds"] for row in (*injected, *swept) if row["holds"] is not None]
    broken = [one for one in verdicts if not one]
    if as_json:
        region = None if gain is None else gain.region()
        found: dict[str, Any] = {"scenario": scenario.name, "law": scenario.law.name, "analytical_region": region}
        found["holds"] = all(verdicts) if verdicts else None
        found |= {"injected": injected, "swept": swept, "slopes": slopes}
        print_json({**found, "files": {key: str(path) for key, path in files.items()}})
    else:
        _print_tables(injected, swept, slopes)
        if gain is None:
            typer.echo("analytical gain: none for this law and scenario; measured only")
        else:
            checked = sum(row["holds"] is not None for row in (*injected, *swept))
            verdict = f"{len(broken)} exceed it" if broken else "none exceeds it"
            typer.echo(
                f"analytical gain: for distances up to {gain.region():.3g} m; it says something of {checked} of "
                f"{len(injected) + len(swept)} rows, and {verdict}"
            )
        if tables := [str(files[key]) for key in ("injected", "swept") if key in files]:
            typer.echo(f"tables: {', '.join(tables)}")
        if "figure" in files:
            typer.echo(f"figure: {files['figure']}")
    if unfinished is not None:
        why, status = unfinished
        say(f"khop: {why}; above is what was measured until then")
        raise typer.Exit(status)
    if broken:
        raise typer.Exit(1)


def _print_tables(
    injected: Sequence[Mapping[str, Any]], swept: Sequence[Mapping[str, Any]], slopes: Sequence[Mapping[str, Any]]
) -> None:
    print_table(
        ("error (m)", "pattern", "distance (m)", "gain", "allowed (m)"),
        [
            (_n(row["error"]), row["pattern"], *(_n(row[key]) for key in ("distance", "gain", "bound")))
            for row in injected
        ],
        "(a) The law on the truth plus errors, no disturbance: ultimate distance to the goal set",
    )
    if not swept:  # it was interrupted before
        return
    typer.echo()
    keys = ("delta", "error", "floor", "distance", "excess", "bound")
    print_table(
        (
            "observers",
            "disturbed",
            "delta(inf)",
            "errors (m)",
            "oracle (m)",
            "distance (m)",
            "excess (m)",
            "allowed (m)",
        ),
        [(row["observers"], "yes" if row["disturbed"] else "no", *(_n(row[key]) for key in keys)) for row in swept],
        "(b) The law on estimates, paired with the law on the truth (oracle) after the transient",
    )
    typer.echo("allowed: on the distance, by the analytical gain, from the errors and the disturbances along the runs")
    for row in slopes:
        what = "excess with disturbance" if row["disturbed"] else "distance without disturbance"
        text = "none: it is down at rounding" if row["slope"] is None else f"{row['slope']:.2f}"
        typer.echo(f"slope of log {what} over log delta(inf), observers {row['observers']}: {text}")


def _n(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"
