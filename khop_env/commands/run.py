"""`khop run`: simulate a scenario's closed loop, and write down what happened."""

from __future__ import annotations

import enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from khop_env.commands.common import (
    JsonOption,
    ObserveOption,
    ScenarioArgument,
    folder_name,
    load,
    mistakes,
    print_json,
)
from khop_env.terminal import Progress, say, waiting

if TYPE_CHECKING:
    from khop_env.env import BatchedEnv
    from khop_env.results import Recording
    from khop_env.scenarios import LawChoice, Scenario

EXPLICIT_STEP = 1e-5  # s: how the paper samples its example


class IntegratorOption(enum.StrEnum):
    """How the observers are integrated."""

    PROXIMAL = "proximal"
    EXPLICIT = "explicit"


class OrderOption(enum.StrEnum):
    """Order of the proximal integrator."""

    ONE = "1"
    TWO = "2"


def run(
    name: ScenarioArgument,
    controller: Annotated[
        str | None, typer.Option(help="Feedback law, by default the scenario's; or a learned policy, ppo:FOLDER.")
    ] = None,
    observe: Annotated[
        ObserveOption, typer.Option(help="What the law sees of agents out of earshot.")
    ] = ObserveOption.ESTIMATE,
    duration: Annotated[float | None, typer.Option(help="Seconds; by default the scenario's.")] = None,
    dt: Annotated[
        float | None,
        typer.Option(help=f"Step in seconds; by default the scenario's, or {EXPLICIT_STEP:g} for explicit."),
    ] = None,
    integrator: Annotated[IntegratorOption, typer.Option(help="Observers.")] = IntegratorOption.PROXIMAL,
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
    from agents.laws import make_law
    from agents.learning import ALGORITHMS
    from agents.running import policy_run
    from khop_env.observers import Explicit, Proximal
    from khop_env.results import RunFileError, record, summarize, write_run
    from khop_env.results.metrics import finite
    from khop_env.scenarios.scenario import number_of_steps
    from khop_env.simulation.plant import parts_of_step

    explicit = integrator is IntegratorOption.EXPLICIT
    with mistakes(name), waiting(f"designing the observers of {name}"):
        scenario = load(name)
        learned = controller is not None and controller.partition(":")[0] in ALGORITHMS
        if learned:
            for option, value in (("--dt", dt), ("--order", order), ("--integrator", explicit or None)):
                if value is not None:
                    raise ValueError(f"{option}: a learned policy acts in its environment, which chooses its own steps")
        if explicit and order is OrderOption.TWO:
            raise ValueError("--order 2: the explicit integrator is forward Euler, of order 1; leave --order out")
        duration = scenario.duration if duration is None else duration
        dt = dt if dt is not None else EXPLICIT_STEP if explicit else scenario.dt
        number_of_steps(duration, dt)  # refuses what couldn't be played, before anything is built
        simulator: Any
        played: BatchedEnv | None = None
        if learned:
            simulator = policy_run(str(controller), scenario, observe.value, duration, seed)
            played = simulator.env.batched
            dt, stepper = played.settings.control_period, simulator.observers
            duration = simulator.duration
        else:
            law = _law(scenario, controller)
            controller = law.name
            longest, stiffest = scenario.longest_step
            parts_of_step(dt, longest, scenario.fleet.ids[stiffest])
            stepper = Explicit() if explicit else Proximal(scenario.order if order is None else int(order.value))
            simulator = scenario.build(law=make_law(law), observe=observe.value, observers=stepper)
            simulator.reset(seed)
            for warning in scenario.warnings:
                say(f"khop: {warning}")
        shown = _film(video, observer, scenario)
        folder = out or Path("runs") / folder_name(scenario.name)
        folder.mkdir(parents=True, exist_ok=True)  # before anything is computed that could be lost
    with Progress(f"simulating {scenario.name}") as progress:
        error = None if played is None else simulator.task_error
        recording = record(simulator, duration, dt, task_error=error, progress=progress)
    summary = summarize(
        recording,
        scenario,
        seed=seed,
        dt=dt,
        observers=stepper,
        controller=str(controller),
        observe=observe.value,
    )
    if played is not None and recording.task_error is not None:
        summary |= {
            "environment": played.task.environment,
            "final_task_error": finite(float(recording.task_error[-1])),
        }
    unwritten: RunFileError | None = None
    with mistakes(), waiting(f"writing {folder}"):
        try:
            files = write_run(recording, scenario, summary, folder)
        except RunFileError as error:
            files, unwritten = error.written, error
    unfilmed = None if video is None else _write_video(recording, scenario, played, video, shown, files)
    if as_json:
        print_json({**summary, "files": {key: str(path) for key, path in files.items()}})
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


def _law(scenario: Scenario, controller: str | None) -> LawChoice:
    from agents.laws import LAWS
    from khop_env.registry import parameters_from_text
    from khop_env.scenarios import LawChoice

    if controller in (None, scenario.law.name):
        return scenario.law
    name, _, given = str(controller).partition(":")
    types = get_type_hints(LAWS[name]) if name in LAWS else {}
    return LawChoice(name, parameters_from_text(given, types, f"--controller {controller}"))


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
    recording: Recording,
    scenario: Scenario,
    env: BatchedEnv | None,
    path: Path,
    observer: int | None,
    files: dict[str, Path],
) -> str | None:
    """Write the film and add it to `files`; or what went wrong, which must not cost the run its other results."""
    from khop_env.results.video import write_video

    try:
        with Progress(f"filming {scenario.name}") as progress:
            files["video"] = write_video(recording, scenario, path, observer=observer, env=env, progress=progress)
    except Exception as error:
        return f"couldn't write {path} ({str(error) or type(error).__name__})"
    return None
