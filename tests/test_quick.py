"""The quick selection: `pytest -m quick`."""

import itertools
import subprocess
import sys
from pathlib import Path
from types import SimpleNamespace

from tests.conftest import SLOW, pairwise

ROOT = Path(__file__).parents[1]


class Case(SimpleNamespace):
    __hash__ = object.__hash__


def cases(*values):
    """A test with all combinations of its parameters' values."""
    return [Case(callspec=SimpleNamespace(params=dict(enumerate(row)))) for row in itertools.product(*values)]


def test_all_pairs_of_values_occur_in_few_cases():
    values = "abc", (1, 2, 3, 4), (None, 0.5, "a"), (True, False)
    chosen = [item.callspec.params for item in pairwise(cases(*values))]
    for first, second in itertools.combinations(range(4), 2):
        found = {(row[first], row[second]) for row in chosen}
        assert found == set(itertools.product(values[first], values[second]))
    assert len(chosen) <= 18  # of 72; at least 12
    assert pairwise(cases("abc")) != []
    assert len(pairwise(cases([[1], [2], [3]]))) == 3  # values of any type, by identity
    assert len(pairwise([Case()])) == 1  # without parameters


COLLECT = """
import pytest

class Print:
    def pytest_collection_finish(self, session):
        print(*(f"quick {item.nodeid}" for item in session.items), sep="\\n")

    def pytest_deselected(self, items):
        print(*(f"other {item.nodeid}" for item in items), sep="\\n")

raise SystemExit(pytest.main(["--collect-only", "-qq", "--assert=plain", "-m", "quick"], plugins=[Print()]))
"""


def test_every_room_is_in_it_and_no_entry_is_stale():
    done = subprocess.run([sys.executable, "-c", COLLECT], cwd=ROOT, capture_output=True, text=True, check=True)
    named = [line.split(" ", 1) for line in done.stdout.splitlines() if line.startswith(("quick ", "other "))]
    every, quick = [name for _, name in named], [name for kind, name in named if kind == "quick"]
    assert len(every) > len(quick) > 0
    assert [entry for entry in SLOW if not any(name.startswith(entry) for name in every)] == []
    assert not any(name.startswith(SLOW) for name in quick)
    rooms = {Path(name.partition("::")[0]).parent for name in every}
    assert {Path(name.partition("::")[0]).parent for name in quick} == rooms
