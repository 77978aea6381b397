"""`khop tune`: the parameters of scripted policies that return most."""

from __future__ import annotations

import json
from typing import Annotated

import typer

from khop_env.commands.common import INTERRUPTED, mistakes
from khop_env.commands.evaluate import EnvironmentScenario
from khop_env.terminal import Progress, say

SHIPPED = ("paper", "convoy", "mixed_fleet", "random_geometric:agents=12")


def tune(
    environment: Annotated[
        str | None, typer.Argument(metavar="[ENV]", help="One of those that khop list names; not with --all.")
    ] = None,
    scenario: EnvironmentScenario = None,
    policies: Annotated[str | None, typer.Option(help="Names of laws; by default all.")] = None,
    observe: Annotated[str, typer.Option(help="Observation modes to tune on.")] = "estimate,local",
    everything: Annotated[
        bool, typer.Option("--all", help="Every environment on every scenario: what agents/tuned.toml ships.")
    ] = False,
) -> None:
    """Tune scripted policies and print their parameters as TOML, in the form of agents/tuned.toml.

    Each is printed when it is found; where it is interrupted, with the best until then.
    """
    from agents.laws import LAWS
    from agents.tuning import SEEDS, tune
    from agents.workers import Interrupted
    from khop_env.env import Settings
    from khop_env.physics import did_you_mean
    from khop_env.registry import environments, find_task, make_batched

    with mistakes():
        if everything == (environment is not None) or (everything and scenario is not None):
            raise ValueError("name one environment to tune for, or give --all and neither ENV nor --scenario")
        names = list(LAWS) if policies is None else [one.strip() for one in policies.split(",") if one.strip()]
        if not names:
            raise ValueError(f"--policies names none; known: {', '.join(LAWS)}")
        for name in names:
            if name not in LAWS:
                raise ValueError(f"no law {name!r}; {did_you_mean(name, LAWS)}")
        modes = [mode.strip() for mode in observe.split(",")]
        tasks = {name: find_task(name) for name in (environments() if everything else [str(environment)])}
        call = "--all" if everything else " ".join(filter(None, [environment, scenario and f"--scenario {scenario}"]))
        typer.echo(f"# Found by khop tune {call}, on {len(SEEDS)} episodes with seeds from {SEEDS[0]}.")
        typer.echo(f"control_period = {Settings.control_period:g}  # s")
        for one, task in tasks.items():
            for where in SHIPPED if everything else [scenario or task.default_scenario]:
                envs = [make_batched(one, where, num_envs=len(SEEDS), observe=mode) for mode in modes]
                for name in names:
                    typer.echo(f'\n[{one}."{envs[0].scenario}".{name}]')
                    for mode, env in zip(modes, envs, strict=True):
                        interrupted = False
                        try:
                            with Progress(f"{one} on {where}, {name} on {mode}") as progress:
                                best = tune(env, name, progress=progress)
                        except Interrupted as error:
                            best, interrupted = error.partial, True
                        say(
                            f"{one} on {where}, {name} on {mode}: {best.default_return:.4g} -> {best.mean_return:.4g} "
                            f"in {best.trials} trials"
                        )
                        pairs = (f"{key} = {json.dumps(value)}" for key, value in best.parameters.items())
                        typer.echo(f"{mode} = {{ {', '.join(pairs)} }}{'  # interrupted' * interrupted}")
                        if interrupted:
                            say("khop: interrupted; above is what was found until then")
                            raise typer.Exit(INTERRUPTED)
