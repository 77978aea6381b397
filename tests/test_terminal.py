"""What the command line shows, apart from any command."""

import pytest

from khop_env import terminal


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
        (0.9999998, "0.9999998"),
        (1.00004, "1.00004"),
        (1.0, "1.000"),
        (0.99951, "0.9995"),
        (2.5e7, "2.5e+07"),
        (None, "not finite"),
    ],
)
def test_a_ratio_is_never_rounded_to_1(value, expected):
    assert terminal._ratio(value) == expected
