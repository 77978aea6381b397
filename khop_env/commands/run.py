"""`khop run`: one episode of a scenario's closed loop, or of an environment's task, and its files."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from khop_env.commands.common import (
    EnvOption,
    EstimatorOption,
    JsonOption,
    NetworkOption,
    ObserveOption,
    ShieldOption,
    mistakes,
    networked,
    print_json,
    shielded_name,
)
from khop_env.commands.episodes import (
    EXPLICIT_STEP,
    IntegratorOption,
    OrderOption,
    configuration_of,
    continuous,
    is_policy,
    played_episode,
    resolved,
    result_of,
)
from khop_env.commands.folders import choose_folder, folder_name
from khop_env.terminal import Progress, say, waiting

if TYPE_CHECKING:
    from agents.running import PolicyRun
    from khop_env.results import Recording
    from khop_env.scenarios import Scenario


def run(
    name: Annotated[
        str,
        typer.Argument(
            metavar="SCENARIO_OR_ENV",
            help="A scenario or an environment (khop list); a scenario's .toml file; or a Python object: "
            "my_file.py:my_scenario, my_file.py:MyTask or my_module:MyTask.",
        ),
    ],
    controller: Annotated[
        str | None,
        typer.Option(
            help="A law, with parameters or without (linear:gain=2); zero, random or bang_bang; a learned policy, "
            "ppo:FOLDER or ppo:pretrained; or a policy of your own, my_file.py:MyPolicy. By default the scenario's law."
        ),
    ] = None,
    scenario: Annotated[
        str | None, typer.Option(help="Scenario of an environment; by default the environment's own.")
    ] = None,
    observe: Annotated[
        ObserveOption,
        typer.Option(
            help="States of agents beyond the neighbours: estimates, the true states (oracle), or none (local)."
        ),
    ] = ObserveOption.ESTIMATE,
    duration: Annotated[
        float | None, typer.Option(help="Seconds; by default the scenario's, or an environment's episode.")
    ] = None,
    dt: Annotated[
        float | None,
        typer.Option(help=f"Step in seconds; by default the scenario's, or {EXPLICIT_STEP:g} for explicit."),
    ] = None,
    tolerance: Annotated[
        float | None,
        typer.Option(
            help="Steps as long as their estimated errors allow, instead of --dt: at most this much of 1 + |value| in "
            "every state and estimate, for example 1e-3."
        ),
    ] = None,
    integrator: Annotated[
        IntegratorOption, typer.Option(help="Integrator of the observers.")
    ] = IntegratorOption.PROXIMAL,
    order: Annotated[
        OrderOption | None, typer.Option(help="Order of the proximal integrator; by default the scenario's.")
    ] = None,
    network: NetworkOption = None,
    estimator: EstimatorOption = None,
    shield: ShieldOption = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the initial state and the disturbance.")] = 0,
    env: EnvOption = None,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for the files; by default in runs/, named after scenario, controller and seed."),
    ] = None,
    video: Annotated[Path | None, typer.Option(help="Film the run, too: a file ending in .mp4 or .gif.")] = None,
    observer: Annotated[
        str | None,
        typer.Option(
            help="Agent whose estimates the film shows, by id or number; by default the one with most task edges to "
            "agents beyond its neighbours."
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Simulate one episode, and write its tables, its summary and the paper's figure.

    A scenario is simulated in continuous time, under a law. An environment plays its task: its controller, law or
    policy, acts once per control period; so do policies on a scenario.

    With --network agents know of each other by messages; estimates then have certified bounds.

    Exits with 1 if a funnel, or a certified bound, was left. All results up to then are written. A folder with another
    run in it is left alone.
    """
    from khop_env.observers import Networked
    from khop_env.results import RunFileError, record, record_controlled, summarize, write_run

    with mistakes(scenario or name), waiting(f"designing the observers of {name}"):
        task, chosen = resolved(name, scenario)
        if shield is not None:
            inside = controller or (None if task is None else task.default_policy) or chosen.law.name
            controller = shielded_name(inside, shield)
        steps = {
            "--dt": dt,
            "--tolerance": tolerance,
            "--order": order,
            "--integrator": integrator if integrator != "proximal" else None,
        }
        if task is not None or is_policy(controller):
            for option, value in steps.items():
                if value is not None:
                    raise ValueError(
                        f"{option}: a policy acts in its environment, which chooses its own steps: --env dt=0.01, "
                        "--env order=2"
                    )
            episode = played_episode(
                name, task, chosen, controller, observe.value, duration, seed, env, network, estimator
            )
        else:
            if env:
                raise ValueError(f"--env is for environments; {name} is a scenario, simulated under a law")
            over = networked(chosen, network, estimator)
            episode = continuous(chosen, controller, observe.value, duration, steps, seed, over)
        played = episode.played
        configuration = configuration_of(chosen, episode, observe.value, seed)
        film = _film(video, observer, chosen)
        parts = [chosen.name, episode.controller, observe.value, "explicit" * (episode.observers.name == "explicit")]
        if played is not None:
            parts.insert(0, played.env.batched.task.environment)
        parts += [
            network or "",
            episode.observers.estimator.name if estimator and isinstance(episode.observers, Networked) else "",
        ]
        folder = choose_folder(Path("runs") / folder_name(*parts, f"seed{seed}"), out, configuration)
    with mistakes(scenario or name), Progress(f"simulating {chosen.name}") as progress:
        if episode.tolerance is not None:
            recording = record_controlled(episode.simulator, episode.duration, episode.tolerance, progress=progress)
        else:
            assert episode.dt is not None
            recording = record(
                episode.simulator,
                episode.duration,
                episode.dt,
                task_error=None if played is None else played.task_error,
                ended=None if played is None else played.ended,
                drawing=None if played is None or video is None else played.drawing,
                progress=progress,
            )
    summary = summarize(
        recording,
        chosen,
        seed=seed,
        dt=episode.dt,
        observers=episode.observers,
        controller=episode.controller,
        observe=observe.value,
        tolerance=episode.tolerance,
    )
    summary |= {"configuration": configuration, **({} if played is None else result_of(played, recording))}
    unwritten: RunFileError | None = None
    with mistakes(), waiting(f"writing {folder}"):
        try:
            files = write_run(recording, chosen, summary, folder)
        except RunFileError as error:
            files, unwritten = error.written, error
    unfilmed = None if video is None else _write_video(recording, chosen, played, video, film, files)
    if as_json:
        print_json({**summary, "files": {key: str(path) for key, path in files.items()}})
    else:
        from khop_env.terminal import print_summary

        print_summary(summary, files)
    if recording.error is not None:
        say(f"khop: {recording.error}")
    if failures := [failure for failure in (unwritten, unfilmed) if failure is not None]:
        for failure in failures:
            say(f"khop: {failure}")
    kept = summary.get("bounds_kept", summary["funnel_kept"])
    if failures or (recording.error is not None and kept):
        raise typer.Exit(2)
    if not kept:
        raise typer.Exit(1)


def _film(video: Path | None, observer: str | None, scenario: Scenario) -> int | None:
    """Refuse a film that couldn't be made before there is something to lose; the number of the agent to show, if any.

    Raises:
        ValueError: for a file or an agent that can't be filmed.
        ModuleNotFoundError: if a package is missing.
        OSError: if its folder can't be made.
    """
    if video is None:
        if observer is not None:
            raise ValueError("--observer chooses the agent whose estimates a film shows; give --video FILE, too")
        return None
    from khop_env.results.video import require_video

    require_video(video)
    shown = None if observer is None else scenario.fleet.agent(int(observer) if observer.isdecimal() else observer)
    video.parent.mkdir(parents=True, exist_ok=True)
    return shown


def _write_video(
    recording: Recording,
    scenario: Scenario,
    played: PolicyRun | None,
    path: Path,
    observer: int | None,
    files: dict[str, Path],
) -> str | None:
    """Write the film and add it to `files`, or return what went wrong: the run's other results aren't lost with it."""
    from khop_env.results.video import write_video

    try:
        env = None if played is None else played.env.batched
        with Progress(f"filming {scenario.name}") as progress:
            files["video"] = write_video(recording, scenario, path, observer=observer, env=env, progress=progress)
    except Exception as error:
        return f"couldn't write {path} ({str(error) or type(error).__name__})"
    return None
