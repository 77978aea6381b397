import numpy as np
import polars as pl
import pytest

from agents import make_law
from khop_env.results import estimates_table, record, states_table
from khop_env.scenarios import paper
from khop_env.scenarios.mixed_fleet import mixed_fleet
from tests.strategies import definition_of_m

COLUMNS = ["quantity", "time", "target", "observer", "component"]
COLUMNS += ["state", "estimate", "error", "disagreement", "rho", "delta", "bound"]


@pytest.fixture(scope="module", params=[paper, mixed_fleet])
def recording(request):
    scenario = request.param()
    return record(scenario.build(law=make_law(scenario.law)).reset(1), 0.5, 0.01)


@pytest.fixture(scope="module")
def table(recording):
    return estimates_table(recording)


def test_estimates_columns(table, recording):
    assert table.columns == COLUMNS
    design = recording.design
    assert len(table) == len(recording.time) * (design.states.layout.size + design.inputs.layout.size)
    assert table.null_count().sum_horizontal().item() == 0
    numbers = table.select(pl.col(pl.Float64))
    assert numbers.width == 8
    assert np.isfinite(numbers.to_numpy()).all()
    assert table.select(COLUMNS[:5]).is_unique().all()


def test_each_estimate_stands_beside_its_own_truth(table, recording):
    """Every row agrees with the layout's slots and the fleet's names, independent of the table's order."""
    design, fleet = recording.design, recording.fleet
    rng = np.random.default_rng(0)
    for quantity, kind, funnels in (
        ("state", recording.states, design.states),
        ("input", recording.inputs, design.inputs),
    ):
        rows = table.filter(pl.col("quantity") == quantity)
        for row in rows.sample(40, seed=int(rng.integers(1000))).iter_rows(named=True):
            target, observer = fleet.agent(row["target"]), fleet.agent(row["observer"])
            component = list(fleet.models[target].states).index(row["component"])
            sample = int(np.flatnonzero(recording.time == row["time"])[0])
            column = funnels.layout.slot[observer, target] + component
            truth = kind.truth[sample, fleet.state_offset[target] + component]
            funnel = funnels.rho.functions[funnels.layout.column_row[column]]
            bound = funnels.bounds[funnels.layout.column_row[column]]
            assert row["state"] == truth
            assert row["estimate"] == kind.estimate[sample, column]
            assert row["error"] == row["estimate"] - row["state"]
            assert row["disagreement"] == kind.disagreement[sample, column]
            assert row["rho"] == pytest.approx(float(funnel(row["time"])), rel=1e-12)
            assert row["delta"] == pytest.approx(float(bound(row["time"])), rel=1e-12)
            members = list(design.neighborhoods[target])
            m = definition_of_m(design.communication, members, target, design.relay)
            own = np.linalg.inv(m).sum(axis=1)[members.index(observer)] * float(funnel(row["time"]))
            assert row["bound"] == pytest.approx(own, rel=1e-12)
            assert row["bound"] <= row["delta"]
            assert abs(row["error"]) < row["bound"]


def test_the_guarantee_can_be_read_off_the_table(table):
    assert table.select((pl.col("disagreement").abs() < pl.col("rho")).all()).item()
    assert table.select((pl.col("error").abs() < pl.col("delta")).all()).item()


def test_disagreement_is_the_papers_neighbour_sum(table, recording):
    """xi = sum over neighbours in the k-hop set of (own - other) + h (own - truth), from the table's estimates."""
    design, fleet = recording.design, recording.fleet
    last = table.filter(pl.col("quantity") == "state", pl.col("time") == pl.col("time").max())
    target = fleet.ids[int(design.states.layout.target[0])]
    i = fleet.agent(target)
    component = next(iter(fleet.models[i].states))
    rows = last.filter(pl.col("target").cast(pl.String) == target, pl.col("component").cast(pl.String) == component)
    values = {fleet.agent(row["observer"]): row for row in rows.iter_rows(named=True)}
    graph = design.communication
    for a, row in values.items():
        xi = sum(row["estimate"] - values[b]["estimate"] for b in graph[a] if b in values)
        xi += len(set(graph[a]) & set(graph[i])) * row["error"]
        assert row["disagreement"] == pytest.approx(xi, abs=1e-12)


def test_states_columns(recording):
    table, fleet = states_table(recording), recording.fleet
    assert table.columns == ["time", "agent", "component", "x", "u"]
    assert len(table) == len(recording.time) * (fleet.n + fleet.m)
    assert table.select(pl.col("x").is_null() ^ pl.col("u").is_null()).to_series().all()
    assert table.select("time", "agent", "component").is_unique().all()


def test_states_are_the_recordings(recording):
    table, fleet = states_table(recording), recording.fleet
    for index, (agent, name, _) in enumerate(fleet.component_names()):
        rows = table.filter(pl.col("agent").cast(pl.String) == agent, pl.col("component").cast(pl.String) == name)
        assert rows["time"].to_list() == recording.time.tolist()
        assert rows["x"].to_list() == recording.x[:, index].tolist()
    for index, (agent, name, _) in enumerate(fleet.input_names()):
        rows = table.filter(pl.col("agent").cast(pl.String) == agent, pl.col("component").cast(pl.String) == name)
        assert rows["u"].to_list() == recording.u[:, index].tolist()


def test_without_input_observers_there_are_no_input_rows():
    from khop_env.observers import TargetObservers

    scenario = paper().replace(observers=(TargetObservers(input_observer=False),) * 8, theta=None)
    recording = record(scenario.build(law=make_law(scenario.law)).reset(0), 0.05, 0.01)
    assert estimates_table(recording)["quantity"].unique().to_list() == ["state"]
