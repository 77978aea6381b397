"""The files of a run: each is written even if others fail."""

import json
from dataclasses import replace

import numpy as np
import polars as pl
import pytest

from agents import make_law
from khop_env.results import RunFileError, record, write_run, writing
from khop_env.scenarios import mixed_fleet, paper

FILES = {"states.parquet", "estimates.parquet", "summary.json", "figure.png"}


def recorded(scenario):
    return record(scenario.build(law=make_law(scenario.law)).reset(0), 0.1, 0.01)


@pytest.mark.parametrize("make", [paper, mixed_fleet])
@pytest.mark.parametrize("value", [np.nan, np.inf, 1e300, -1e38])
def test_states_that_are_not_finite_or_absurd_are_written_and_drawn(make, value, tmp_path):
    scenario = make()
    recording = recorded(scenario)
    x, estimate = recording.x.copy(), recording.states.estimate.copy()
    x[5:] = value
    estimate[5:] = value
    broken = replace(recording, x=x, states=replace(recording.states, truth=x, estimate=estimate))
    files = write_run(broken, scenario, {"fine": 1}, tmp_path)
    assert {path.name for path in files.values()} == FILES
    assert all(path.stat().st_size > 0 for path in files.values())


def test_one_file_that_fails_leaves_the_others(tmp_path, monkeypatch):
    scenario = paper()
    recording = recorded(scenario)
    write_run(recording, scenario, {"seed": 1}, tmp_path)

    def broken(*_):
        raise RuntimeError("no ink")

    monkeypatch.setattr(writing, "paper_figure", broken)
    with pytest.raises(RunFileError, match=r"figure\.png \(no ink\)") as caught:
        write_run(recording, scenario, {"seed": 2}, tmp_path)
    assert set(caught.value.written) == {"states", "estimates", "summary"}
    assert json.loads((tmp_path / "summary.json").read_text()) == {"seed": 2}
    assert not (tmp_path / "figure.png").exists()  # a figure of the earlier run could be mistaken for this run's

    monkeypatch.setattr(writing, "states_table", broken)
    with pytest.raises(RunFileError, match=r"states\.parquet.*summary\.json.*figure\.png"):
        write_run(recording, scenario, {"seed": np.nan}, tmp_path)
    assert len(pl.read_parquet(tmp_path / "estimates.parquet")) > 0
    assert {path.name for path in tmp_path.iterdir()} == {"estimates.parquet"}
