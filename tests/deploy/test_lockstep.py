"""Agents that know of each other by datagrams alone equal the simulator under the same network, message by message."""

import json

import numpy as np
import polars as pl
import pytest

from khop_env.network import Network
from khop_env.observers.networked import missed_rounds
from tests.deploy.running import NO_ZENOH, Team, scenario_of, simulator_of
from tests.test_cli import khop, refused


def network_of(seed: int) -> Network:
    rng = np.random.default_rng([seed, 1])
    jitter = float(rng.uniform(0.0, 0.04))
    return Network(
        period=0.04,
        loss=float(rng.uniform(0.05, 0.4)),
        burst=(2.0, 4.0) if rng.random() < 0.5 else None,
        latency=(jitter, jitter + 0.05),
        jitter=(jitter / 2.0, jitter),
        noise=0.01 if rng.random() < 0.5 else 0.0,
    )


@pytest.mark.parametrize("estimator", ["relay", "ppso"])
@pytest.mark.parametrize("seed", range(5))
def test_lockstep_equals_the_simulator(seed, estimator, tmp_path):
    """Estimates, bounds, ages, inputs, states, and what was lost: to rounding."""
    chosen, network, steps, rounds = scenario_of(seed), network_of(seed), 2, 16
    simulator = simulator_of(chosen, network, estimator, seed)
    h, expected = network.period / steps, []

    def sample():
        observers, state = simulator.observers, simulator.state
        values = simulator.x[0], simulator.u[0], simulator.estimates[0], simulator.error_bounds().bound[:, 0]
        of_messages = observers.information(state).age[:, 0], missed_rounds(observers, state)[:, 0]
        return [each.copy() for each in (*values, *of_messages)]

    with Team(chosen, simulator, tmp_path, steps=steps, rounds=rounds) as team:
        for step in range(rounds * steps + 1):
            team.advance(in_step=True)
            if step:
                simulator.step(round(step * h, 12) - float(simulator.t[0]))
            expected.append(sample())
        counts = [agent.counts() for agent in team.agents]
    recording = team.collected().recording
    states = recording.states
    found = recording.x, recording.u, states.estimate, states.bound, states.age, states.missed
    for values, wanted in zip(found, map(np.array, zip(*expected, strict=True)), strict=True):
        np.testing.assert_allclose(values, wanted, rtol=1e-12, atol=1e-12)
    links = len(chosen.design.links)
    assert sum(count["sent"] for count in counts) == sum(count["received"] for count in counts) == (rounds + 1) * links
    assert all(not count["refused"] for count in counts)
    assert 0 < sum(count["lost"] for count in counts) < rounds * links


@pytest.mark.parametrize("transport", ["udp", pytest.param("zenoh", marks=NO_ZENOH)])
def test_processes_in_lockstep_equal_khop_run(transport, tmp_path, monkeypatch):
    """The command against the command, each agent a real process."""
    monkeypatch.chdir(tmp_path)
    (tmp_path / "mine.py").write_text(
        "import sys\nfrom khop_env.registry import scenario\n"
        "if sys.argv[0].endswith('agent.py'):\n    print('a process that says what nobody asked for')\n"
        "mine = scenario('random_geometric:agents=4,k=2')\n"
    )
    name = "mine.py:mine"
    options = ("--duration", "0.8", "--network", "lossy:loss=0.3,burst=3", "--dt", "0.05")
    how = ("--lockstep", "--transport", transport, "--json", "--out", "a")
    deployed = json.loads(khop("deploy", name, *how, *options).stdout)
    khop("run", name, *options, "--out", "b")
    for table in ("states", "estimates"):
        found, wanted = (pl.read_parquet(tmp_path / folder / f"{table}.parquet") for folder in "ab")
        assert found.columns == wanted.columns
        for column in found.columns:
            if found[column].dtype == pl.Float64:
                values = (frame[column].fill_null(0.0).to_numpy() for frame in (found, wanted))
                np.testing.assert_allclose(*values, rtol=1e-12, atol=1e-12)
            else:
                assert found[column].equals(wanted[column])
    assert sorted(path.name for path in (tmp_path / "a").iterdir()) == [
        "estimates.parquet",
        "figure.png",
        "states.parquet",
        "summary.json",
    ]
    assert deployed["violations"] == 0
    measured = deployed["deploy"]
    assert measured["messages"]["lost"] > 0
    assert measured["period_kept"] is None
    assert measured["cpu_us_per_round"] > 0.0


@pytest.mark.parametrize(
    ("options", "message"),
    [
        (("paper", "--network", "none"), "know of each other by messages only"),
        (("paper", "--lockstep", "--skew", "0.1"), "--lockstep waits for all agents"),
        (("paper", "--kill", "drifter_9@1"), "no agent 'drifter_9'"),
        (("paper", "--kill", "drifter_1"), "write AGENT@T or AGENT@T:RESTART_T"),
        (("paper", "--kill", "drifter_1@3:2"), "times must be in order"),
        (("paper", "--kill", "drifter_1@3000"), "before the end, 10 s"),
        (("paper", "--skew", "inf"), "--skew must be a number of seconds; got inf"),
        (("paper", "--estimator", "ppsi"), "did you mean 'ppso'"),
        (("paper", "--dt", "0.03"), "must be a whole number of steps"),
    ],
)
def test_mistakes_are_said(options, message):
    assert message in " ".join(refused("deploy", *options).split())
