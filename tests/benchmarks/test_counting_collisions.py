"""Certified bounds keep agents apart, whatever messages, graphs and policies; point estimates don't."""

import json

import pytest
from PIL import Image

from benchmarks import safety, safety_film, safety_table, side_by_side


@pytest.fixture(scope="module")
def counted():
    """200 episodes of 8 agents with certified bounds, and some of them on point estimates."""
    return list(safety.collisions(200, durations={8: 8.0}))


def test_200_episodes_without_a_collision(counted):
    """And the same filter on point estimates collides in most of them, so that the test can fail."""
    totals = safety.totals(counted)
    found, points = totals["certified"], totals["estimated"]
    assert (found["episodes"], found["collisions"], found["infeasible"]) == (200, 0, 0)
    assert 0.4 <= found["min_distance"] < 0.45  # they did meet
    kinds = {(each.policy, each.filter) for each in counted}
    assert kinds == {(policy, kind) for policy in safety.POLICIES for kind in safety.FILTERS}
    assert points["episodes"] == 40
    assert points["collisions"] > 10


def test_limits_of_a_rate():
    """The rate at which so few collisions have a probability of 5 %."""
    assert safety.upper_limit(0, 10_000) < 3e-4
    assert (1.0 - safety.upper_limit(0, 10_000)) ** 10_000 == pytest.approx(0.05)
    limit = safety.upper_limit(1, 50)
    assert (1.0 - limit) ** 50 + 50 * limit * (1.0 - limit) ** 49 == pytest.approx(0.05)
    assert safety.upper_limit(3, 3) == 1.0


@pytest.mark.parametrize("form", [[], ["--json"]])
def test_an_interrupt_loses_nothing(counted, monkeypatch, capsys, form):
    """What was counted until then is printed, and the status is that of an interrupted command."""

    def stopped(episodes, seed, model, progress):
        yield from counted[:3]
        raise KeyboardInterrupt

    monkeypatch.setattr(safety, "collisions", stopped)
    monkeypatch.setattr("sys.argv", ["safety", *form])
    with pytest.raises(SystemExit, match="130"):
        safety.main()
    printed = capsys.readouterr().out
    if form:
        found = json.loads(printed)
        assert found["interrupted"]
        assert len(found["rows"]) == 3
        assert found["totals"]["certified"]["collisions"] == 0
    else:
        assert "certified bounds: 0 of" in printed
        assert counted[0].condition in " ".join(printed.split())


def test_a_film_of_both(tmp_path, monkeypatch):
    """Side by side until both are over; the agents that collide are counted."""
    path = tmp_path / "film.gif"
    monkeypatch.setattr("sys.argv", ["safety_film", str(path), "--scenario", "swap:duration=2.5", "--observer", "7"])
    counts = []
    step = side_by_side.Side.step
    monkeypatch.setattr(
        side_by_side.Side, "step", lambda side: (step(side), counts.append((side.title, side.collisions)))
    )
    safety_film.main()
    with Image.open(path) as film:
        assert film.size == (1034, 480)
        assert film.n_frames >= 25
    assert dict(counts) == {"filter on point estimates": 2, "filter on certified bounds": 0}


def test_a_table_of_methods():
    """Cells are rates in % and a time; a policy that isn't there is left out, not the table."""
    methods = [
        safety_table.Method("nobody moves", "zero"),
        safety_table.Method("unknown", "nothing"),
        safety_table.Method("all wait", safety_table.WORST),
    ]
    lines = list(safety_table.table("crossing:agents=4,duration=2", range(3), methods=methods))
    assert lines[0] == "**`crossing:agents=4,duration=2`**"
    assert lines[4] == "| nobody moves | 0 / 0 / - | 0 / 0 / - | 0 / 0 / - | 0 / 0 / - |"
    assert [line.split(" | ")[0] for line in lines[4:]] == ["| nobody moves", "| all wait"]
    assert safety_table.oldest("crossing:agents=4", "ideal", 5) < 0.2
    assert safety_table.oldest("crossing:agents=4", "ideal:loss=0.3,burst=5", 5) > 0.4
