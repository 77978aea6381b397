"""`khop iss`: the closed-loop theorem, measured."""

from __future__ import annotations

import json
from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Annotated, Any

import typer

from khop_env.commands.common import (
    INTERRUPTED,
    JsonOption,
    ScenarioArgument,
    in_words_of_the_file,
    load,
    mistakes,
    print_json,
)
from khop_env.commands.folders import SUMMARY, choose_folder, digest, folder_name, sources
from khop_env.terminal import Progress, print_table, print_text, say, waiting


def iss(
    name: ScenarioArgument,
    episodes: Annotated[int, typer.Option(min=1, help="Episodes in each row.")] = 16,
    seed: Annotated[int, typer.Option(min=0, help="Seed of initial states, errors and disturbances.")] = 0,
    duration: Annotated[
        float | None, typer.Option(help="Length of an episode in seconds; by default the scenario's.")
    ] = None,
    out: Annotated[
        Path | None, typer.Option(help="Folder for the files; by default as runs/iss/paper-tanh-seed0.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Measure Theorem 4: the team's distance to its goal under errors of a given size, and with tighter bounds.

    Exits with 1 if a run ended farther away than the analytical gain allows. After an interrupt, the rows measured so
    far are written and printed, without the figure.
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
        configuration: dict[str, Any] = {"scenario": scenario.name, "law": scenario.law.name, "episodes": episodes}
        configuration |= {"seed": seed, "duration": scenario.duration}
        configuration["scenario_content"] = digest(scenario, sources(scenario.models))
        default = Path("runs") / "iss" / folder_name(scenario.name, scenario.law.name, f"seed{seed}")
        folder = choose_folder(default, out, configuration)
    measured: dict[str, list[dict[str, Any]]] = {"injected": [], "swept": []}
    unfinished: tuple[str, int] | None = None  # why, and the exit status
    unit = scenario.fleet.position_unit()
    with mistakes(name):
        try:
            with Progress("injecting errors") as progress:
                measured["injected"] = injected_errors(scenario, episodes=episodes, seed=seed, progress=progress)
            with Progress("sweeping the bounds") as progress:
                measured["swept"] = swept_bounds(scenario, episodes=episodes, seed=seed, progress=progress)
        except (KeyboardInterrupt, UnfinishedError, ValueError) as error:
            if not measured["injected"] and not isinstance(error, Interrupted):
                raise
            interrupted = isinstance(error, KeyboardInterrupt)
            unfinished = ("interrupted", INTERRUPTED) if interrupted else (in_words_of_the_file(name, str(error)), 2)
            # the designs before the first swept row may fail, too: the injected rows are kept
            measured["swept" if measured["injected"] else "injected"] = getattr(error, "partial", [])
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
                set_iss_figure(injected, swept, files["figure"], title, unit)
    slopes = [
        {
            "observers": kind,
            "disturbed": disturbed,
            "slope": slope(chosen, "delta", "excess" if disturbed else "distance"),
        }
        for kind, disturbed in dict.fromkeys((row["observers"], row["disturbed"]) for row in swept)
        for chosen in [[row for row in swept if (row["observers"], row["disturbed"]) == (kind, disturbed)]]
    ]
    verdicts = [row["holds"] for row in (*injected, *swept) if row["holds"] is not None]
    broken = verdicts.count(False)
    region = None if gain is None else gain.region()
    found: dict[str, Any] = {"scenario": scenario.name, "law": scenario.law.name, "analytical_region": region}
    found |= {"position_unit": unit, "holds": all(verdicts) if verdicts else None}
    found |= {"injected": injected, "swept": swept, "slopes": slopes, "configuration": configuration}
    with mistakes():
        (folder / SUMMARY).write_text(json.dumps(found, indent=2, allow_nan=False) + "\n", encoding="utf-8")
    files["summary"] = folder / SUMMARY
    if as_json:
        print_json({**found, "files": {key: str(path) for key, path in files.items()}})
    else:
        _print_tables(injected, swept, slopes, unit)
        if gain is None:
            typer.echo("analytical gain: none for this law and scenario; measured only")
        else:
            checked = sum(row["holds"] is not None for row in (*injected, *swept))
            verdict = f"{broken} exceed it" if broken else "none exceeds it"
            print_text(
                f"analytical gain: for distances up to {region:.3g} {unit}; it says something of {checked} of "
                f"{len(injected) + len(swept)} rows, and {verdict}"
            )
        for key, path in files.items():
            typer.echo(f"{key}: {path}")
    if unfinished is not None:
        why, status = unfinished
        say(f"khop: {why}; {'above are the rows that were' if injected else 'no row was'} measured until then")
        raise typer.Exit(status)
    if broken:
        raise typer.Exit(1)


def _print_tables(
    injected: Sequence[Mapping[str, Any]],
    swept: Sequence[Mapping[str, Any]],
    slopes: Sequence[Mapping[str, Any]],
    unit: str,
) -> None:
    print_table(
        (f"error ({unit})", "pattern", f"distance ({unit})", "gain", f"allowed ({unit})"),
        [
            (_n(row["error"]), row["pattern"], *(_n(row[key]) for key in ("distance", "gain", "bound")))
            for row in injected
        ],
        "(a) The law on true states plus errors, no disturbance: distance to the goal set",
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
            f"errors ({unit})",
            f"oracle ({unit})",
            f"distance ({unit})",
            f"excess ({unit})",
            f"allowed ({unit})",
        ),
        [(row["observers"], "yes" if row["disturbed"] else "no", *(_n(row[key]) for key in keys)) for row in swept],
        "(b) The law on estimates, paired with the law on true states (oracle)",
    )
    print_text(
        "distances: largest |Pi p| (all positions together, from their mean) in the last quarter of an episode; "
        "allowed: on the distance, by the analytical gain, from the errors and the disturbances along the runs"
    )
    for row in slopes:
        what = "excess with disturbance" if row["disturbed"] else "distance without disturbance"
        text = "none: it is down at rounding" if row["slope"] is None else f"{row['slope']:.2f}"
        print_text(f"slope of log {what} over log delta(inf), observers {row['observers']}: {text}")


def _n(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"
