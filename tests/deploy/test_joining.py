"""Agents that are killed, frozen, late, or have another clock: no bound is ever false, of anybody."""

import heapq
import math

import numpy as np
import pytest

from khop_env.network import Network
from tests.deploy.running import Team, scenario_of, simulator_of

ROUNDS = 40


@pytest.mark.parametrize("estimator", ["relay", "ppso"])
@pytest.mark.parametrize("seed", range(2))
def test_a_killed_process_comes_back(seed, estimator, tmp_path):
    """Its bounds and everybody else's stay true all the while, and are as before k + 1 rounds after it is back."""
    chosen, network = scenario_of(seed), Network(0.05)
    simulator, fleet = simulator_of(chosen, network, estimator, seed), chosen.fleet
    away, back = 10, 25
    with Team(chosen, simulator, tmp_path, rounds=ROUNDS) as team:
        for step in range(ROUNDS + 1):
            if step == away:
                team.kill(1)
            if step == back:
                team.restart(1)
            team.advance()
        collected = team.collected()
    recording, layout = collected.recording, chosen.design.knowledge
    assert collected.violations == 0
    assert recording.extremes.relative[0] > 0.05  # it isn't for free
    states = recording.states
    of_it = {"by": np.flatnonzero(layout.observer == 1), "of": np.flatnonzero(layout.pair_target == 1)}
    age, bound = states.age, states.bound
    assert np.isinf(bound[away:back, np.isin(layout.column_pair, of_it["by"])]).all()
    assert np.isfinite(bound[back, np.isin(layout.column_pair, of_it["by"])]).all()  # the initial set, grown
    assert (age[back - 1, of_it["of"]] >= 0.05 * (back - away) - 1e-9).all()
    recovered = back + chosen.k + 1
    usual = age[away - 1]
    assert (age[recovered:] <= usual + 1e-9).all()
    assert (age[recovered, of_it["of"]] < 0.3).all()
    rounds = collected.rounds[1]
    assert np.flatnonzero(rounds.away).tolist() == list(range(away, back))
    assert not collected.rounds[0].away.any()
    # while it was away its input was 0, and its plant moved on
    mine = fleet.state_slice(1)
    assert not recording.u[away : back - 1, fleet.input_slice(1)].any()
    assert np.isfinite(recording.x[:, mine]).all()


@pytest.mark.parametrize("estimator", ["relay", "ppso"])
@pytest.mark.parametrize("seed", [1])
def test_a_frozen_process_goes_on(seed, estimator, tmp_path):
    """It holds its input, says nothing, and then takes what has waited for it as what it is: old."""
    chosen, network = scenario_of(seed), Network(0.05, loss=0.2, latency=0.06, jitter=0.05)
    simulator = simulator_of(chosen, network, estimator, seed)
    with Team(chosen, simulator, tmp_path, steps=2, rounds=ROUNDS) as team:
        for step in range(2 * ROUNDS + 1):
            team.frozen = {2} if 20 <= step < 60 else {3} if 64 <= step < 67 else set()
            team.advance()
        collected = team.collected()
        counts = team.agents[2].counts()
    assert collected.violations == 0
    assert np.isnan(collected.rounds[2].began).sum() == 20
    held = collected.recording.u[19:60, chosen.fleet.input_slice(2)]
    assert (held == held[0]).all()
    assert counts["refused"].get("replayed", 0) == 0
    bound = collected.recording.states.bound
    assert np.isfinite(bound[62:64]).all()


@pytest.mark.parametrize("estimator", ["relay", "ppso"])
def test_late_processes_in_any_order(estimator, tmp_path):
    """Each runs its rounds when it gets to them, up to seconds late, and leaves out those that are over by then."""
    rng, rounds = np.random.default_rng(0), 80
    chosen, network = scenario_of(3), Network(0.05, loss=0.3, burst=5, latency=0.03, jitter=0.005)
    now = 0.0
    with Team(chosen, simulator_of(chosen, network, estimator, 0), tmp_path, rounds=rounds) as team:
        waiting = [(0.0, a, 0) for a in range(len(team.agents))]  # heap of (when, in rounds; who; which round at least)
        for agent in team.agents:
            agent.clock = lambda: math.floor(now)
        fresh = set(range(len(team.agents)))
        while waiting:
            now, a, number = heapq.heappop(waiting)
            number = max(number, math.floor(now))
            if number > rounds:
                continue
            agent = team.agents[a]
            agent.catch_up(number - (a not in fresh))
            agent.begin(first=a in fresh)
            agent.end()
            agent.write()
            fresh.discard(a)
            lateness = rng.exponential(0.3 if rng.random() < 0.9 else 5.0)
            heapq.heappush(waiting, (max(now, number + 1 + lateness), a, number + 1))
        team.step = rounds
        collected = team.collected()
        assert not any(agent.counts()["refused"] for agent in team.agents)
    assert collected.violations == 0
    assert sum(np.isnan(each.began).sum() for each in collected.rounds) > 40


@pytest.mark.parametrize("skew", [0.03, 0.4])
@pytest.mark.parametrize("estimator", ["relay", "ppso"])
def test_clocks_that_differ(skew, estimator, tmp_path):
    """Each clock is ahead by another time; ages allow for that, and plants follow their differential equations."""
    for seed in (1,):
        chosen, network = scenario_of(seed), Network(0.05, loss=0.1)
        simulator = simulator_of(chosen, network, estimator, seed)
        folder = tmp_path / f"{seed}"
        folder.mkdir()
        with Team(chosen, simulator, folder, rounds=ROUNDS, skew=skew) as team:
            for step in range(ROUNDS + 1):
                if step == 12:
                    team.kill(0)
                if step == 20:
                    team.restart(0)
                team.advance()
            collected = team.collected()
            assert all(not agent.counts()["refused"] for agent in team.agents)
        assert collected.violations == 0
        assert 0.0 < collected.recording.extremes.relative[0] < 1.0
