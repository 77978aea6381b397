"""`khop deploy`: each agent a process of its own, with datagrams between them; and the files of `khop run`."""

from __future__ import annotations

import enum
import math
import shutil
import tempfile
from pathlib import Path
from typing import TYPE_CHECKING, Annotated

import typer

from khop_env.commands.common import (
    INTERRUPTED,
    JsonOption,
    ScenarioArgument,
    load,
    mistakes,
    print_json,
)
from khop_env.commands.deploying import (
    collected_of,
    kill_of,
    left_out_of,
    live_table,
    over_network,
    print_deployed,
    run_all,
    setups_of,
    simulated_part,
    steps_per_round,
)
from khop_env.commands.episodes import configuration_of, continuous, is_policy, law_of, played_episode
from khop_env.commands.folders import choose_folder, folder_name
from khop_env.terminal import say, waiting

if TYPE_CHECKING:
    from khop_env.results import RunFileError


class TransportOption(enum.StrEnum):
    """Between processes."""

    UDP = "udp"
    ZENOH = "zenoh"


def deploy(
    name: ScenarioArgument,
    controller: Annotated[
        str | None,
        typer.Option(
            help="A law, with parameters or without (linear:gain=2), or a policy as in khop run: filter, "
            "ppo:pretrained, my_file.py:MyPolicy. By default the scenario's law."
        ),
    ] = None,
    duration: Annotated[float | None, typer.Option(help="Seconds; by default the scenario's.")] = None,
    dt: Annotated[
        float | None,
        typer.Option(
            help="Step of plants, in each of which the law acts, in seconds; the period of messages is a multiple. By "
            "default the longest step that is stable and certified."
        ),
    ] = None,
    network: Annotated[
        str | None,
        typer.Option(
            help="What becomes of messages: ideal, factory, wifi, espnow, ... (khop network), also with other values, "
            "lossy:loss=0.3,burst=5; by default the scenario's own, or ideal: one every 50 ms, none lost."
        ),
    ] = None,
    estimator: Annotated[
        str | None,
        typer.Option(
            help="Estimates from messages: ppso (the paper's observers, by rounds) or relay (stamped states, passed "
            "on); by default the scenario's."
        ),
    ] = None,
    transport: Annotated[
        TransportOption, typer.Option(help="UDP on 127.0.0.1, or Eclipse Zenoh, an extra.")
    ] = TransportOption.UDP,
    lockstep: Annotated[
        bool,
        typer.Option(
            "--lockstep", help="Each round waits for all agents: the same numbers as khop run with the same --dt."
        ),
    ] = False,
    kill: Annotated[
        list[str] | None,
        typer.Option(
            metavar="AGENT@T[:RESTART_T]",
            help="Kill an agent's process (SIGKILL) T seconds after the start, and start it again at RESTART_T: "
            "cart_2@3:5; repeatable.",
        ),
    ] = None,
    skew: Annotated[
        float, typer.Option(min=0.0, help="Let the agents' clocks differ by up to so many seconds, and allow for it.")
    ] = 0.0,
    seed: Annotated[int, typer.Option(min=0, help="Seed of initial state, disturbance, losses and clocks.")] = 0,
    out: Annotated[
        Path | None,
        typer.Option(help="Folder for the files; by default in runs/, named after scenario, controller and seed."),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Run a scenario with one process per agent: its plant, law or policy, and observers, and messages between them.

    Rounds take place at multiples of the network's period, by the system's clock. Losses and delays are made at the
    receiver, by the same random numbers as in khop run; with --lockstep everything else is the same, too.

    An agent that is killed has its inputs at 0 until it is back, and then starts from the initial set.

    Exits with 1 if a certified bound was left. All results up to then are written; so they are after Ctrl-C.
    """
    from khop_env.deploy.supervisor import Supervisor
    from khop_env.results import RunFileError, summarize, write_run

    with mistakes(name), waiting(f"designing the observers of {name}"):
        chosen = load(name)
        over = over_network(chosen, network, estimator)
        if not math.isfinite(skew):
            raise ValueError(f"--skew must be a number of seconds; got {skew}")
        if lockstep and (kill or skew):
            raise ValueError("--lockstep waits for all agents, by one clock: leave out --kill and --skew")
        period = over.network.period
        played = policies = None
        if is_policy(controller):
            from agents.deployed import policy_setups, steps_of

            if dt is not None:
                raise ValueError("--dt: a policy acts in its environment, which chooses its own steps; leave it out")
            profile = network or ("ideal" if chosen.network is None else None)
            episode = played_episode(
                name, None, chosen, controller, "estimate", duration, seed, None, profile, estimator
            )
            played = episode.played
            assert played is not None
            parts, policies = steps_of(played, period), policy_setups(played, seed)
        else:
            steps = {"--dt": period, "--order": None, "--integrator": None, "--tolerance": None}
            episode = continuous(chosen, controller, "estimate", duration, steps, seed, over)
            parts = steps_per_round(episode, period, dt)
        episode.dt = period / parts
        rounds = math.floor(episode.duration / period + 1e-9)
        episode.duration = rounds * period
        kills = tuple(kill_of(chosen, text, episode.duration) for text in kill or ())
        left_out = left_out_of(chosen)
        how = {"transport": transport.value, "lockstep": lockstep, "kill": kill or [], "skew": skew}
        configuration = configuration_of(chosen, episode, "estimate", seed) | {"deploy": how}
        named = [chosen.name, episode.controller, "deploy", "lockstep" * lockstep, network or "", estimator or ""]
        folder = choose_folder(Path("runs") / folder_name(*named, f"seed{seed}"), out, configuration)
        records = Path(tempfile.mkdtemp(prefix="records-", dir=folder))
        law = chosen.law if policies else law_of(chosen, controller)
        simulated = simulated_part(name, chosen, episode, law, parts, rounds)
        setups = setups_of(
            chosen, simulated, seed=seed, skew=skew, transport=transport.value, records=records, policies=policies
        )
    with live_table(chosen, records, period) as watch:
        supervisor = Supervisor(chosen, setups, in_step=lockstep, kills=kills, watch=watch)
        with mistakes():
            run_all(supervisor)
    with mistakes(), waiting(f"writing {folder}"):
        collected, found = collected_of(supervisor, chosen, over, setups, lockstep)
        recording = collected.recording
        summary = summarize(
            recording,
            chosen,
            seed=seed,
            dt=episode.dt,
            observers=episode.observers,
            controller=episode.controller,
            observe="estimate",
        )
        summary |= {"violations": collected.violations, "pair_samples": collected.pair_steps}
        if played is not None:
            from agents.deployed import result_of

            in_a_cycle = round(played.env.batched.settings.control_period / episode.dt)
            summary |= result_of(played, collected.x, collected.u, in_a_cycle)
        summary |= {"configuration": configuration, "deploy": {**how, **found, "left_out": left_out}}
        unwritten: RunFileError | None = None
        try:
            files = write_run(recording, chosen, summary, folder)
            shutil.rmtree(records)
        except RunFileError as error:
            files, unwritten = error.written, error
    if as_json:
        print_json({**summary, "files": {key: str(path) for key, path in files.items()}})
    else:
        from khop_env.terminal import print_summary

        print_summary(summary, files)
        print_deployed(summary["deploy"], period)
    for text in [*supervisor.errors, *([str(unwritten)] if unwritten else [])]:
        say(f"khop: {text}")
    if supervisor.interrupted:
        raise typer.Exit(INTERRUPTED)
    if not summary["bounds_kept"]:
        raise typer.Exit(1)
    if supervisor.errors or unwritten:
        raise typer.Exit(2)
