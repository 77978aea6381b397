"""Collisions, arrivals and deadlocks of episodes, against loops over a ParallelEnv; several networks in one table."""

import json
import math

import numpy as np
import pytest
from scipy.stats import binomtest
from typer.testing import CliRunner

from agents import compare, describe, interval95, make_policy, play
from agents.comparison import CHUNK
from agents.outcomes import summary, wilson95
from agents.policy import policy_seeds
from agents.running import PolicyRun, policy_run
from khop_env import make_batched, navigation_v0
from khop_env.cli import app
from khop_env.network import Network
from khop_env.registry import scenario


class Slowed:
    """Towards the goal at a third of the speed, by something that changes what another policy wants, and isn't sure."""

    def __init__(self):
        self._policy, self.intervention, self.infeasible = make_policy("go_to_goal"), {}, {}

    def reset(self, env, seeds):
        self._policy.reset(env, seeds)

    def act(self, observations):
        wanted = self._policy.act(observations)
        actions = {agent: action / np.float32(3.0) for agent, action in wanted.items()}
        self.intervention = {agent: np.linalg.norm(wanted[agent] - actions[agent], axis=-1) for agent in wanted}
        self.infeasible = {agent: wanted[agent][..., 0] > 0.5 for agent in wanted}
        return actions


@pytest.mark.parametrize(("name", "make"), [("crossing:agents=4", Slowed), ("swap:agents=4", Slowed)])
def test_outcomes_measured_by_hand(name, make):
    """Every number, of episodes that collide and of some that don't."""
    arguments = {"max_cycles": 120, "bonus": 0.0}
    found = play(make_batched("navigation_v0", name, num_envs=3, **arguments), make(), range(8)).outcomes
    env = navigation_v0.parallel_env(name, **arguments)
    for seed in range(8):
        policy = make()
        policy.reset(describe(env), policy_seeds([seed]))
        observations, _ = env.reset(seed=seed)
        first, distance, cost, changed, unsure, cycle = {}, math.inf, 0.0, [], [], 0
        while env.agents:
            actions = policy.act(observations)
            changed.append(np.mean(list(policy.intervention.values())))
            unsure.append(np.mean(list(policy.infeasible.values())))
            observations, _, _, _, infos = env.step(actions)
            cycle += 1
            distance = min([distance, *(info["min_distance"] for info in infos.values())])
            cost += sum(info["cost"] for info in infos.values())
            for agent, info in infos.items():
                if info["arrived"]:
                    first.setdefault(agent, 0.05 * cycle)
        there = all(info["arrived"] for info in infos.values())
        assert found["collision"][seed] == (cost > 0.0)
        assert found["success"][seed] == (there and cost == 0.0)
        assert found["min_distance"][seed] == pytest.approx(distance, rel=1e-12)
        assert found["intervention"][seed] == pytest.approx(np.mean(changed), rel=1e-6)
        assert found["infeasible"][seed] == pytest.approx(np.mean(unsure), rel=1e-6)
        expected = np.mean(list(first.values())) if there else math.nan
        np.testing.assert_allclose(found["arrival_time"][seed], expected)
        assert found["deadlock"][seed] == 0.0
    assert found["collision"].any()
    assert 0.0 < found["infeasible"].max() < 1.0
    assert name.startswith("swap") or found["success"].any()


def test_who_does_not_move_is_in_a_deadlock_and_who_is_slow_is_not():
    still = make_batched("navigation_v0", "crossing:disturbance=0", num_envs=4, max_cycles=60)
    assert play(still, make_policy("zero"), range(4)).outcomes["deadlock"].tolist() == [1.0] * 4
    assert play(still, make_policy("random"), range(4)).outcomes["deadlock"].tolist() == [0.0] * 4
    short = make_batched("navigation_v0", "crossing:disturbance=0", num_envs=4, max_cycles=30)  # too short to tell
    assert play(short, make_policy("zero"), range(4)).outcomes["deadlock"].tolist() == [0.0] * 4


def test_rates_and_times_of_a_row():
    """Means over episodes; times over those that succeed; nothing in environments without collisions."""
    table = compare("navigation_v0", ["go_to_goal", "zero"], scenario="crossing:agents=4", seeds=range(30))
    row, idle = (each.summary() for each in table.rows)
    outcomes = table.rows[0].episodes.outcomes
    assert 0.0 < row["collision_rate"] == outcomes["collision"].mean() < 1.0
    assert row["success_rate"] == outcomes["success"].mean() == pytest.approx(1.0 - row["collision_rate"])
    assert row["arrival_time"] == outcomes["arrival_time"][outcomes["success"] == 1.0].mean()
    assert row["min_distance"] == outcomes["min_distance"].min() < 0.4
    assert (row["intervention"], row["infeasible"]) == (None, None)
    assert idle["arrival_time"] is None
    half = interval95(outcomes["arrival_time"][outcomes["success"] == 1.0])
    assert row["arrival_time_ci95"] == half > 0.0
    assert (row["intervention_ci95"], idle["arrival_time_ci95"]) == (None, None)
    changed = play(make_batched("navigation_v0", "crossing:agents=4"), Slowed(), range(3)).outcomes
    assert summary(changed)["intervention_ci95"] == interval95(changed["intervention"]) > 0.0
    assert table.frame()["collision"].sum() == outcomes["collision"].sum()
    assert compare("consensus_v0", ["zero"], seeds=range(2)).rows[0].episodes.outcomes == {}


@pytest.mark.parametrize(("ones", "count"), [(0, 200), (3, 40), (100, 100), (20, 60)])
def test_intervals_are_wilson_s(ones, count):
    low, high = wilson95([1.0] * ones + [0.0] * (count - ones))
    expected = binomtest(ones, count).proportion_ci(method="wilson")
    assert (low, high) == pytest.approx((expected.low, expected.high), abs=1e-12)


def test_several_networks_in_one_table():
    """The same rows as one at a time; networks are in the labels, in JSON and in the frame."""
    arguments = {"arguments": {"max_cycles": 30}, "seeds": range(3)}
    networks = ["ideal", "lossy:loss=0.5,burst=4"]
    table = compare("consensus_v0", ["tanh", "zero"], networks=networks, **arguments)
    assert [row.network for row in table.rows] == networks * 2
    assert table.rows[1].label == "tanh on estimate over lossy:loss=0.5,burst=4"
    assert table.frame()["network"].to_list() == [name for name in networks * 2 for _ in range(3)]
    for number, network in enumerate(networks):
        alone = compare("consensus_v0", ["tanh"], arguments={"max_cycles": 30, "network": network}, seeds=range(3))
        np.testing.assert_array_equal(table.rows[number].episodes.returns, alone.rows[0].episodes.returns)
        assert alone.rows[0].summary()["network"] == network
        assert alone.rows[0].label == "tanh on estimate"
        assert "network" not in alone.frame().columns
    with pytest.raises(ValueError, match="networks must be names, and arguments without a network then"):
        compare("consensus_v0", ["tanh"], networks=networks, arguments={"network": "wifi"})


def test_what_episodes_drew_is_in_the_frame():
    """By seed, whatever plays; null where the network has no range of it."""
    networks, seeds = ["ideal", "random", "wifi:loss=0..0.3"], range(CHUNK + 3)
    arguments = {"max_cycles": 2}
    table = compare("consensus_v0", ["tanh", "zero"], networks=networks, seeds=seeds, arguments=arguments).frame()
    names = [name for name in table.columns if name.startswith("drawn_")]
    assert names == ["drawn_loss", "drawn_latency", "drawn_burst", "drawn_jitter"]
    for network, drawn in (("ideal", []), ("random", names), ("wifi:loss=0..0.3", names[:1])):
        tanh, zero = (table.filter(network=network, policy=policy).select(names) for policy in ("tanh", "zero"))
        assert tanh.equals(zero)
        assert [name for name in names if not tanh[name].null_count()] == drawn
        env = make_batched("consensus_v0", network=network, num_envs=len(seeds))
        env.reset(seed=list(seeds))
        for name in drawn:
            values = [getattr(each, name[6:]) for each in env.simulator.observers.drawn(env.simulator.state)]
            assert tanh[name].to_list() == values
            assert len(set(values)) == len(seeds)
    assert not any("drawn" in name for name in compare("consensus_v0", ["zero"], seeds=[0]).frame().columns)


def test_rows_name_their_network_wherever_it_comes_from():
    """Of the arguments, or the scenario's own in words; none for continuous exchange."""

    def network(scenario, **arguments):
        table = compare(
            "navigation_v0", ["zero"], scenario=scenario, seeds=[0], arguments={"max_cycles": 2, **arguments}
        )
        return table.rows[0].summary()["network"]

    assert network("crossing") == "a message every 50 ms, 30 % lost in bursts of 5"
    assert network("crossing", network=Network()) == "a message every 50 ms, none lost"
    assert network("crossing", network="none") is None
    assert network("crossing:continuous=true") is None


def test_the_command_prints_rates_and_networks():
    def khop(*words):
        fixed = ["evaluate", "navigation_v0", "--episodes", "2", "--observe", "estimate"]
        return CliRunner().invoke(app, [*fixed, *words])

    result = khop("--network", "ideal,lossy:loss=0.3,burst=5", "--json", "--env", "max_cycles=20")
    rows = json.loads(result.stdout)["rows"]
    assert [(row["policy"], row["network"]) for row in rows] == [
        (policy, network)
        for policy in ("go_to_goal", "zero", "random")
        for network in ("ideal", "lossy:loss=0.3,burst=5")
    ]
    measured = {"collision_rate", "success_rate", "arrival_time", "min_distance", "deadlock_rate", "intervention"}
    assert measured | {"infeasible"} < set(rows[0])
    alone = json.loads(khop("--network", "ideal", "--json", "--env", "max_cycles=20").stdout)["rows"]
    assert [row["network"] for row in alone] == ["ideal"] * 3
    both = khop("--policies", "zero,random", "--network", "ideal,wifi", "--env", "max_cycles=20").stdout
    lines = [" ".join(line.split()[:2]) for line in both.splitlines()]
    named = [line for line in lines if line in ("over ideal", "over wifi", "zero on", "random on")]
    assert named == ["over ideal", "zero on", "random on", "over wifi", "zero on", "random on"]
    table = khop("--policies", "zero", "--env", "max_cycles=20").stdout
    assert "navigation_v0 on crossing over a network (a message every 50 ms" in table
    assert "collided" in table
    assert "deadlock" in table
    refused = khop("--network", "ideal", "--env", "network=wifi")
    assert refused.exit_code == 2
    assert "--env network and --network: choose one of them" in refused.output
    assert "infeasible" not in table  # without a filter, or if it never was
    unsure = khop("--policies", f"zero,{__file__}:Slowed", "--env", "max_cycles=20").stdout
    assert "infeasible: share of agents and time" in " ".join(unsure.split())
    assert unsure.count("infeasible") == 2  # in the header, too


def test_a_run_has_the_outcomes_of_an_evaluation():
    """Of the same episode, to the end."""
    chosen = scenario("swap:agents=4")
    env = make_batched("navigation_v0", chosen)
    for spec in ("filter:margin=none", "go_to_goal"):
        expected = play(env, make_policy(spec), [3]).outcomes
        run = policy_run(spec, chosen, "estimate", None, 3, environment="navigation_v0")
        while not run.ended():
            run.step(0.05)
        assert set(run.outcomes) == set(expected)
        for name, value in run.outcomes.items():
            np.testing.assert_array_equal(value, expected[name], name)
    assert policy_run("zero", scenario("paper"), "estimate", 0.1, 0).outcomes == {}


@pytest.mark.parametrize(("change", "length"), [(0.5, 0.25), (50.0, 0.75)])
def test_arrows_in_frames_point_along_corrections(change, length):
    """As far as they lead in half a second, and never across the picture."""
    run = PolicyRun(navigation_v0.parallel_env("swap:agents=4"), Slowed(), 0)
    assert run.env.batched.world.arrows is None
    run.policy.correction = {agent: change * np.array([0.6, -0.8]) for agent in run.env.possible_agents}
    run.step(0.05)
    np.testing.assert_allclose(run.env.batched.world.arrows[..., 0], length * np.tile([0.6, -0.8], (4, 1)))
    assert run.env.batched.world.marked.shape == (4, 1)
