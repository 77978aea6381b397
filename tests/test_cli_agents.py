"""`khop evaluate`, `iss` and `tune`, as their users call them."""

import csv
import io
import json

import pytest
from typer.testing import CliRunner

from khop_env.cli import app
from khop_env.observers import DesignError
from khop_env.scenarios import Scenario


def khop(*arguments: str, status: int = 0):
    result = CliRunner().invoke(app, list(arguments))
    assert result.exit_code == status, (result.stdout, result.stderr, result.exception)
    return result


def test_evaluate_prints_json():
    result = khop(
        *("evaluate", "leader_following_v0", "--scenario", "paper", "--policies", "tanh,zero"),
        *("--observe", "estimate,local", "--episodes", "3", "--json"),
    )
    found = json.loads(result.stdout)
    assert list(found) == [
        *("environment", "scenario", "episodes", "network", "estimator", "task_error_unit", "rows"),
    ]
    assert (found["environment"], found["scenario"], found["episodes"]) == ("leader_following_v0", "paper", 3)
    keys = ["policy", "observe", "mean_return", "ci95", "final_task_error", "settling_time", "effort"]
    keys += ["max_normalized_disagreement", "max_error_to_bound"]
    assert [list(row) for row in found["rows"]] == [keys] * 4
    assert [(row["policy"], row["observe"]) for row in found["rows"]] == [
        ("tanh", "estimate"),
        ("tanh", "local"),
        ("zero", "estimate"),
        ("zero", "local"),
    ]
    assert found["rows"][3]["settling_time"] is None
    assert result.stderr == ""


def test_evaluate_prints_a_table_and_draws(tmp_path):
    figure = tmp_path / "new" / "errors.png"
    result = khop("evaluate", "consensus_v0", "--policies", "tanh,random", "--episodes", "2", "--figure", str(figure))
    assert "consensus_v0 on paper, 2 episodes" in result.stdout
    assert result.stdout.count("random") == 3
    assert "±" in result.stdout
    assert figure.read_bytes().startswith(b"\x89PNG")
    assert f"figure: {figure}" in result.stderr


def test_evaluate_prints_csv():
    result = khop("evaluate", "formation_v0", "--policies", "linear", "--observe", "local", "--episodes", "2", "--csv")
    rows = list(csv.DictReader(io.StringIO(result.stdout)))
    assert [row["seed"] for row in rows] == ["0", "1"]
    assert float(rows[0]["return"]) < 0.0


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("consensus",), "no environment 'consensus'; did you mean 'consensus_v0'?"),
        (("consensus_v0", "--scenario", "papr"), "no scenario 'papr'; did you mean 'paper'?"),
        (("consensus_v0", "--policies", "thanh"), "no policy 'thanh'; did you mean 'tanh'?"),
        (("consensus_v0", "--policies", ","), "name at least one policy"),
        (("consensus_v0", "--policies", "zero,zero"), "--policies names 'zero' twice"),
        (("consensus_v0", "--observe", "truth"), "observe must be one of estimate, oracle, local; got 'truth'"),
        (("consensus_v0", "--csv", "--json"), "choose one of them"),
        (("consensus_v0", "--observe", ","), "expected at least one policy and one observation mode"),
        (("consensus_v0", "--figure", "errors"), "--figure errors: a figure's name ends in .png, .pdf or .svg"),
    ],
)
def test_evaluate_refuses(arguments, said):
    assert said in khop("evaluate", *arguments, status=2).stderr


def test_iss(tmp_path):
    result = khop("iss", "paper", "--episodes", "2", "--duration", "4", "--out", str(tmp_path), "--json")
    found = json.loads(result.stdout)
    assert found["holds"] is True
    assert {row["observers"] for row in found["swept"]} == {"as designed", "bare"}
    assert all((tmp_path / name).exists() for name in ("figure.png", "injected.csv", "swept.csv", "summary.json"))
    slopes = {(row["observers"], row["disturbed"]): row["slope"] for row in found["slopes"]}
    assert slopes["bare", True] > 1.5
    other = "iss", "paper", "--episodes", "1", "--duration", "1", "--out"
    said = khop(*other, str(tmp_path), status=2).stderr
    assert "another run is there (episodes is 2 there and 1 here; duration is 4.0 there and 1.0 here;" in said
    table = " ".join(khop(*other, str(tmp_path / "other")).stdout.split())
    assert "analytical gain: for distances up to 0.656 m; it says something of" in table
    assert "and none exceeds it" in table
    assert "slope of log excess with disturbance" in table


@pytest.mark.parametrize(
    ("error", "status", "said"),
    [
        (KeyboardInterrupt(), 130, "khop: interrupted; above are the rows"),
        (DesignError("it can't be"), 2, "khop: delta(inf) x 10: it can't be; above are the rows"),
        (ValueError("no such bounds"), 2, "khop: no such bounds; above are the rows"),
    ],
    ids=["interrupted", "designed", "bounds"],
)
def test_injected_rows_are_kept_when_the_sweep_can_t_begin(monkeypatch, tmp_path, error, status, said):
    def fail(*_):
        raise error

    if isinstance(error, DesignError):
        original = Scenario.build
        monkeypatch.setattr(Scenario, "build", lambda self, **named: original(self, **named) if named else fail())
    else:
        monkeypatch.setattr("agents.set_iss.with_final_bounds", fail)
    arguments = "iss", "paper", "--episodes", "1", "--duration", "0.2", "--out", str(tmp_path), "--json"
    result = khop(*arguments, status=status)
    assert said in result.stderr
    assert len(json.loads(result.stdout)["injected"]) == 21
    assert (tmp_path / "injected.csv").exists()


def test_tune():
    result = khop("tune", "consensus_v0", "--policies", "tanh", "--observe", "estimate")
    assert result.stdout.startswith("# Found by khop tune consensus_v0, on 64 episodes")
    assert '[consensus_v0."paper".tanh]\nestimate = { gain = ' in result.stdout
    assert "tanh on estimate: -" in result.stderr
    over = "--observe", "estimate", "--env", "network=wifi", "--env", "max_cycles=10"
    result = khop("tune", "consensus_v0", "--policies", "tanh", *over)
    assert '[consensus_v0."paper".tanh]\nnetwork = { gain = ' in result.stdout
    assert "tanh on estimate over a network: -" in result.stderr
    assert "name one environment" in khop("tune", status=2).stderr
    assert "no law 'tan'" in khop("tune", "consensus_v0", "--policies", "tan", status=2).stderr


def test_tune_margins():
    """By collisions; a law's options stay with it."""
    chosen = "navigation_v0", "--scenario", "crossing:agents=4,burst=1", "--observe", "oracle"
    result = khop("tune", *chosen, "--policies", "filter:margin=none,gamma=0.5,orca:horizon=1")
    assert (
        '"filter:margin=none,gamma=0.5"]\noracle = { margin = 0.0 }  # 0 of 64 collided, 64 succeeded' in result.stdout
    )
    assert '"orca:horizon=1"]\noracle = { margin = ' in result.stdout
    assert "policy 'filter' has no margin to tune" in khop("tune", *chosen, "--policies", "filter", status=2).stderr
    assert "no law 'filte'; did you mean 'filter'" in khop("tune", *chosen, "--policies", "filte", status=2).stderr
