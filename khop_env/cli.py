"""The command line, `khop`: list, check, run and export scenarios, and measure.

Tables and one JSON object (`--json`) go to stdout; progress and messages to stderr. Exit status: 0, or 1 where a check
or a run finds the observers' guarantee broken, or 2 for a mistake in what was asked.
"""

from __future__ import annotations

import contextlib
import enum
import json
import os
import re
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from khop_env import __version__
from khop_env.terminal import Progress, print_table, say, waiting

if TYPE_CHECKING:
    from khop_env.results import Recording
    from khop_env.scenarios import LawChoice, Scenario

EXPLICIT_STEP = 1e-5  # s: how the paper samples its example

app = typer.Typer(
    name="khop",
    help="Decentralised k-hop prescribed performance observers: the paper's experiment and yours.",
    no_args_is_help=True,
    add_completion=False,
    pretty_exceptions_enable=False,
    context_settings={"help_option_names": ["-h", "--help"]},
)


class ObserveOption(enum.StrEnum):
    """What the law sees of agents out of earshot."""

    ESTIMATE = "estimate"
    ORACLE = "oracle"
    LOCAL = "local"


class IntegratorOption(enum.StrEnum):
    """How the observers are integrated."""

    PROXIMAL = "proximal"
    EXPLICIT = "explicit"


class OrderOption(enum.StrEnum):
    """Order of the proximal integrator."""

    ONE = "1"
    TWO = "2"


ScenarioArgument = Annotated[
    str,
    typer.Argument(
        metavar="SCENARIO",
        help="A name (khop list), one with parameters (random_geometric:agents=100,k=2), or the path of a .toml file.",
    ),
]
JsonOption = Annotated[bool, typer.Option("--json", help="Print one JSON object.")]


def main() -> None:
    """Run the command line; where stdout can't be written to, say so in one line, and not at all to a closed pipe."""
    try:
        app()
    except BrokenPipeError:
        _drop_stdout()
        raise SystemExit(2) from None
    except OSError as error:
        _drop_stdout()
        say(f"khop: {error}")
        raise SystemExit(2) from None


def _drop_stdout() -> None:
    """Send what is still buffered nowhere, so that the interpreter doesn't stumble over it when it ends."""
    with contextlib.suppress(OSError, ValueError):
        os.dup2(os.open(os.devnull, os.O_WRONLY), sys.stdout.fileno())


@app.callback(invoke_without_command=True)
def _root(version: Annotated[bool, typer.Option("--version", help="Print the version.")] = False) -> None:
    if version:
        typer.echo(__version__)
        raise typer.Exit


@app.command("list")
def list_scenarios(as_json: JsonOption = False) -> None:
    """List the scenarios, with one line each, and the environments, which run on all of them."""
    from khop_env.registry import describe, environments

    found = describe()
    if as_json:
        _print_json({"scenarios": found, "environments": environments()})
        return
    print_table(
        ("scenario", "parameters", "what it is"),
        [
            (one["name"], ", ".join(f"{key}={value}" for key, value in one["parameters"].items()), one["description"])
            for one in found
        ],
    )
    typer.echo(f"environments: {', '.join(environments())}")


@app.command()
def check(name: ScenarioArgument, as_json: JsonOption = False) -> None:
    """Report what the observers rest on: k-hop sets, funnels, feasibility, the paper's assumptions.

    Exits with 1 if a condition of the observers doesn't hold.
    """
    from khop_env.results import design_report

    with _mistakes(name), waiting(f"designing the observers of {name}"):
        report = design_report(_load(name))
    if report["error"] is not None:
        report["error"] = _in_words_of_the_file(name, report["error"])
    if as_json:
        _print_json(report)
    else:
        from khop_env.terminal import print_design

        print_design(report)
    if not report["feasible"]:
        raise typer.Exit(1)


@app.command()
def run(
    name: ScenarioArgument,
    controller: Annotated[str | None, typer.Option(help="Feedback law; by default the scenario's.")] = None,
    observe: Annotated[
        ObserveOption, typer.Option(help="What the law sees of agents out of earshot.")
    ] = ObserveOption.ESTIMATE,
    duration: Annotated[float | None, typer.Option(help="Seconds; by default the scenario's.")] = None,
    dt: Annotated[
        float | None,
        typer.Option(help=f"Step in seconds; by default the scenario's, or {EXPLICIT_STEP:g} for explicit."),
    ] = None,
    integrator: Annotated[IntegratorOption, typer.Option(help="Integrator.")] = IntegratorOption.PROXIMAL,
    order: Annotated[OrderOption | None, typer.Option(help="Of the proximal integrator; the scenario's.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Of the initial state and the disturbance.")] = 0,
    out: Annotated[Path | None, typer.Option(help="Folder for the files; by default runs/SCENARIO.")] = None,
    video: Annotated[Path | None, typer.Option(help="Film the run, too: a file ending in .mp4 or .gif.")] = None,
    observer: Annotated[
        str | None,
        typer.Option(help="Agent whose beliefs the film shows, by id or number; by default the one that needs most."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Simulate the closed loop; write its tables, its summary and the paper's figure.

    Exits with 1 if a funnel was left. Whatever was computed until then is written all the same.
    """
    from agents import make_law
    from khop_env.results import RunFileError, record, summarize, write_run
    from khop_env.simulation import Explicit, Proximal

    explicit = integrator is IntegratorOption.EXPLICIT
    with _mistakes(name), waiting(f"designing the observers of {name}"):
        scenario = _load(name)
        law = _law(scenario, controller)
        if explicit and order is OrderOption.TWO:
            raise ValueError("--order 2: the explicit integrator is forward Euler, of order 1; leave --order out")
        stepper = Explicit() if explicit else Proximal(scenario.order if order is None else int(order.value))
        dt = dt if dt is not None else EXPLICIT_STEP if explicit else scenario.dt
        duration = scenario.duration if duration is None else duration
        for option, value in (("--duration", duration), ("--dt", dt)):
            if not 0.0 < value < float("inf"):
                raise ValueError(f"{option} must be positive and finite; got {value!r}")
        simulator = scenario.build(law=make_law(law), observe=observe.value, integrator=stepper)
        simulator.reset(seed)
        shown = _film(video, observer, scenario)
        folder = out or Path("runs") / _folder_name(scenario.name)
        folder.mkdir(parents=True, exist_ok=True)  # before anything is computed that could be lost
    with Progress(f"simulating {scenario.name}") as progress:
        recording = record(simulator, duration, dt, progress=progress)
    summary = summarize(
        recording,
        scenario,
        seed=seed,
        dt=dt,
        integrator=stepper,
        controller=law.name,
        observe=observe.value,
    )
    unwritten: RunFileError | None = None
    with _mistakes(), waiting(f"writing {folder}"):
        try:
            files = write_run(recording, scenario, summary, folder)
        except RunFileError as error:
            files, unwritten = error.written, error
    unfilmed = None if video is None else _write_video(recording, scenario, video, shown, files)
    if as_json:
        _print_json({**summary, "files": {key: str(path) for key, path in files.items()}})
    else:
        from khop_env.terminal import print_summary

        print_summary(summary, files)
        if "video" in files:
            typer.echo(f"video: {files['video']}")
    if recording.error is not None:
        say(f"khop: {recording.error}")
    if failures := [failure for failure in (unwritten, unfilmed) if failure is not None]:
        for failure in failures:
            say(f"khop: {failure}")
        raise typer.Exit(2)
    if not summary["funnel_kept"]:
        raise typer.Exit(1)


@app.command()
def export(name: ScenarioArgument) -> None:
    """Print a scenario as a TOML file to start from: khop export paper > mine.toml."""
    from khop_env.scenarios.files import write_scenario

    with _mistakes(), waiting(f"writing {name}"):
        text = write_scenario(_load(name))
    typer.echo(text, nl=False)


@app.command()
def bench(
    quick: Annotated[bool, typer.Option("--quick", help="Smaller sizes, rougher numbers.")] = False,
    peers: Annotated[
        Path | None, typer.Option(help="Folder with virtual environments mpe2, vmas, jaxmarl to compare with.")
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Measure speed and memory against explicit, SciPy's and bare loops, and other libraries' environments."""
    from khop_env.bench import benchmark

    result = benchmark(quick=quick, progress=say, peers=peers)
    if as_json:
        _print_json(result)
        return
    rows = [
        tuple("" if row.get(key) is None else row[key] for key in ("name", "value", "unit", "target"))
        for row in result["rows"]
    ]
    print_table(("measure", "value", "unit", "target"), [tuple(_short(cell) for cell in row) for row in rows])
    typer.echo(f"machine: {result.get('machine')}")


@contextmanager
def _mistakes(name: str | None = None) -> Iterator[None]:
    """Tell of a mistake in what was asked in one paragraph, without a traceback; `name` is the scenario's."""
    try:
        yield
    except (ValueError, OSError, ModuleNotFoundError) as error:
        from khop_env.observers import DesignError

        in_file = name is not None and isinstance(error, DesignError)
        say(f"khop: {_in_words_of_the_file(str(name), str(error)) if in_file else error}")
        raise typer.Exit(2) from None


def _in_words_of_the_file(name: str, message: str) -> str:
    """What is wrong with a design, as one who edits a scenario file knows it; unchanged for scenarios by name."""
    if not name.endswith(".toml"):
        return message
    for value in ("True", "False"):
        message = message.replace(f"input_observer={value}", f"input_observer = {value.lower()}")
    return f"{name}: {message}"


def _folder_name(scenario_name: str) -> str:
    """A scenario's name as that of one visible folder."""
    return re.sub(r"[^\w.-]+", "_", scenario_name).lstrip(".") or "scenario"


def _load(name: str) -> Scenario:
    """The scenario that the user names, whose law exists.

    Raises:
        ValueError: if there is no such scenario, file or law.
    """
    from agents import LAWS, LawError, make_law
    from khop_env.registry import scenario
    from khop_env.scenarios.files import read_scenario

    found = read_scenario(name, laws=LAWS) if name.endswith(".toml") else scenario(name)
    try:
        make_law(found.law)
    except LawError as error:
        key = "law" if error.parameter is None else f"law.{error.parameter}"
        raise ValueError(f"{name}: {key}: {error}") from error
    return found


def _law(scenario: Scenario, controller: str | None) -> LawChoice:
    from khop_env.scenarios import LawChoice

    return scenario.law if controller in (None, scenario.law.name) else LawChoice(str(controller))


def _film(video: Path | None, observer: str | None, scenario: Scenario) -> int | None:
    """Refuse a film that couldn't be made before there is something to lose; the number of the agent to show, if any.

    Raises:
        ValueError: for a file or an agent that won't do.
        ModuleNotFoundError: if a package is missing.
        OSError: if its folder can't be made.
    """
    if video is None:
        if observer is not None:
            raise ValueError("--observer chooses whose beliefs a film shows; give --video FILE, too")
        return None
    from khop_env.results.video import require_video

    require_video(video)
    shown = None if observer is None else scenario.fleet.agent(int(observer) if observer.isdecimal() else observer)
    video.parent.mkdir(parents=True, exist_ok=True)
    return shown


def _write_video(
    recording: Recording, scenario: Scenario, path: Path, observer: int | None, files: dict[str, Path]
) -> str | None:
    """Write the film and add it to `files`; or what went wrong, which must not cost the run its other results."""
    from khop_env.results.video import write_video

    try:
        with Progress(f"filming {scenario.name}") as progress:
            files["video"] = write_video(recording, scenario, path, observer=observer, progress=progress)
    except Exception as error:
        return f"couldn't write {path} ({str(error) or type(error).__name__})"
    return None


def _print_json(value: Any) -> None:
    typer.echo(json.dumps(value, indent=2, allow_nan=False))


def _short(cell: Any) -> str:
    return f"{cell:.4g}" if isinstance(cell, float) else str(cell)
