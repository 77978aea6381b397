"""Tables, summaries and figures of runs in which links come and go, without a network."""

import numpy as np
import polars as pl
import pytest
from matplotlib.figure import Figure

from agents import make_law
from khop_env.network import Outage
from khop_env.results import estimates_table, paper_figure, record, summarize
from khop_env.scenarios import paper
from khop_env.terminal import print_summary

SCENARIO = paper().replace(schedule=Outage(0.3, 0.2, agent=3))  # until t = 0.5


@pytest.fixture(scope="module")
def run():
    simulator = SCENARIO.build(law=make_law(SCENARIO.law)).reset(1)
    return record(simulator, 0.8, 0.01), simulator


def summary(run, scenario=SCENARIO):
    recording, simulator = run
    return summarize(
        recording, scenario, seed=1, dt=0.01, observers=simulator.observers, controller="tanh", observe="estimate"
    )


def test_bounds_are_those_of_the_links_that_are_up(run):
    """None while an observer is cut off, and kept otherwise."""
    table = estimates_table(run[0])
    off = pl.col("time").is_between(0.299, 0.499)
    of_agent = (pl.col("target") == "drifter_3") | (pl.col("observer") == "drifter_3")
    assert table.filter(off & of_agent)["bound"].is_infinite().all()
    assert table.filter(~off)["bound"].is_finite().all()
    assert (table["error"].abs() < table["bound"]).all()
    assert (table.filter(~off)["bound"] <= table.filter(~off)["delta"] * (1 + 1e-12)).all()


def test_a_summary_says_for_how_much_there_was_no_guarantee(run, capsys):
    table = estimates_table(run[0]).filter(pl.col("quantity") == "state")
    found = summary(run)
    assert found["cut_off"] == pytest.approx(table["bound"].is_infinite().mean(), rel=1e-12)
    assert 0.0 < found["cut_off"] < 1.0
    assert found["funnel_kept"]
    print_summary(found, {})
    assert f"no guarantee for {100 * found['cut_off']:.3g} % of pairs and samples" in capsys.readouterr().out
    always = paper()
    simulator = always.build(law=make_law(always.law)).reset(1)
    assert "cut_off" not in summary((record(simulator, 0.02, 0.01), simulator), always)


def test_the_figure_interrupts_the_bound_of_an_observer_that_is_cut_off(run, tmp_path, monkeypatch):
    kept, save = [], Figure.savefig
    monkeypatch.setattr(Figure, "savefig", lambda figure, *args, **kw: (kept.append(figure), save(figure, *args, **kw)))
    paper_figure(run[0], SCENARIO, tmp_path / "figure.png", agent=3)
    for axes in kept[0].axes[1:]:
        lines = {line.get_label(): line.get_ydata() for line in axes.get_lines()}
        time = run[0].time
        missing = np.isnan(lines["its bound, if any"])
        assert np.array_equal(missing, (time > 0.299) & (time < 0.499))
        assert np.all(lines["max |error|"][~missing] < lines["its bound, if any"][~missing])
        assert np.isfinite(axes.get_ylim()).all()
    assert kept[0].get_suptitle().endswith("while the target reaches the observer")
