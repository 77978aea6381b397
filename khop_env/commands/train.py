"""`khop train`: a policy that shares its parameters between agents, by Stable-Baselines3."""

from __future__ import annotations

import enum
import shlex
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from khop_env.commands.common import ObserveOption, folder_name, mistakes
from khop_env.commands.evaluate import EnvironmentArgument, EnvironmentScenario
from khop_env.terminal import Progress, say, waiting

if TYPE_CHECKING:
    from agents.learning.training import Evaluation


class AlgorithmOption(enum.StrEnum):
    """Who learns."""

    PPO = "ppo"
    SAC = "sac"


def train(
    environment: EnvironmentArgument,
    scenario: EnvironmentScenario = None,
    observe: Annotated[ObserveOption, typer.Option(help="What it learns on.")] = ObserveOption.ESTIMATE,
    bounds: Annotated[bool, typer.Option("--bounds", help="Show it the guaranteed bounds of its estimates.")] = False,
    algo: Annotated[AlgorithmOption, typer.Option(help="Algorithm.")] = AlgorithmOption.PPO,
    per_type: Annotated[bool, typer.Option("--per-type", help="One network for each type of agent.")] = False,
    timesteps: Annotated[int, typer.Option(min=1, help="Agent-steps in all.")] = 2_000_000,
    seed: Annotated[int, typer.Option(min=0, help="Of networks, episodes and exploration.")] = 0,
    num_envs: Annotated[int, typer.Option(min=1, help="Copies of the environment.")] = 64,
    out: Annotated[Path | None, typer.Option(help="Folder; by default runs/train/ and what is trained.")] = None,
    resume: Annotated[bool, typer.Option("--resume", help="Go on from the folder's checkpoint.")] = False,
) -> None:
    """Train a policy; then play it: khop evaluate ENV --policies ppo:FOLDER.

    Ctrl-C saves the policy and ends. --resume goes on from the last checkpoint (there are twenty in a run) as if
    nothing had happened; SAC begins with an empty replay buffer. With larger --timesteps a run goes on beyond its end;
    where the scenario was edited, it doesn't.
    """
    with mistakes(), waiting("starting"):
        try:
            from agents.learning.training import train
        except ModuleNotFoundError as error:
            raise ModuleNotFoundError(f"training needs {error.name}: pip install 'khop_env[rl]'") from error
        from agents.learning import TrainingConfig

        chosen: dict[str, Any] = {"observe": observe.value, "algorithm": algo.value, "bounds": bounds}
        if algo is AlgorithmOption.SAC:
            chosen |= {"learning_rate": 1e-3, "batch_size": 512}
        config = TrainingConfig(
            environment, scenario, per_type=per_type, timesteps=timesteps, seed=seed, num_envs=num_envs, **chosen
        )
        parts = (environment, scenario or "", observe.value, "bounds" * bounds, "per_type" * per_type, f"{algo}-{seed}")
        folder = out or Path("runs") / "train" / folder_name("-".join(filter(None, parts)))
    with mistakes(), Progress(f"training {environment} on {observe}") as progress:

        def told(fraction: float, evaluation: Evaluation | None) -> None:
            progress(fraction)
            if evaluation is not None:
                progress.say(
                    f"{evaluation.timesteps:>10,} agent-steps: return {evaluation.mean_return:8.3f}, task error at the "
                    f"end {evaluation.final_task_error:.3f} m, largest |e| {evaluation.max_normalized_disagreement:.3f}"
                )

        training = train(config, folder, resume=resume, on_progress=told)
    best = max((one.mean_return for one in training.curve), default=None)
    if training.finished:
        typer.echo(f"best of {len(training.curve)} evaluations: {best:.3f}; {training.seconds:.0f} s")
    else:
        say("interrupted; the same command with --resume goes on from the last checkpoint")
    typer.echo(f"policies: {folder / 'best.npz'}, {folder / 'last.npz'}; curve: {folder / 'curve.csv'}")
    command = ["khop", "evaluate", environment, *(["--scenario", scenario] if scenario else [])]
    typer.echo(f"play it: {shlex.join([*command, '--policies', f'{algo}:{folder}'])}")
