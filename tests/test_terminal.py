"""What the command line shows, apart from any command."""

import contextlib
import io
from collections import Counter

import pytest
from hypothesis import given
from hypothesis import strategies as st

from khop_env import terminal
from khop_env.brief import BOUND_REACHED, ratio_text


class TestProgress:
    @pytest.fixture
    def clock(self, monkeypatch):
        now = [0.0]
        monkeypatch.setattr(terminal.time, "perf_counter", lambda: now[0])
        return now

    def test_short_work_shows_no_bar(self, clock):
        with terminal.Progress("work") as progress:
            clock[0] = 1.0
            progress(0.6)
            assert progress._bar is None

    def test_long_work_shows_one_early(self, clock):
        with terminal.Progress("work") as progress:
            clock[0] = 0.4
            progress(0.001)
            assert progress._bar is None
            clock[0] = 0.6
            progress(0.1)
            assert progress._bar is not None


@pytest.mark.parametrize(
    ("value", "expected"),
    [
        (0.5, "0.500"),
        (0.9999998, "0.999+"),
        (0.9994, "0.999"),
        (1.0 + 1e-9, "1.000000001"),
        (1.00004, "1.00004"),
        (1.0, "1.000"),
        (0.99951, "0.999+"),
        (2.5e7, "2.5e+07"),
        (None, "not finite"),
    ],
)
def test_a_ratio_is_never_rounded_to_1(value, expected):
    assert ratio_text(value) == expected


def test_an_error_that_reaches_its_certified_bound_is_no_violation():
    assert ratio_text(1.0 + 1e-9, BOUND_REACHED) == "1.000"
    assert ratio_text(1.0 + 1e-5, BOUND_REACHED) == "1.00001"


@pytest.mark.parametrize(("value", "explained"), [(1.0 - 1e-9, True), (0.7, False)])
def test_a_ratio_close_to_1_over_a_network_is_explained(value, explained, capsys):
    summary = {"mean_age": 0.1, "network": "wifi", "max_error_to_bound": value, "max_normalized_disagreement": None}
    summary |= {"bounds_kept": True, "violations": 0, "pair_samples": 9, "uncertified": {}, "error": None}
    terminal._print_certified(summary)
    said = " ".join(capsys.readouterr().out.split())
    assert ("certified bound 0.999+;" in said) == explained
    assert ("close to 1 is normal over a network" in said) == explained


@given(st.data(), st.integers(20, 120))
def test_tables_fold_columns_and_never_words(data, width):
    """And they are as wide as asked for, wherever their longest words let them."""
    word = st.text("abcdef(/)=", min_size=1, max_size=14)
    cell = st.lists(word, max_size=3).map(" ".join)
    count = data.draw(st.integers(1, 8))
    header = data.draw(st.lists(st.lists(word, min_size=1, max_size=2).map(" ".join), min_size=count, max_size=count))
    rows = data.draw(st.lists(st.lists(cell, min_size=count, max_size=count), min_size=1, max_size=4))
    whole = data.draw(st.lists(st.sampled_from(header), max_size=2))
    out = io.StringIO()
    with contextlib.redirect_stdout(out):
        terminal.print_table(header, rows, width=width, whole=whole)
    found = out.getvalue()
    columns = [[name, *(row[number] for row in rows)] for number, name in enumerate(header)]
    assert Counter(found.split()) - Counter({"─": 1}) >= Counter(
        word for cells in columns for text in cells for word in text.split()
    )
    least = [
        max(len(text) if name in whole else max(map(len, text.split()), default=0) for text in cells)
        for name, cells in zip(header, columns, strict=True)
    ]
    longest = max(len(line.rstrip()) for line in found.splitlines())
    assert longest <= max(width, sum(least) + 2 * (count - 1))


def test_outcomes_of_an_episode_in_words(capsys):
    found = {"collision": 1.0, "arrival_time": None, "min_distance": 0.2, "intervention": None, "infeasible": None}
    terminal._print_outcomes(found)
    terminal._print_outcomes(
        found | {"collision": 0.0, "arrival_time": 3.21, "intervention": 0.125, "infeasible": 0.01}
    )
    assert " ".join(capsys.readouterr().out.split()) == (
        "a collision, smallest distance 0.2 m; not all at their goals no collision, smallest distance 0.2 m; all at "
        "their goals, after 3.21 s in the mean; inputs changed by 0.125 m/s in the mean, a guarantee begun anew in 1 % "
        "of agents and time"
    )


@pytest.mark.parametrize(
    ("name", "lines"),
    [
        ("tanh", ["tanh"]),
        ("filter:nav.py:Swirl", ["filter:", "nav.py:Swirl"]),
        ("filter:margin=0.3:nav.py:Swirl", ["filter:margin=0.3:", "nav.py:Swirl"]),
        ("ppo:runs/train/consensus_v0-ppo-0", ["ppo:runs/train/", "consensus_v0-ppo-0"]),
        ("a_word_without_any_separator", ["a_word_without_any_separator"]),
    ],
)
def test_a_long_name_is_folded_at_its_separators_from_its_end(name, lines):
    assert terminal.folded(name).split("\n") == lines
