"""`khop list`, `check` and `export`: scenarios, environments, policies, and the conditions of observers."""

from __future__ import annotations

import tomllib
from collections.abc import Mapping
from typing import Annotated, Any

import typer

from khop_env.catalog import ENVIRONMENTS, describe
from khop_env.commands.common import (
    EstimatorOption,
    JsonOption,
    NetworkOption,
    ScenarioArgument,
    in_words_of_the_file,
    load,
    mistakes,
    networked,
    print_json,
)
from khop_env.own_agents import FOLDER
from khop_env.terminal import print_table, print_text, waiting


def list_scenarios(
    card: Annotated[
        str | None,
        typer.Option(
            metavar="POLICY",
            help="Print the card of a pretrained policy, in Markdown: how it was trained, what it reaches, where it "
            "fails.",
        ),
    ] = None,
    as_json: JsonOption = False,
) -> None:
    """List the scenarios, a line each, the environments, which run on all of them, and the pretrained policies."""
    if card is not None:
        with mistakes():
            text = _card(card)
        typer.echo(text, nl=False)
        return
    found, policies = describe(), _policies()
    if as_json:
        print_json({"scenarios": found, "environments": list(ENVIRONMENTS), "policies": policies})
        return
    print_table(
        ("scenario", "parameters", "description"),
        [
            (
                each["name"],
                ", ".join(f"{key}={value}" for key, value in each["parameters"].items()),
                each["description"],
            )
            for each in found
        ],
    )
    print_text(f"environments: {', '.join(ENVIRONMENTS)}")
    print_table(
        ("ppo:pretrained/", "scenario", "network"),  # their names say the environment
        [(each["name"], each["scenario"], each["network"] or "") for each in policies],
    )


_PRETRAINED = FOLDER / "learning" / "pretrained"  # read without importing agents


def _policies() -> list[dict[str, Any]]:
    """Name, environment, scenario and network of each pretrained policy; None for the scenario's own network."""
    found = tomllib.loads((_PRETRAINED / "index.toml").read_text(encoding="utf-8"))
    keys = ("environment", "scenario", "network")
    return [{"name": name, **{key: found[name].get(key) for key in keys}} for name in sorted(found)]


def _card(name: str) -> str:
    """The card of a pretrained policy.

    Raises:
        ValueError: if there is no such policy.
    """
    cards = (_PRETRAINED / "README.md").read_text(encoding="utf-8").split("\n## ")[1:]
    for card in cards:
        if card.startswith(f"`{name}`\n"):
            return f"## {card.rstrip()}\n"
    raise ValueError(f"no pretrained policy {name!r}; there are {', '.join(each['name'] for each in _policies())}")


def check(
    name: ScenarioArgument,
    network: NetworkOption = None,
    estimator: EstimatorOption = None,
    as_json: JsonOption = False,
) -> None:
    """Report the design of a scenario's observers: k-hop sets, funnels, feasibility, the paper's assumptions.

    With --network, or a scenario that has one, also what is certain over it: bounds by distance, beside the ideal ones.

    Exits with 1 if a condition of the observers doesn't hold.
    """
    from khop_env.results import design_report, network_report

    with mistakes(name), waiting(f"designing the observers of {name}"):
        scenario = load(name)
        over = networked(scenario, network, estimator)
        report = design_report(scenario)
        if over is not None:
            known = None if report["pairs"] is None else network_report(scenario, over.network)
            report["network"] = known and known | {"estimator": over.estimator.name}
    if report["error"] is not None:
        report["error"] = in_words_of_the_file(name, report["error"])
    if as_json:
        print_json(report)
    else:
        from khop_env.terminal import print_design

        print_design(report)
        if over is not None and report["network"] is not None:
            typer.echo()
            _print_network(report["network"])
    if not report["feasible"]:
        raise typer.Exit(1)


def _print_network(report: Mapping[str, Any]) -> None:
    """What is certain over a network."""
    print_text(f"network: {report['network']}; estimator {report['estimator']}")
    for each in report["types"]:
        print_text(f"{each['type']}: {each['reason'] or 'certified'}")
    print_table(
        ("estimated", "links away", "expected age", "certified bound", "ideal bound"),
        [
            (
                f"{each['component']} of {each['type']}",
                str(each["hops"]),
                "never arrives" if each["expected_age"] is None else f"{1e3 * each['expected_age']:.4g} ms",
                "none" if each["certified"] is None else f"{each['certified']:.3g} {each['unit']}",
                "known exactly" if each["hops"] == 1 else f"{each['ideal']:.3g} {each['unit']}",
            )
            for each in report["bounds"]
        ],
        "Certified bounds at the mean age of states that come by one path; ideal ones after the transient",
    )


def export(name: ScenarioArgument) -> None:
    """Print a scenario as a TOML file to start from: khop export paper > mine.toml."""
    from khop_env.scenarios.files import write_scenario

    with mistakes(), waiting(f"writing {name}"):
        text = write_scenario(load(name))
    typer.echo(text, nl=False)
