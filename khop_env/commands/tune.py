"""`khop tune`: parameters of scripted policies with the largest return, and margins with the fewest collisions."""

from __future__ import annotations

import json
import shlex
from typing import Annotated

import typer

from khop_env.commands.common import INTERRUPTED, EnvironmentScenario, EnvOption, load, mistakes
from khop_env.terminal import Progress, say

SHIPPED = ("paper", "convoy", "mixed_fleet", "random_geometric:agents=12")


def tune(
    environment: Annotated[
        str | None,
        typer.Argument(
            metavar="[ENV]", help="A name (khop list), or a task of your own: my_file.py:MyTask; not with --all."
        ),
    ] = None,
    scenario: EnvironmentScenario = None,
    policies: Annotated[
        str | None,
        typer.Option(
            help="Laws (tanh, linear, formation, leader_following); in navigation_v0 what has a margin: "
            "filter:margin=none, filter:margin=none,dead_reckoning=true, orca. By default all laws, or that filter."
        ),
    ] = None,
    observe: Annotated[
        str, typer.Option(help="Observation modes to tune on: estimate, oracle, local.")
    ] = "estimate,local",
    env: EnvOption = None,
    everything: Annotated[
        bool, typer.Option("--all", help="Every environment on every scenario, as in agents/tuned.toml.")
    ] = False,
) -> None:
    """Tune scripted policies and print their parameters as TOML, in the form of agents/tuned.toml.

    With --env network=NAME estimates are those over this network, and their parameters are printed as "network".
    Each line is printed when its search ends; after an interrupt, the last line has the best parameters so far.

    Margins of policies that keep apart: the smallest without a collision in the tuning episodes, or up to 1 m the one
    with the fewest. Where losses are independent and agents few, a tuned margin can be faster than the certified
    filter. It has no guarantee: no collision in 64 episodes shows only that fewer than about 5 % collide, and where
    losses come in bursts agents collide, or stand still.
    """
    from agents.laws import LAWS
    from agents.policy import describe
    from agents.tuned import OVER, tuned_for
    from agents.tuning import SEEDS, tune, tune_margin
    from agents.workers import Interrupted
    from khop_env.env import Settings
    from khop_env.objects import split_specs
    from khop_env.physics import did_you_mean
    from khop_env.registry import environments, find_task, make_batched
    from khop_env.typed import environment_arguments

    with mistakes():
        if everything == (environment is not None) or (everything and scenario is not None):
            raise ValueError("name one environment to tune for, or give --all and neither ENV nor --scenario")
        modes = [mode.strip() for mode in observe.split(",")]
        tasks = [find_task(name) for name in (environments() if everything else [str(environment)])]
        if everything:  # laws need task edges
            tasks = [task for task in tasks if task.default_policy is None]
        names = list(LAWS) if tasks[0].default_policy is None else ["filter:margin=none"]
        if policies is not None:
            names = split_specs(policies, "--policies", "policy")
        for name in names:
            if name not in LAWS and name.partition(":")[0] not in ("filter", "orca"):
                raise ValueError(f"no law {name!r}; {did_you_mean(name, (*LAWS, 'filter', 'orca'))}")
        arguments = {}
        for task in tasks:
            arguments = environment_arguments(env, task, {"observe": "--observe"})
        call = ["--all"] if everything else [str(environment), *(["--scenario", scenario] if scenario else [])]
        call += [part for text in env or () for part in ("--env", text)]
        typer.echo(f"# Found by khop tune {shlex.join(call)}, on {len(SEEDS)} episodes with seeds from {SEEDS[0]}.")
        typer.echo(f"control_period = {arguments.get('control_period', Settings.control_period):g}  # s")
        for task in tasks:
            for where in SHIPPED if everything else [scenario or task.default_scenario]:
                made = load(where)
                settings = [{**arguments, "observe": mode} for mode in modes]
                if everything and "network" not in arguments:
                    settings.append({**arguments, "network": OVER})
                envs = [make_batched(task, made, num_envs=len(SEEDS), **each) for each in settings]
                played = envs[0].task.environment
                for name in names:
                    typer.echo(f'\n[{played}."{envs[0].scenario}".{name if name in LAWS else json.dumps(name)}]')
                    for batched in envs:
                        mode, interrupted = batched.settings.observe, False
                        over = name in LAWS and tuned_for(describe(batched)) == "network"
                        label = f"{played} on {where}, {name} on {mode}{' over a network' * over}"
                        try:
                            with Progress(label) as progress:
                                best = (tune if name in LAWS else tune_margin)(batched, name, progress=progress)
                        except Interrupted as error:
                            best, interrupted = error.partial, True
                        say(f"{label}: {best.default_return:.4g} -> {best.mean_return:.4g} in {best.trials} trials")
                        pairs = (f"{key} = {json.dumps(value)}" for key, value in best.parameters.items())
                        rates = ""
                        if best.collision_rate is not None and best.success_rate is not None:
                            collided, succeeded = (
                                round(rate * len(SEEDS)) for rate in (best.collision_rate, best.success_rate)
                            )
                            rates = f"  # {collided} of {len(SEEDS)} collided, {succeeded} succeeded"
                        kind = "network" if over else mode
                        typer.echo(f"{kind} = {{ {', '.join(pairs)} }}{rates}{'  # interrupted' * interrupted}")
                        if interrupted:
                            say("khop: interrupted; above are the parameters that were found until then")
                            raise typer.Exit(INTERRUPTED)
