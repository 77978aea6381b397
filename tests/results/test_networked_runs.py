"""Recordings, tables, summaries and figures of runs over a network."""

from dataclasses import replace

import numpy as np
import polars as pl
import pytest
from matplotlib.figure import Figure

from agents import make_law
from khop_env.env.rendering import Renderer, Scene
from khop_env.network import Outage
from khop_env.observers import Networked
from khop_env.results import MessageRecord, estimates_table, paper_figure, record, states_table, summarize, write_run
from khop_env.results.video import write_video
from khop_env.scenarios import mixed_fleet, paper

WIFI = Networked("wifi:loss=0.3,burst=5", "relay")


def simulator(scenario, observers=WIFI):
    return scenario.build(law=make_law(scenario.law), observers=observers).reset(3)


def summary(recording, sim, scenario):
    return summarize(
        recording, scenario, seed=3, dt=0.01, observers=sim.observers, controller="tanh", observe="estimate"
    )


@pytest.fixture(scope="module")
def run():
    sim = simulator(paper())
    return record(sim, 1.0, 0.01), sim


def test_samples_are_the_simulators_own_values(run):
    recording, _ = run
    sim = simulator(paper())
    assert isinstance(recording.states, MessageRecord)
    assert recording.inputs is None
    assert recording.states.layout.pairs == sim.observers.layout.pairs == 40
    for sample, time in enumerate(recording.time):
        if sample:
            sim.step(time - sim.t[0])
        for recorded, live in (
            (recording.states.estimate, sim.estimates[0]),
            (recording.states.error, sim.errors()[0]),
            (recording.states.bound, sim.error_bounds().bound[:, 0]),
            (recording.states.age, sim.observers.information(sim.state).age[:, 0]),
        ):
            assert np.array_equal(recorded[sample], live)


def test_the_table_has_bounds_and_ages_and_no_funnels(run):
    recording, sim = run
    table = estimates_table(recording)
    assert table.columns[-2:] == ["bound", "age"]
    assert table["quantity"].unique().to_list() == ["state"]
    assert table.height == len(recording.time) * sim.observers.layout.size
    for name in ("disagreement", "rho", "delta"):
        assert table[name].null_count() == table.height
        assert table[name].dtype == pl.Float64
    assert (table["error"].abs() <= table["bound"]).all()
    at, source = sim.observers.layout.slot[0, 1], sim.fleet.state_slice(1).start
    name = sim.fleet.component_names()[source][1]
    pair = table.filter((pl.col("observer") == "drifter_0") & (pl.col("target") == "drifter_1"))
    pair = pair.filter(pl.col("component") == name)
    assert np.array_equal(pair["estimate"], recording.states.estimate[:, at])
    assert np.array_equal(pair["state"], recording.x[:, source])
    assert np.array_equal(pair["age"], recording.states.age[:, sim.observers.layout.column_pair[at]])


def test_ideal_tables_have_no_further_column():
    scenario = paper()
    recording = record(scenario.build(law=make_law(scenario.law)).reset(3), 0.1, 0.01)
    assert estimates_table(recording).columns[-1] == "bound"


def test_the_summary_says_network_estimator_ages_and_violations(run):
    recording, sim = run
    found = summary(recording, sim, paper())
    assert found["network"] == "a message every 50 ms, 30 % lost in bursts of 5, 10 +- 1 ms late"
    assert found["estimator"] == "relay"
    assert "drawn" not in found
    assert (found["violations"], found["pair_samples"]) == (0, 40 * 101)
    ages = recording.states.age
    assert found["mean_age"] == pytest.approx(ages[np.isfinite(ages)].mean())
    assert found["max_error_to_bound"] == recording.extremes.relative[0]
    assert found["max_error_to_bound"] >= np.max(np.abs(recording.states.error) / recording.states.bound)
    assert found["max_normalized_disagreement"] is None  # states are passed on: there is none
    assert found["uncertified"] == {}
    assert (found["bounds_kept"], found["funnel_kept"]) == (True, None)  # relay has no funnels


def test_the_summary_says_what_was_drawn():
    sim = simulator(paper(), Networked("random", "relay"))
    recording = record(sim, 0.2, 0.01)
    (drawn,) = sim.observers.drawn(sim.state)
    assert recording.states.network == drawn
    found = summary(recording, sim, paper())
    assert found["drawn"] == {name: getattr(drawn, name) for name in ("loss", "latency", "burst", "jitter")}
    assert "0 to 50 % lost in bursts of 1 to 8" in found["network"]


def test_an_error_above_its_bound_is_counted_and_breaks_the_guarantee(run):
    recording, sim = run
    bound = recording.states.bound.copy()
    bound[50, :4] = 0.0  # two pairs of one sample
    broken = replace(recording, states=replace(recording.states, bound=bound))
    assert summary(broken, sim, paper())["violations"] == 2
    largest = recording.extremes._replace(relative=np.array([1.01]))
    assert summary(replace(recording, extremes=largest), sim, paper())["bounds_kept"] is False


def test_the_papers_observers_have_a_ratio_of_their_own():
    sim = simulator(paper(), Networked("wifi", "ppso"))
    found = summary(record(sim, 0.5, 0.01), sim, paper())
    assert 0.0 < found["max_normalized_disagreement"] < 1.0
    assert found["estimator"] == "ppso"


@pytest.mark.parametrize("scenario", [paper(), mixed_fleet()], ids=lambda each: each.name)
def test_files(scenario, tmp_path):
    sim = simulator(scenario)
    recording = record(sim, 0.5, 0.01)
    files = write_run(recording, scenario, summary(recording, sim, scenario), tmp_path)
    assert sorted(files) == ["estimates", "figure", "states", "summary"]
    assert files["figure"].stat().st_size > 20_000
    assert pl.read_parquet(files["estimates"]).columns[-1] == "age"
    assert pl.read_parquet(files["states"]).equals(states_table(recording))


def test_what_is_not_certified_is_drawn_without_a_box(run, tmp_path):
    recording, _ = run
    unknown = replace(recording.states, bound=np.full_like(recording.states.bound, np.inf))
    assert paper_figure(replace(recording, states=unknown), paper(), tmp_path / "figure.png", agent=7).exists()


def test_bounds_that_are_0_are_left_out_of_a_logarithmic_axis(run, tmp_path, monkeypatch):
    """An agent that has just heard another one knows its state exactly."""
    recording, _ = run
    columns = [start + c for pair, start in recording.states.layout.slot.items() if pair[1] == 7 for c in range(2)]
    bound = recording.states.bound.copy()
    bound[10:-1:5, columns] = 0.0
    drawn = []
    monkeypatch.setattr(Figure, "savefig", lambda figure, *args, **options: drawn.extend(figure.axes))
    known = replace(recording, states=replace(recording.states, bound=bound))
    paper_figure(known, paper(), tmp_path / "figure.png", agent=7)
    values = np.concatenate([np.asarray(line.get_ydata(), float) for line in drawn[2].lines])
    assert drawn[2].get_yscale() == "log"
    assert np.isnan(values).any()
    assert not (values <= 0.0).any()


def test_a_film_shows_what_the_simulator_would(run, tmp_path, monkeypatch):
    """Estimates, boxes, ages and links of every frame, against the state at that time."""
    scenes = []
    draw = Renderer.frame
    monkeypatch.setattr(Renderer, "frame", lambda self, scene: (scenes.append(scene), draw(self, scene))[1])
    cut = paper().replace(schedule=Outage(agent=0, start=0.1, duration=0.2))
    sim = simulator(cut)
    recording = record(sim, 0.4, 0.05)
    assert write_video(recording, cut, tmp_path / "film.mp4", fps=20).stat().st_size > 5_000
    again = simulator(cut)
    assert len(scenes) == 8
    for scene in scenes:
        for time in recording.time[(recording.time > again.t[0]) & (recording.time <= scene.t)]:
            again.step(time - again.t[0])
        live = Scene.of(again)
        for name in ("t", "x", "estimates", "bounds", "up"):
            assert np.array_equal(getattr(scene, name), getattr(live, name)), name
        assert np.array_equal(scene.messages.age, live.messages.age)
        assert np.array_equal(scene.messages.missed, live.messages.missed)
        assert scene.ratio == pytest.approx(np.max(np.abs(again.errors()[0]) / live.bounds), rel=1e-12)
    assert {bool(scene.up.all()) for scene in scenes} == {True, False}


@pytest.mark.parametrize("kind", ["states", "inputs"])
def test_bounds_of_a_run_on_a_changing_graph_are_those_of_its_links(kind):
    """Of the true plant's own matrices: no error above, and inf for agents that are cut off."""
    scenario = mixed_fleet().replace(schedule=Outage(agent=3, start=0.1, duration=10.0))
    sim = scenario.build(law=make_law(scenario.law)).reset(3)
    recording = record(sim, 0.3, 0.05)
    found = getattr(recording, kind)
    if kind == "states":
        assert np.allclose(found.bound[-1], sim.error_bounds().bound[:, 0], rtol=1e-12)
    target = found.layout.pair_target[found.layout.column_pair]
    assert np.all(np.isinf(found.bound[-1, target == 3]))
    assert np.all(np.isfinite(found.bound[0]))
    assert np.all(np.abs(found.error) <= found.bound * (1.0 + 1e-9))
