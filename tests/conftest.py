"""Hypothesis for compiled code, and the quick selection.

Hypothesis: no deadline (the first example may compile), and the same examples on every machine.

`pytest -m quick` runs tests of every room in under a minute. Of a parametrised test it takes cases in which each pair
of parameter values occurs at least once (pairwise testing: D. M. Cohen, S. R. Dalal, M. L. Fredman and G. C. Patton,
The AETG system, IEEE Trans. Software Engineering 23(7), 1997), chosen greedily and so the same at every collection.
Left out is what `SLOW` lists.
"""

import itertools
from collections.abc import Hashable
from typing import Any

import pytest
from hypothesis import HealthCheck, Phase, settings

PROFILE = {
    "deadline": None,
    "derandomize": True,
    "phases": (Phase.explicit, Phase.generate, Phase.target, Phase.shrink),
    "suppress_health_check": [HealthCheck.too_slow, HealthCheck.data_too_large],
}
settings.register_profile("reproducible", max_examples=100, **PROFILE)
settings.register_profile("quick", max_examples=10, **PROFILE)

SLOW: tuple[str, ...] = ()
"""Beginnings of the ids of tests that aren't part of the quick selection."""


def pytest_configure(config: pytest.Config) -> None:
    settings.load_profile("quick" if config.option.markexpr == "quick" else "reproducible")


@pytest.hookimpl(tryfirst=True)  # before pytest deselects by markers
def pytest_collection_modifyitems(items: list[pytest.Item]) -> None:
    cases: dict[str, list[pytest.Item]] = {}
    for item in items:
        if not item.nodeid.startswith(SLOW):
            cases.setdefault(item.nodeid.partition("[")[0], []).append(item)
    for several in cases.values():
        for item in pairwise(several):
            item.add_marker("quick")


def pairwise(items: list[pytest.Item]) -> list[pytest.Item]:
    """Cases of one test in which every pair of parameter values of all cases occurs."""
    pairs = {item: _pairs(item) for item in items}
    missing = set().union(*pairs.values())
    chosen = []
    while missing:
        best = max(items, key=lambda item: len(pairs[item] & missing))  # of equals the first
        chosen.append(best)
        missing -= pairs[best]
    return chosen


def _pairs(item: pytest.Item) -> set[Hashable]:
    parameters: dict[str, Any] = getattr(getattr(item, "callspec", None), "params", {})
    values = [(name, _key(value)) for name, value in sorted(parameters.items())]
    return {(), *values, *itertools.combinations(values, 2)}


def _key(value: Any) -> Hashable:
    return (type(value), value) if isinstance(value, str | int | float | bool | None) else id(value)
