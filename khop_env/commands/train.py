"""`khop train`: a policy that shares its parameters between agents, by Stable-Baselines3."""

from __future__ import annotations

import dataclasses
import enum
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from khop_env.commands import sweeping
from khop_env.commands.common import (
    INTERRUPTED,
    EnvironmentScenario,
    EnvOption,
    EstimatorOption,
    JsonOption,
    NetworkOption,
    ObserveOption,
    mistakes,
    print_json,
)
from khop_env.commands.training import default_folder, play_command, settings_of, sweep_of
from khop_env.extras import how_to_install
from khop_env.terminal import Progress, print_text, say, waiting

if TYPE_CHECKING:
    from agents.learning.curve import Evaluation


class CriticOption(enum.StrEnum):
    """What the value function sees."""

    LOCAL = "local"
    STATE = "state"


class AlgorithmOption(enum.StrEnum):
    """Learning algorithm."""

    PPO = "ppo"
    SAC = "sac"


class PolicyOption(enum.StrEnum):
    """Kind of network."""

    MLP = "mlp"
    ATTENTION = "attention"
    RECURRENT = "recurrent"


def train(
    environment: Annotated[
        str | None,
        typer.Argument(
            metavar="[ENV]",
            help="A name (khop list), or a task of your own: my_file.py:MyTask or my_module:MyTask. A --config file "
            "can name it instead.",
        ),
    ] = None,
    scenario: EnvironmentScenario = None,
    observe: Annotated[
        ObserveOption | None,
        typer.Option(
            metavar="MODE",
            help="States of agents beyond the neighbours that it learns on: estimate (the default), oracle or local.",
        ),
    ] = None,
    bounds: Annotated[
        bool | None, typer.Option("--bounds", help="Add the guaranteed bounds of the estimates to its observations.")
    ] = None,
    network: NetworkOption = None,
    evaluate_network: Annotated[
        str | None,
        typer.Option(
            "--evaluate-network",
            metavar="NETWORK",
            help="Evaluate over another network than it is trained on, as --network names them; the best policy is "
            "then the best one there.",
        ),
    ] = None,
    estimator: EstimatorOption = None,
    shield: Annotated[
        str | None,
        typer.Option(
            "--shield",
            metavar="MARGIN",
            help="Train inside a safety filter that corrects the actions: certified, none or so many metres; with "
            "options, certified,announce=true. A policy that was trained without it can be played inside all the same: "
            "--policies filter:ppo:FOLDER.",
        ),
    ] = None,
    residual: Annotated[
        str | None,
        typer.Option(
            "--residual",
            metavar="SCRIPT",
            help="Learn on top of a scripted policy, whose actions the networks' are added to: leader_following, "
            "tanh:gain=2. Before training the policy acts as the script.",
        ),
    ] = None,
    initial: Annotated[
        str | None,
        typer.Option(
            "--from",
            metavar="RUN",
            help="Begin with the networks of another run: its folder, or a policy's file. Observations and networks "
            "have to be the same; reward, shield and scenario may differ.",
        ),
    ] = None,
    algo: Annotated[AlgorithmOption | None, typer.Option(help="Algorithm; by default ppo.")] = None,
    policy: Annotated[
        PolicyOption | None,
        typer.Option(metavar="KIND", help="Network: mlp (the default), attention or recurrent; see the guide."),
    ] = None,
    per_type: Annotated[bool | None, typer.Option("--per-type", help="One network for each type of agent.")] = None,
    critic: Annotated[
        CriticOption | None,
        typer.Option(
            help="What the value function sees in training: an agent's observation (local, the default), or the true "
            "global state, too (state), as in MAPPO. Policies see observations only."
        ),
    ] = None,
    timesteps: Annotated[
        int | None, typer.Option(min=1, help="Agent-steps of all copies together; by default 2000000.")
    ] = None,
    seed: Annotated[
        int | None, typer.Option(min=0, help="Seed of networks, episodes and exploration; by default 0.")
    ] = None,
    num_envs: Annotated[int | None, typer.Option(min=1, help="Copies of the environment; by default 64.")] = None,
    env: EnvOption = None,
    settings: Annotated[
        list[str] | None,
        typer.Option(
            "--set",
            metavar="NAME=VALUE",
            help="Any setting of a config file: learning_rate=1e-3, hidden=128+128; repeatable.",
        ),
    ] = None,
    config: Annotated[
        Path | None,
        typer.Option(
            "--config",
            help="TOML file of settings; each run's folder has one, config.toml. --set wins over it, and options win "
            "over both.",
        ),
    ] = None,
    out: Annotated[
        Path | None,
        typer.Option(
            help="Folder; by default in runs/train/, named after environment, algorithm and seed; of a sweep in "
            "runs/sweeps/, named after its file."
        ),
    ] = None,
    callback: Annotated[
        list[str] | None,
        typer.Option(
            "--callback",
            metavar="NAME",
            help="A Stable-Baselines3 callback of your own: my_file.py:MyCallback or my_module:MyCallback; repeatable.",
        ),
    ] = None,
    sweep: Annotated[
        Path | None,
        typer.Option(
            "--sweep",
            metavar="GRID.toml",
            help="Train with all combinations of values in a file, and compare them: settings as in a --config file, "
            "seeds = [0, 1, 2], and a table [grid] of lists, learning_rate = [1e-3, 2e-3]. Options win over the "
            "file's settings.",
        ),
    ] = None,
    workers: Annotated[int, typer.Option(min=1, help="With --sweep: trainings at once.")] = 1,
    ray: Annotated[bool, typer.Option("--ray", help="With --sweep: train on a Ray cluster.")] = False,
    resume: Annotated[bool, typer.Option("--resume", help="Continue from the folder's last checkpoint.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Train a policy; then play it: khop evaluate ENV --policies ppo:FOLDER.

    Settings that aren't chosen have defaults, of their own for some environments, for SAC and for recurrent policies;
    config.toml in the folder has them all. A policy trained with --shield is played inside the filter:
    filter:ppo:FOLDER, as the last line says.

    Ctrl-C saves the policy and ends, with exit status 130. --resume continues from the last of twenty checkpoints as if
    nothing had happened. With larger --timesteps a finished run continues; if its scenario was edited since, it is
    refused.

    --sweep trains with many settings. --resume then leaves out trainings that are finished. If one fails, the others go
    on, and the exit status is 2.
    """
    options = {
        "environment": environment,
        "scenario": scenario,
        "observe": observe and observe.value,
        "bounds": bounds,
        "evaluate_network": evaluate_network,
        "shield": shield,
        "residual": residual,
        "initial": initial,
        "algorithm": algo and algo.value,
        "policy": policy and policy.value,
        "per_type": per_type,
        "critic": critic and critic.value,
        "timesteps": timesteps,
        "seed": seed,
        "num_envs": num_envs,
    }
    with mistakes(), waiting("starting"):
        try:
            from agents.learning.training import train
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError(f"training needs {error.name}: {how_to_install('rl')}") from error
        from agents.learning import TrainingConfig
        from agents.learning.callbacks import named_callbacks
        from agents.learning.config_file import read_config
        from agents.learning.curve import evaluation_environment
        from agents.learning.environment import build, described

        if sweep is None and (ray or workers > 1):
            raise ValueError("--workers and --ray are for sweeps (--sweep): one training runs in one process")
        set_by_options = {name: value for name, value in options.items() if value is not None}
        given = settings or [], set_by_options, env or [], (network, estimator)
        planned = None if sweep is None else sweep_of(sweep, config, given)
    if sweep is not None and planned is not None:
        sweeping.run(
            sweep, planned, out, workers=workers, ray=ray, resume=resume, callbacks=callback or (), as_json=as_json
        )
        return
    with mistakes(), waiting("starting"):
        chosen = TrainingConfig.suited(**settings_of({} if config is None else read_config(config), config, *given))
        played = described(build(chosen, 1), chosen)  # refuses what doesn't fit before there is a folder
        if chosen.evaluate_network is not None:
            evaluation_environment(chosen, 1)
        callbacks = named_callbacks(callback or ())
        unit = played.error_unit
        folder = out or Path("runs") / "train" / default_folder(chosen, played.environment)
    label = f"training {chosen.environment} on {chosen.observe}"
    with mistakes(), Progress(label) as progress:

        def report(fraction: float, evaluation: Evaluation | None) -> None:
            progress(fraction)
            if evaluation is not None:
                disagreement = evaluation.max_normalized_disagreement  # 0 for estimators without funnels
                progress.say(
                    f"{evaluation.timesteps:>11,} agent-steps: return {evaluation.mean_return:.3f}, task error "
                    f"{evaluation.final_task_error:.3f} {unit}" + (f", |e| {disagreement:.3f}" if disagreement else "")
                )

        training = train(chosen, folder, resume=resume, callbacks=callbacks, on_progress=report)
    best = max((each.mean_return for each in training.curve), default=None)
    files = {"best": folder / "best.npz", "last": folder / "last.npz"}
    files |= {"config": folder / "config.toml", "curve": folder / "curve.csv"}
    if as_json:
        found: dict[str, Any] = {
            "config": chosen.as_dict(),
            "curve": [dataclasses.asdict(each) for each in training.curve],
        }
        found |= {"best_return": best, "task_error_unit": unit, "finished": training.finished}
        found |= {"seconds": training.seconds, "folder": str(folder)}
        print_json({**found, "files": {name: str(path) for name, path in files.items()}})
    elif training.finished:
        if (reached := training.curve[-1].timesteps) < chosen.timesteps:
            print_text(f"ended by a callback at {reached:,} of {chosen.timesteps:,} agent-steps; --resume goes on")
        print_text(f"best of {len(training.curve)} evaluations: return {best:.3f}; {training.seconds:.0f} s")
    if not training.finished:
        say("khop: interrupted; the same command with --resume continues from the last checkpoint")
    if not as_json:
        for name, path in files.items():
            typer.echo(f"{name}: {path}")
        typer.echo(f"play it: {play_command(chosen, folder)}")
    if not training.finished:
        raise typer.Exit(INTERRUPTED)
