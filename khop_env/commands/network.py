"""`khop network`: errors and certified bounds of estimates over networks, a row for each network and estimator."""

from __future__ import annotations

import enum
import itertools
from collections.abc import Iterable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Annotated, Any

import typer

from khop_env.commands.common import (
    INTERRUPTED,
    JsonOption,
    ScenarioArgument,
    load,
    loaded_estimator,
    mistakes,
    print_json,
    require_figure,
)
from khop_env.terminal import Progress, folded, print_table, print_text, say, waiting

if TYPE_CHECKING:
    from khop_env.network import Network
    from khop_env.observers import Estimator
    from khop_env.results.networks import NetworkRow
    from khop_env.scenarios import Scenario


class MotionOption(enum.StrEnum):
    """What the law acts on."""

    ESTIMATE = "estimate"
    ORACLE = "oracle"


def network(
    name: ScenarioArgument,
    networks: Annotated[
        str | None,
        typer.Option(
            help="Profiles, with other values after a colon: ideal,wifi,lossy:loss=0.3,burst=5 are three; by default "
            "all profiles that are the same in every episode."
        ),
    ] = None,
    estimators: Annotated[
        str,
        typer.Option(
            help="ppso: the paper's observers, by rounds; relay: stamped states, passed on; classes of your own, "
            "my_file.py:MyEstimator."
        ),
    ] = "ppso,relay",
    periods: Annotated[
        str | None, typer.Option(help="Seconds between messages of an agent, 0.01,0.02; by default each network's own.")
    ] = None,
    observe: Annotated[
        MotionOption,
        typer.Option(help="What the law acts on: estimate; or oracle: equal motion in all rows."),
    ] = MotionOption.ESTIMATE,
    episodes: Annotated[int, typer.Option(min=1, help="Episodes of each row, the same for all.")] = 16,
    duration: Annotated[float | None, typer.Option(help="Seconds of an episode; by default the scenario's.")] = None,
    seed: Annotated[int, typer.Option(min=0, help="Seed of the first episode.")] = 0,
    figure: Annotated[
        Path | None,
        typer.Option(
            help="Also measure the first network at six periods and six losses, and draw errors and bounds into this "
            "image file."
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """Measure what is left of estimates and their bounds when messages are sampled, lost and late.

    The scenario's own law acts on the estimates, so that better ones also move the agents otherwise; --observe oracle
    gives all rows the same motion. They are compared with continuous exchange, the paper's.

    Exits with 1 if an error exceeded its certified bound. After an interrupt the rows measured until then are printed.
    """
    from khop_env.network import Network
    from khop_env.objects import split_specs
    from khop_env.observers import SolveError
    from khop_env.results.networks import sweeps

    rows: list[NetworkRow] = []
    unfinished: tuple[str, int] | None = None  # why, and the exit status
    with mistakes(name):
        require_figure(figure)
        chosen = _profiles() if networks is None else split_specs(networks, "--networks", "network")
        by = [loaded_estimator(each) for each in split_specs(estimators, "--estimators", "estimator")]
        times = None if periods is None else _numbers(periods)
        scenario = load(name)
        base = Network.of(chosen[0])
        if figure is not None and base is None:
            raise ValueError("--figure varies the first network's period and loss, and 'none' has no messages")
        plan: list[tuple[Sequence[Any], list[float] | None]] = [([None], None), (chosen, times)]
        plan += [(some, None) for some in sweeps(base)] if figure is not None and base is not None else []
        arguments = {"observe": observe.value, "episodes": episodes, "duration": duration, "seed": seed}
        with waiting(f"designing the observers of {name}"):
            parts = _parts(scenario, plan, by, arguments)
        counts = [1, *(len(by) * len(some) * len(at or [0]) for some, at in plan[1:])]
        try:
            with Progress(f"measuring {scenario.name}") as progress:
                for row in itertools.chain.from_iterable(parts):
                    rows.append(row)
                    progress(len(rows) / sum(counts))
        except KeyboardInterrupt:
            unfinished = ("interrupted", INTERRUPTED)
        except SolveError as error:
            unfinished = (str(error), 2)
    acts = "estimates" if observe == MotionOption.ESTIMATE else "true states"
    loop = f"{scenario.name} under {scenario.law.name} on {acts}"
    rest = iter(rows)
    continuous, found, *swept = [list(itertools.islice(rest, count)) for count in counts]
    if as_json:
        listed = [[row.as_dict() for row in some] for some in (found, continuous, itertools.chain(*swept))]
        result = {"scenario": scenario.name, "rows": listed[0], "continuous": listed[1][0] if listed[1] else None}
        print_json(result | ({"swept": listed[2]} if swept else {}))
    elif found:
        count = f"{episodes} episode{'s' if episodes > 1 else ''}"
        _print(scenario, continuous[0], found, f"{loop}, {count}, the same for every row")
    if swept and unfinished is None:
        _draw(loop, scenario, continuous[0], swept, base, figure)
    if unfinished is not None:
        why, status = unfinished
        say(f"khop: {why}; {'above are the rows that were' if found else 'no row was'} measured until then")
        raise typer.Exit(status)
    if any(row.violations for row in rows):
        raise typer.Exit(1)


def _parts(
    scenario: Scenario,
    plan: Iterable[tuple[Sequence[Any], Sequence[float] | None]],
    by: Sequence[str | Estimator],
    arguments: Any,
) -> list[Iterator[NetworkRow]]:
    """The rows of each part of a plan, networks and periods, checked and not measured yet."""
    from agents.laws import make_law
    from khop_env.results.networks import measure_networks

    law = make_law(scenario.law)
    return [measure_networks(scenario, law, some, by, at, **arguments) for some, at in plan]


def _profiles() -> list[str]:
    from khop_env.network import PROFILES

    return [name for name, network in PROFILES.items() if not network.ranges]


def _numbers(text: str) -> list[float]:
    """Numbers of a list.

    Raises:
        ValueError: for a part that is none.
    """
    try:
        return [float(part) for part in text.split(",")]
    except ValueError:
        raise ValueError(f"--periods must be numbers in s, separated by commas, like 0.01,0.05; got {text!r}") from None


def _print(scenario: Scenario, continuous: NetworkRow, rows: Sequence[NetworkRow], title: str) -> None:
    unit = scenario.fleet.position_unit()
    limits = any(row.bound_to_limit is not None for row in rows)
    header = (
        "network",
        "by",
        "per s",
        "loss",
        f"error ({unit})",
        "largest",
        "bound",
        *["over limit"] * limits,
        "bytes",
    )
    certified = any(row.mean_bound is not None for row in rows)
    print_table(
        header,
        [
            (
                folded(row.network),
                row.estimator,
                _n(row.messages_per_s),
                f"{100.0 * row.loss:.3g} %",
                _n(row.mean_error),
                _n(row.max_error),
                _n(row.mean_bound) or "not certified",
                *[_n(row.bound_to_limit)] * limits,
                _n(row.bytes_per_message),
            )
            for row in rows
        ],
        title,
        whole=("by", "per s", "loss", *header[4:-1]),
    )
    print_text(
        "per s: messages of each agent; error, largest, bound: of positions that an agent estimates of others up to "
        f"{scenario.k} hops away, mean and largest error and mean certified bound, without the first quarter of each "
        "episode, in which estimates start; "
        + "over limit: mean bound over that of the freshest state which could have arrived without losses (latency "
        "counts in whole periods); " * limits + "bytes: of the largest message, as float32"
    )
    for kind, reason in _uncertified(scenario, rows).items():
        print_text(f"{kind}: {reason}")
    bound = f"bound {_n(continuous.mean_bound)} {unit}"
    if continuous.mean_bound is None:
        bound = "no mean bound"
        if scenario.schedule is not None:
            bound = "no mean bound, since some agents are cut off at times by links that are down"
    print_text(
        f"continuous exchange, without messages: error {_n(continuous.mean_error)}, largest "
        f"{_n(continuous.max_error)} {unit}, {bound}"
    )
    if text := _relay_against_ppso(rows):
        print_text(text)
    if not certified:
        return
    violations, steps = (sum(getattr(row, key) for row in rows) for key in ("violations", "pair_steps"))
    print_text(f"errors above their certified bounds, start included: {violations} of {steps} pairs and steps")
    for row in rows:
        if row.violations:
            print_text(f"  {row.network}, {row.estimator}: {row.violations} of {row.pair_steps}")


def _uncertified(scenario: Scenario, rows: Iterable[NetworkRow]) -> dict[str, str]:
    """Why there is no mean bound, by type of agents."""
    from khop_env.network import Network
    from khop_env.results import network_report

    if all(row.mean_bound is not None for row in rows):
        return {}
    types = network_report(scenario, Network())["types"]
    return {each["type"]: each["reason"] for each in types if not each["certified"]}


def _relay_against_ppso(rows: Iterable[NetworkRow]) -> str:
    """The answer to "why not just pass states on?"."""
    pairs: dict[tuple[str, float | None], dict[str, NetworkRow]] = {}
    for row in rows:
        pairs.setdefault((row.network, row.period), {})[row.estimator] = row
    both = [found for found in pairs.values() if {"relay", "ppso"} <= set(found)]
    errors = [_over(found["ppso"].mean_error, found["relay"].mean_error) for found in both]
    bounds = [_over(found["ppso"].mean_bound, found["relay"].mean_bound) for found in both]
    longer = [_over(found["ppso"].bytes_per_message, found["relay"].bytes_per_message) for found in both]
    if not both:
        return ""
    wider = "" if set(bounds) == {None} else f"their certified bound {_between(bounds)} times, "
    return (
        f"why not just pass states on? At the same message rate the mean error of the paper's observers (ppso) is "
        f"{_between(errors)} times that of states passed on and predicted (relay), {wider}and their messages are "
        f"{_between(longer)} times as long"
    )


def _over(value: float | None, other: float | None) -> float | None:
    return None if value is None or not other else value / other


def _between(ratios: Iterable[float | None]) -> str:
    known = [ratio for ratio in ratios if ratio is not None]
    if not known:
        return "unknown"
    ends = dict.fromkeys(f"{ratio:.3g}" for ratio in (min(known), max(known)))
    return " to ".join(ends)


def _draw(
    loop: str,
    scenario: Scenario,
    continuous: NetworkRow,
    swept: Sequence[Sequence[NetworkRow]],
    base: Network | None,
    path: Any,
) -> None:
    from khop_env.results.curves import network_figure

    assert base is not None
    title = f"{loop}: {base.described()}, but for what is varied"
    with mistakes(), waiting(f"drawing {path}"):
        network_figure(swept[0], swept[1], continuous, path, title, scenario.fleet.position_unit())
    say(f"figure: {path}")


def _n(value: float | None) -> str:
    return "" if value is None else f"{value:.3g}"
