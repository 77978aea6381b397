"""`khop run`: one episode of a scenario's closed loop, or of an environment's task, and its files."""

from __future__ import annotations

import enum
from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any, get_type_hints

import typer

from khop_env.commands.common import (
    EnvOption,
    JsonOption,
    ObserveOption,
    find_environment,
    load,
    mistakes,
    print_json,
)
from khop_env.commands.folders import choose_folder, digest, folder_name, sources
from khop_env.terminal import Progress, say, waiting

if TYPE_CHECKING:
    from agents.running import PolicyRun
    from khop_env.observers import Observers
    from khop_env.results import Recording
    from khop_env.scenarios import LawChoice, Scenario
    from khop_env.tasks import Task

EXPLICIT_STEP = 1e-5  # s: how the paper samples its example


class IntegratorOption(enum.StrEnum):
    """How the observers are integrated."""

    PROXIMAL = "proximal"
    EXPLICIT = "explicit"


class OrderOption(enum.StrEnum):
    """Order of the proximal integrator."""

    ONE = "1"
    TWO = "2"


@dataclass
class _Episode:
    """All that is needed to simulate one, and to recognise it by.

    Attributes:
        simulator: reset; a scenario's closed loop, or a policy in its environment.
        played: the same policy, where one plays an environment.
        observers: how they are stepped.
        controller: name of the law or policy.
        duration: in s.
        dt: in s.
        content: digest of what the controller is made of.
    """

    simulator: Any
    played: PolicyRun | None
    observers: Observers
    controller: str
    duration: float
    dt: float
    content: str


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
    integrator: Annotated[
        IntegratorOption, typer.Option(help="Integrator of the observers.")
    ] = IntegratorOption.PROXIMAL,
    order: Annotated[
        OrderOption | None, typer.Option(help="Order of the proximal integrator; by default the scenario's.")
    ] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the initial state and the disturbance.")] = 0,
    env: EnvOption = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder for the files; by default its name says what is run: runs/paper-tanh-estimate-seed0."
        ),
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

    Exits with 1 if a funnel was left. All results up to then are written. A folder with another run in it is left
    alone.
    """
    from khop_env.results import RunFileError, record, summarize, write_run

    with mistakes(scenario or name), waiting(f"designing the observers of {name}"):
        task, chosen = _resolved(name, scenario)
        steps = {"--dt": dt, "--order": order, "--integrator": integrator if integrator != "proximal" else None}
        if task is not None or _is_policy(controller):
            for option, value in steps.items():
                if value is not None:
                    raise ValueError(
                        f"{option}: a policy acts in its environment, which chooses its own steps: --env dt=0.01, "
                        "--env order=2"
                    )
            episode = _played(name, task, chosen, controller, observe.value, duration, seed, env)
        else:
            if env:
                raise ValueError(f"--env is for environments; {name} is a scenario, simulated under a law")
            episode = _continuous(chosen, controller, observe.value, duration, steps, seed)
        played = episode.played
        configuration = _configuration(chosen, episode, observe.value, seed)
        film = _film(video, observer, chosen)
        parts = [chosen.name, episode.controller, observe.value, "explicit" * (episode.observers.name == "explicit")]
        if played is not None:
            parts.insert(0, played.env.batched.task.environment)
        folder = choose_folder(Path("runs") / folder_name(*parts, f"seed{seed}"), out, configuration)
    with Progress(f"simulating {chosen.name}") as progress:
        recording = record(
            episode.simulator,
            episode.duration,
            episode.dt,
            task_error=None if played is None else played.task_error,
            ended=None if played is None else played.ended,
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
    )
    summary |= {"configuration": configuration, **({} if played is None else _result(played, recording))}
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
    if failures or (recording.error is not None and summary["funnel_kept"]):
        raise typer.Exit(2)
    if not summary["funnel_kept"]:
        raise typer.Exit(1)


def _resolved(name: str, elsewhere: str | None) -> tuple[Task | type[Task] | None, Scenario]:
    """The task of an environment, or None, and the scenario.

    Raises:
        ValueError: for an unknown name, with the nearest.
    """
    from khop_env.physics import did_you_mean
    from khop_env.registry import SCENARIOS, environments

    task = find_environment(name)
    if task is not None:
        return task, load(elsewhere or task.default_scenario)
    if elsewhere is not None:
        raise ValueError(
            f"--scenario is for environments, and {name!r} isn't one; {did_you_mean(name, environments())}"
        )
    known = (*SCENARIOS, *environments())
    nearest = did_you_mean(name, known)
    if name.isidentifier() and name not in known and any(repr(one) in nearest for one in environments()):
        raise ValueError(f"no scenario or environment {name!r}; {nearest}")
    return None, load(name)


def _is_policy(controller: str | None) -> bool:
    """Whether a controller acts through an environment: everything but a law."""
    from agents import LAWS

    name = (controller or "").partition(":")[0]
    if controller is None or name in LAWS:
        return False
    from agents.learning import ALGORITHMS
    from agents.policies import POLICIES
    from khop_env.objects import is_object_name
    from khop_env.physics import did_you_mean

    if name not in (*POLICIES, *ALGORITHMS) and not is_object_name(controller):
        raise ValueError(f"no law or policy {name!r}; {did_you_mean(name, (*POLICIES, *ALGORITHMS))}")
    return True


def _continuous(
    scenario: Scenario,
    controller: str | None,
    observe: Any,
    duration: float | None,
    steps: Mapping[str, Any],
    seed: int,
) -> _Episode:
    """The closed loop under a law that is evaluated at every instant."""
    from agents import make_law
    from khop_env.observers import Explicit, Proximal
    from khop_env.scenarios.scenario import number_of_steps
    from khop_env.simulation.simulator import parts_of_step

    order, explicit = steps["--order"], steps["--integrator"] is not None
    if explicit and order is OrderOption.TWO:
        raise ValueError("--order 2: the explicit integrator is forward Euler, of order 1; leave --order out")
    duration = scenario.duration if duration is None else duration
    dt = steps["--dt"] if steps["--dt"] is not None else EXPLICIT_STEP if explicit else scenario.dt
    number_of_steps(duration, dt)  # refuses too many of them before anything is built
    law = _law(scenario, controller)
    made = make_law(law)
    longest, stiffest = scenario.longest_step
    parts_of_step(dt, longest, scenario.fleet.ids[stiffest])
    observers = Explicit() if explicit else Proximal(scenario.order if order is None else int(order.value))
    simulator = scenario.build(law=made, observe=observe, observers=observers)
    simulator.reset(seed)
    for warning in scenario.warnings:
        say(f"khop: {warning}")
    return _Episode(simulator, None, observers, law.name, duration, dt, digest(law.name, law.parameters))


def _played(
    name: str,
    task: Task | type[Task] | None,
    scenario: Scenario,
    controller: str | None,
    observe: Any,
    duration: float | None,
    seed: int,
    env: list[str] | None,
) -> _Episode:
    """A policy in an environment."""
    from agents.running import environment_for, policy_run
    from khop_env.registry import find_task
    from khop_env.scenarios.scenario import number_of_steps
    from khop_env.typed import environment_arguments

    if duration is not None or task is None:
        number_of_steps(scenario.duration if duration is None else duration, scenario.dt)
    elsewhere = {"observe": "--observe"} | ({} if duration is None else {"max_cycles": "--duration"})
    spec = controller or scenario.law.name
    acted = task if task is not None else find_task(environment_for(spec, scenario))
    arguments = environment_arguments(env, acted, elsewhere)
    if task is None and duration is None and "max_cycles" not in arguments:
        duration = scenario.duration
    played = policy_run(spec, scenario, observe, duration, seed, environment=acted, arguments=arguments)
    batched = played.env.batched
    if task is None:
        say(f"khop: {spec} acts in {batched.task.environment} (khop run ENV --scenario {name} chooses another one)")
    policy = played.policy
    made_of = getattr(policy, "networks", None), getattr(policy, "parameters", None)
    content = digest(spec, made_of, sources([policy, batched.task]))
    return _Episode(played, played, played.observers, spec, played.duration, batched.settings.control_period, content)


def _configuration(scenario: Scenario, episode: _Episode, observe: str, seed: int) -> dict[str, Any]:
    """What the numbers of a run depend on, as JSON has it."""
    from agents.learning.fingerprint import plain

    found = {
        "scenario": scenario.name,
        "controller": episode.controller,
        "observe": observe,
        "seed": seed,
        "duration": episode.duration,
        "dt": episode.dt,
        "integrator": episode.observers.name,
        "order": episode.observers.order,
        "scenario_content": digest(scenario, sources(scenario.models)),
        "controller_content": episode.content,
    }
    if episode.played is not None:
        batched = episode.played.env.batched
        found |= {"environment": batched.task.environment, "settings": plain(batched.settings)}
        found["task_content"] = digest(batched.task.signature(batched.world))
    return found


def _result(played: PolicyRun, recording: Recording) -> dict[str, Any]:
    """What an environment adds to a run's summary."""
    from khop_env.results.metrics import finite

    batched = played.env.batched
    assert recording.task_error is not None
    return {
        "environment": batched.task.environment,
        "return": finite(played.episode_return),
        "final_task_error": finite(float(recording.task_error[-1])),
        "task_error_unit": batched.task.error_unit(batched.world),
        "terminated": bool(recording.time[-1] < played.duration - 1e-9) and recording.completed,
    }


def _law(scenario: Scenario, controller: str | None) -> LawChoice:
    from agents import LAWS
    from khop_env.registry import parameters_from_text
    from khop_env.scenarios import LawChoice

    if controller in (None, scenario.law.name):
        return scenario.law
    name, _, parameters = str(controller).partition(":")
    return LawChoice(name, parameters_from_text(parameters, get_type_hints(LAWS[name]), f"--controller {controller}"))


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
