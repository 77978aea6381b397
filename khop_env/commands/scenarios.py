"""`khop list`, `check` and `export`: the scenarios and environments, and the conditions of a scenario's observers."""

from __future__ import annotations

import typer

from khop_env.commands.common import JsonOption, ScenarioArgument, in_words_of_the_file, load, mistakes, print_json
from khop_env.terminal import print_table, print_text, waiting


def list_scenarios(as_json: JsonOption = False) -> None:
    """List the scenarios, a line each, and the environments, which run on all of them."""
    from khop_env.registry import describe, environments

    found = describe()
    if as_json:
        print_json({"scenarios": found, "environments": environments()})
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
    print_text(f"environments: {', '.join(environments())}")


def check(name: ScenarioArgument, as_json: JsonOption = False) -> None:
    """Report the design of a scenario's observers: k-hop sets, funnels, feasibility, the paper's assumptions.

    Exits with 1 if a condition of the observers doesn't hold.
    """
    from khop_env.results import design_report

    with mistakes(name), waiting(f"designing the observers of {name}"):
        report = design_report(load(name))
    if report["error"] is not None:
        report["error"] = in_words_of_the_file(name, report["error"])
    if as_json:
        print_json(report)
    else:
        from khop_env.terminal import print_design

        print_design(report)
    if not report["feasible"]:
        raise typer.Exit(1)


def export(name: ScenarioArgument) -> None:
    """Print a scenario as a TOML file to start from: khop export paper > mine.toml."""
    from khop_env.scenarios.files import write_scenario

    with mistakes(), waiting(f"writing {name}"):
        text = write_scenario(load(name))
    typer.echo(text, nl=False)
