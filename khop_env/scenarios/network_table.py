"""The [network] table of scenario files: read and written."""

from __future__ import annotations

from dataclasses import fields
from typing import Any, get_type_hints

import tomlkit
from tomlkit.items import Table

from khop_env.network import PROFILES, Network
from khop_env.observers import ESTIMATORS
from khop_env.scenarios.checked import CheckedTable
from khop_env.scenarios.scenario import Scenario

_COMMENTS = {
    "period": "s, between two messages of an agent",
    "loss": "mean share of lost messages; [low, high]: each episode draws one",
    "burst": "mean number of messages lost in a row, or [low, high]; left out: independent losses",
    "latency": "s, from sending to delivery, mean; or [low, high]",
    "jitter": "s, largest deviation from it; or [low, high]",
    "noise": "largest measurement error of a state that is sent, in the state's unit",
}


def read_network(table: CheckedTable) -> dict[str, Any]:
    """The attributes `network` and `estimator` of a scenario.

    Args:
        table: its [network].

    Raises:
        ScenarioFileError: for a mistake, which is noted.
    """
    values: dict[str, Any] = {}
    for key, known in (("estimator", ESTIMATORS), ("profile", PROFILES)):
        if key in table.names():
            with table.gathering():
                values[key] = table.choice(key, known)
        else:
            table.take(key, str, None)  # known, for hints at misspelt ones
    hints = get_type_hints(Network)
    for key in (field.name for field in fields(Network)):
        value = table.take(key, hints[key], None)
        if value is not None:
            values[key] = value
    table.finish()
    estimator = values.pop("estimator", "ppso")
    try:
        return {"network": Network.of(values), "estimator": estimator}
    except ValueError as error:
        table.refuse("", str(error).replace("Network.", ""))


def write_network(scenario: Scenario) -> Table | None:
    """The table of a scenario's network and estimator; None without a network.

    Raises:
        ValueError: for an estimator of the user's own, or one without a network, which a file can't represent.
    """
    network = Network.of(scenario.network)
    if not isinstance(scenario.estimator, str):
        raise ValueError(
            f"the estimator {scenario.estimator.name!r} can't be written to a file: it isn't one of the library's "
            f"({', '.join(ESTIMATORS)}); keep this scenario in Python"
        )
    if network is None:
        if scenario.estimator != "ppso":
            raise ValueError(
                f"the estimator {scenario.estimator!r} can't be written to a file without a network; give the scenario "
                "one, or the default estimator 'ppso'"
            )
        return None
    table = tomlkit.table()
    profile = next((name for name, known in PROFILES.items() if known == network), None)
    if profile is not None:
        table.add("profile", tomlkit.item(profile).comment(network.described()))
    else:
        for key, comment in _COMMENTS.items():
            value = getattr(network, key)
            if value is not None:
                table.add(key, tomlkit.item(list(value) if isinstance(value, tuple) else value).comment(comment))
    table.add("estimator", scenario.estimator)
    return table
