"""`khop evaluate`: a table of policies and observation modes over the same episodes."""

from __future__ import annotations

import math
import shlex
from collections.abc import Iterator, Mapping, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from khop_env.brief import BOUND_REACHED, ratio_text
from khop_env.commands.common import (
    INTERRUPTED,
    EnvironmentArgument,
    EnvironmentScenario,
    EnvOption,
    EstimatorOption,
    JsonOption,
    ShieldOption,
    load,
    mistakes,
    print_json,
    require_figure,
    shielded_name,
    with_network,
)
from khop_env.terminal import NEARLY_REACHED, Progress, folded, print_table, print_text, say, waiting

if TYPE_CHECKING:
    from agents.comparison import Comparison, Row
    from khop_env.scenarios import Scenario
    from khop_env.tasks import Task


def evaluate(
    environment: EnvironmentArgument,
    scenario: EnvironmentScenario = None,
    policies: Annotated[
        str | None,
        typer.Option(
            help="Laws (tanh, linear, formation, leader_following), with parameters after a colon: "
            "linear:gain=2,cancel_drift=true; zero, random, bang_bang; learned ones, ppo:FOLDER or ppo:pretrained; "
            "go_to_goal, keep_right, orca and robust_barrier in navigation_v0; classes of your own, "
            "my_file.py:MyPolicy; any of them in a safety filter, filter:tanh. By default tanh, linear (where "
            "a task has edges) or go_to_goal, zero and random."
        ),
    ] = None,
    observe: Annotated[
        str | None,
        typer.Option(
            help="Observation modes: estimate, oracle (true states), local (neighbours only). By default all three, or "
            "estimate if a policy reads certified bounds, as a certified filter does."
        ),
    ] = None,
    network: Annotated[
        str | None,
        typer.Option(
            "--network",
            help="Networks, in each of which all is played: ideal,wifi,lossy:loss=0.3,burst=5 (khop network); by "
            "default the scenario's own, if any.",
        ),
    ] = None,
    estimator: EstimatorOption = None,
    shield: ShieldOption = None,
    episodes: Annotated[int, typer.Option(min=1, help="Episodes of each row, the same for all.")] = 100,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the first episode.")] = 0,
    env: EnvOption = None,
    workers: Annotated[int, typer.Option(min=1, help="Processes; the numbers don't depend on how many.")] = 1,
    ray: Annotated[bool, typer.Option("--ray", help="Play on a Ray cluster.")] = False,
    figure: Annotated[Path | None, typer.Option(help="Draw the task error over time into this image file.")] = None,
    record: Annotated[
        Path | None,
        typer.Option(
            metavar="DIR",
            help="Write every step, true state, action, estimate and bound into this new folder, as Parquet files.",
        ),
    ] = None,
    minari: Annotated[
        str | None,
        typer.Option(
            metavar="NAME-vN",
            help="With --record: also write a Minari data set of the whole team as one agent; of one observation mode "
            "and network.",
        ),
    ] = None,
    csv: Annotated[bool, typer.Option("--csv", help="Print a line per episode instead of the table.")] = False,
    as_json: JsonOption = False,
) -> None:
    """Play policies over the same episodes, and print a table of their returns and errors.

    After an interrupt, or if a worker or policy fails, the rows played until then are printed.
    """
    from agents.comparison import compare
    from agents.policies import make_policy, needs
    from agents.workers import Interrupted, UnfinishedError
    from khop_env.objects import split_specs
    from khop_env.registry import find_task
    from khop_env.results.dataset import EpisodeDataset
    from khop_env.results.minari_dataset import require_new, write_minari
    from khop_env.typed import environment_arguments

    unfinished: tuple[str, int] | None = None  # why, and the exit status
    with mistakes():
        if csv and as_json:
            raise ValueError("--csv and --json: choose one of them")
        require_figure(figure)
        task = find_task(environment)
        arguments = environment_arguments(env, task, {"observe": "--observe"})
        networks = [] if network is None else split_specs(network, "--network", "network")
        single = with_network(arguments, network, estimator)  # refuses two choices
        arguments = single if len(networks) < 2 else with_network(arguments, None, estimator)
        chosen = None if scenario is None else load(scenario)
        default = f"{task.default_policy or 'tanh,linear'},zero,random"
        if policies is None and not _laws_act(task, chosen, arguments):
            default = "zero,random"
        names = [shielded_name(policy, shield) for policy in split_specs(policies or default, "--policies", "policy")]
        if observe is None:
            bounded = any(needs(make_policy(name)).bounds for name in names)
            observe = "estimate" if bounded else "estimate,oracle,local"
        if minari is not None:
            if record is None:
                raise ValueError(f"--minari {minari} is made from a recording: name its folder with --record DIR")
            if "," in observe or len(networks) > 1:
                raise ValueError(
                    f"--minari {minari} is of one environment: choose one mode with --observe (got {observe}) and one "
                    "network"
                )
            require_new(minari)
        dataset = None
        if record is not None:
            options: dict[str, object] = {"scenario": scenario, "policies": policies, "observe": observe}
            options |= {"network": network, "estimator": estimator, "shield": shield}
            options |= {"episodes": episodes, "seed": seed, "record": record}
            command = _command(environment, options, env or ())
            dataset = EpisodeDataset(record, command=command, scenario=scenario)
        with Progress(f"playing {environment}") as progress:
            try:
                comparison = compare(
                    environment,
                    names,
                    [mode.strip() for mode in observe.split(",") if mode.strip()],  # type: ignore[misc]
                    scenario=chosen,
                    arguments=arguments,
                    networks=networks if len(networks) > 1 else None,
                    seeds=range(seed, seed + episodes),
                    workers=workers,
                    ray=ray,
                    record=dataset,
                    progress=progress,
                )
            except Interrupted as error:
                comparison, unfinished = error.partial, ("interrupted", INTERRUPTED)
            except UnfinishedError as error:
                comparison, unfinished = error.partial, (str(error), 2)
    if comparison.rows:
        _print(comparison, csv, as_json)
        if figure is not None:
            _draw(comparison, figure)
    if dataset is not None:
        steps, estimates = dataset.rows.values()
        say(
            f"recorded: {dataset.folder}, {steps} rows of steps and {estimates} of estimates, "
            f"{dataset.size() / 1e6:.1f} MB"
        )
        if minari is not None and unfinished is None:
            with mistakes(), waiting(f"writing {minari}"):
                written = write_minari(dataset.folder, minari)
            say(f"minari: {minari}, {written.total_episodes} episodes and {written.total_steps} steps")
    if unfinished is not None:
        why, status = unfinished
        say(f"khop: {why}; {'above are the episodes that were' if comparison.rows else 'none was'} played until then")
        raise typer.Exit(status)


def _laws_act(task: Task | type[Task], scenario: Scenario | None, arguments: Mapping[str, Any]) -> bool:
    """Whether a task has a policy of its own, or edges along which laws act; if not, say what is played instead."""
    from khop_env.registry import environments, make_batched

    name = f"{task.name}_v{task.version}"
    if task.default_policy is not None or name in environments():
        return True
    if len(make_batched(task, scenario, **arguments).task.edges):
        return True
    say(f"khop: {name} has no task edges, along which laws act: zero and random play; choose others by --policies")
    return False


def _command(environment: str, options: Mapping[str, object], env: Sequence[str]) -> str:
    """That makes the same recording; the number of workers isn't in it, which changes nothing."""
    words = ["khop", "evaluate", environment]
    for name, value in options.items():
        words += [f"--{name}", str(value)] if value is not None else []
    for argument in env:
        words += ["--env", argument]
    return shlex.join(words)


def _print(comparison: Comparison, csv: bool, as_json: bool) -> None:
    if as_json:
        print_json(comparison.summary())
    elif csv:
        typer.echo(comparison.frame().write_csv(), nl=False)
    else:
        print_comparison(comparison)


def _draw(comparison: Comparison, figure: Path) -> None:
    from khop_env.results.curves import error_over_time

    first = comparison.rows[0].episodes
    several = len({row.network for row in comparison.rows}) > 1
    errors = {
        (f"{row.policy} over {row.network}" if several else row.policy, str(row.observe)): row.episodes.task_error
        for row in comparison.rows
    }
    title = (
        f"{comparison.environment} on {comparison.scenario}: median and middle half of {comparison.planned} episodes"
    )
    with mistakes(), waiting(f"drawing {figure}"):
        error_over_time(first.time, errors, figure, title, comparison.rows[0].env.error_unit)
    say(f"figure: {figure}")


def print_comparison(comparison: Comparison) -> None:
    """The table, and what its columns are."""
    networked = comparison.network is not None
    # over a network only some estimators have disagreements, which no guarantee is about
    no_disagreement = networked and not any(row.episodes.max_normalized_disagreement.any() for row in comparison.rows)
    where = f"{comparison.environment} on {comparison.scenario}"
    if networked:
        where += f" over a network ({comparison.network}), estimator {comparison.estimator}"
    title = f"{where}, {comparison.planned} episodes, the same for every row"
    guarantee = "bound (of all observers, below 1 by guarantee)"
    if networked:
        guarantee = f"certified bound (at most 1 by guarantee; {NEARLY_REACHED})"
    if comparison.rows[0].episodes.outcomes:
        _print_outcomes(comparison, title, guarantee)
        return
    rows: list[tuple[str, ...]] = []
    for row, heading in _by_network(comparison):
        rows += heading
        seen = row.summary()
        more, interval = comparison.difference(row)
        settling = seen["settling_time"]
        rows.append(
            (
                _name(row, comparison),
                _with_interval(seen["mean_return"], seen["ci95"]),
                _with_interval(more, interval, sign="+")
                if row is not comparison.rows[0] and not math.isnan(more)
                else "",
                f"{seen['final_task_error']:.3g}",
                "never" if settling is None else f"{settling:.3g}",
                f"{seen['effort']:.3g}",
                *[ratio_text(seen["max_normalized_disagreement"])] * (not no_disagreement),
                ratio_text(seen["max_error_to_bound"], BOUND_REACHED if networked else 0.0),
            )
        )
    unit = comparison.rows[0].env.error_unit
    ratios = ("e / bound",) if no_disagreement else ("|e|", "e / bound")
    header = ("policy", "return", "to first row", f"task error ({unit})", "settled (s)", "effort", *ratios)
    disagreement = "|e|: largest |xi| / rho" + (" of what agents hold" if networked else "")
    print_table(header, rows, title)
    print_text(
        "return: mean over agents of an episode's sum, 95 % intervals; to first row: paired differences; task error: "
        "mean over agents and episodes, at the end; settled: median time from which the team's mean task error stays "
        "below a tenth of the initial one; effort: mean |u|^2, u in fractions of the limits; "
        f"{'' if no_disagreement else f'{disagreement}; '}e / bound: largest estimation error over its {guarantee}"
    )


def _print_outcomes(comparison: Comparison, title: str, guarantee: str) -> None:
    """The table of an environment in which agents may collide."""
    rows: list[tuple[str, ...]] = []
    networked = comparison.network is not None
    began_anew = any(row.summary()["infeasible"] for row in comparison.rows)
    for row, heading in _by_network(comparison):
        rows += heading
        seen = row.summary()
        filtered = seen["intervention"]
        rows.append(
            (
                _name(row, comparison),
                *(_rate(seen[f"{name}_rate"], seen[f"{name}_ci95"]) for name in ("collision", "success", "deadlock")),
                _mean(seen, "arrival_time", ".3g"),
                f"{seen['min_distance']:.3f}",
                _mean(seen, "intervention", ".3f"),
                *["" if filtered is None else f"{100.0 * seen['infeasible']:.2g}"] * began_anew,
                f"{seen['mean_return']:.2f}" + ("" if seen["ci95"] is None else f"\n±{seen['ci95']:.2f}"),
                ratio_text(seen["max_error_to_bound"], BOUND_REACHED if networked else 0.0),
            )
        )
    header = ("policy", "collided %", "success %", "deadlock %", "time (s)", "distance (m)", "changed (m/s)")
    print_table((*header, *["infeasible %"] * began_anew, "return", "e / bound"), rows, title, whole=header[:4])
    infeasible = (
        "infeasible: share of agents and time in which a filter's guarantee had to be begun anew, or a barrier had no "
        "solution; "
    )
    print_text(
        "collided: episodes with a collision; success: all at their goals at the end, without any collision; deadlock: "
        "not all at their goals, and nobody has moved by 0.1 m in the last 2 s; with Wilson's 95 % intervals, means "
        "with the half width of theirs (±). time: until an agent's first arrival, mean over agents and successful "
        "episodes; distance: smallest of two agents' centres; changed: by a filter or barrier, of each agent's inputs, "
        "mean over time; "
        f"{infeasible if began_anew else ''}return: mean over agents of an episode's sum; e / bound: "
        f"largest estimation error over its {guarantee}"
    )


def _mean(seen: Mapping[str, Any], name: str, digits: str) -> str:
    """A mean of a row's summary, with the half width of its interval below; empty where there is none."""
    if seen[name] is None:
        return ""
    half = seen[f"{name}_ci95"]
    return f"{seen[name]:{digits}}" + ("" if half is None else f"\n±{half:{digits}}")


def _rate(rate: float, interval: list[float]) -> str:
    """In %, with its interval below."""
    low, high = (f"{100.0 * end:.0f}" if end > 0.095 else f"{100.0 * end:.2g}" for end in interval)
    return f"{100.0 * rate:.3g}\n[{low}, {high}]"


def _name(row: Row, comparison: Comparison) -> str:
    """Policy, mode, and the number of episodes if some are missing."""
    count = len(row.episodes.seed)
    few = "" if count == comparison.planned else f"\n({count} episodes)"
    name = folded(row.policy)
    space = "\n" if "\n" in name else " "
    return f"{name}{space}on {row.observe}{few}"


def _by_network(comparison: Comparison) -> Iterator[tuple[Row, list[tuple[str, ...]]]]:
    """Rows, those of a network together; before the first of each its name as a row, where there are several."""
    networks = list(dict.fromkeys(row.network for row in comparison.rows))
    for network in networks:
        heading: list[tuple[str, ...]] = [(folded(f"over {network}"),)] if len(networks) > 1 else []
        for row in comparison.rows:
            if row.network == network:
                yield row, heading
                heading = []


def _with_interval(value: float, interval: float | None, sign: str = "") -> str:
    digits = 3 if abs(value) < 10 else 2 if abs(value) < 1000 else 1
    text = f"{value:{sign}.{digits}f}"
    return text if interval is None else f"{text} ±{interval:.{digits}f}"
