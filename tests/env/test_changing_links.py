"""Links that come and go, without a network: a neighbour whose link is down isn't observed."""

import copy
from functools import partial

import networkx as nx
import numpy as np
import pytest

from agents import LawPolicy
from agents.policy import describe
from khop_env import consensus_v0, formation_v0
from khop_env.env import batched
from khop_env.network import Fixed, Outage, RandomLinks, Range, Switching
from khop_env.testing import CHECKS, check_environment
from khop_env.testing.leaks import changed_by
from tests.env.playing import built, play

SCENARIOS = ("paper", "mixed_fleet")


def changing(name, probability=0.6, **arguments):
    scenario = built(name).replace(schedule=RandomLinks(probability, both_ways=False))
    return consensus_v0.parallel_env(scenario, **arguments)


@pytest.mark.parametrize("observe", ["estimate", "local", "oracle"])
@pytest.mark.parametrize("name", SCENARIOS)
def test_a_neighbour_is_observed_while_its_link_is_up(name, observe):
    """Its slot is valid then, and as without a schedule; otherwise its state is zeros."""
    env, fixed = changing(name, observe=observe), consensus_v0.parallel_env(built(name), observe=observe)
    seen = set()
    for seed in range(3):
        env.reset(seed=seed)
        play(env, 2)
        fixed.reset(seed=seed)
        saved, state = fixed.get_state(), env.get_state()
        saved.simulator.x[...] = state.simulator.x
        fixed.set_state(saved)
        simulator = env.batched.simulator
        up, links = simulator.observers.links_up(simulator.state)[:, 0], simulator.design.links
        for agent in env.possible_agents:
            i, layout = env.batched.fleet.agent(agent), env.layout(agent)
            assert layout.names == fixed.layout(agent).names
            found, usual = (layout.read(each.observe(agent)) for each in (env, fixed))
            for number, slot in enumerate(layout.slots):
                if not slot.heard:
                    continue
                there = bool(up[links.index[slot.agent, i]]) or observe == "oracle"
                seen.add(there)
                state = [key for key in layout.names if key.startswith(f"slot{number}.")]
                for key in (
                    key for key in state if not any(part in key for part in ("hops", "task_edge", "type", "displac"))
                ):
                    assert found[key] == (usual[key] if there else 0.0), key
    assert seen == ({True} if observe == "oracle" else {True, False})


@pytest.mark.parametrize("observe", ["estimate", "local"])
@pytest.mark.parametrize("name", SCENARIOS)
def test_a_state_reaches_those_whose_link_is_up(name, observe):
    """And nobody else, at that instant."""
    env = changing(name, observe=observe)
    env.reset(seed=5)
    play(env, 3)
    simulator, fleet = env.batched.simulator, env.batched.fleet
    up, links = simulator.observers.links_up(simulator.state)[:, 0].copy(), simulator.design.links
    assert not up.all()
    for j in range(len(fleet)):

        def move(saved, part=fleet.state_slice(j)):  # noqa: B008
            saved.simulator.x[part] += 0.7 + 0.1 * np.arange(saved.simulator.x[part].shape[0])[:, None]

        receivers = links.receiver[up & (links.sender == j)].tolist()
        assert set(changed_by(env, move)) == {j, *receivers}


def test_the_public_checks_pass():
    """All of them; bounds follow from links elsewhere, and the check of leaks says that it leaves them out."""
    report = check_environment(partial(changing, "paper", bounds=True, max_cycles=8), steps=10)
    assert {check.status for check in report.checks} == {"passed"}, str(report)
    assert {check.name for check in report.checks if check.detail} == {"leak"}
    assert report["leak"].detail.startswith("but for guaranteed bounds")


PATH = nx.path_graph(8)
KINDS = {
    "fixed": Fixed(nx.path_graph(7)),
    "switching": Switching((PATH, nx.path_graph(5)), 0.2),
    "random": RandomLinks(0.5),
    "range": Range(1.5),
    "outage": Outage((0.0, 0.1), 0.2),
    "link": Outage(0.1, 0.2, link=(3, 4)),
    "several": RandomLinks(0.8, connected=True) & Range(2.0),
}


@pytest.mark.parametrize("network", [None, "wifi"])
@pytest.mark.parametrize("kind", KINDS)
def test_every_kind_of_schedule_keeps_the_contract(kind, network):
    scenario = built("paper").replace(communication=PATH, task=PATH, schedule=KINDS[kind]).sized()
    make = partial(consensus_v0.parallel_env, scenario, network=network, bounds=True, max_cycles=8)
    report = check_environment(make, steps=6, skip=set(CHECKS) - {"restore", "views", "leak"})
    assert {check.status for check in report.checks} <= {"passed", "skipped"}, str(report)
    assert report["leak"].status == "passed"


@pytest.mark.parametrize("observe", ["estimate", "local"])
def test_without_relays_a_neighbour_is_estimated_while_its_link_is_down(observe):
    """Designs without relays estimate neighbours, too; the bound is 0 while the state itself is received."""
    scenario = built("paper").replace(relay=False).sized().replace(schedule=RandomLinks(0.6, both_ways=False))
    env = consensus_v0.parallel_env(scenario, observe=observe, bounds=True)
    env.reset(seed=3)
    play(env, 2)
    simulator = env.batched.simulator
    estimates, own = simulator.estimates[0], simulator.error_bounds().bound[:, 0]
    up, links = simulator.observers.links_up(simulator.state)[:, 0], simulator.design.links
    seen = set()
    for agent in env.possible_agents:
        i, layout = env.batched.fleet.agent(agent), env.layout(agent)
        values = layout.read(env.observe(agent))
        for number, slot in enumerate(layout.slots):
            there = slot.heard and bool(up[links.index[slot.agent, i]])
            known = there or observe == "estimate"
            part, first = simulator.fleet.state_slice(slot.agent), simulator.observers.layout.slot[i, slot.agent]
            where = simulator.x[0, part] if there else estimates[first : first + 2]
            bound = np.zeros(2) if there or observe == "local" else own[first : first + 2]
            seen.add((slot.heard, there))
            assert values[f"slot{number}.valid"] == (known and (slot.heard or observe == "estimate"))
            assert values[f"slot{number}.heard"] == there
            for c, axis in enumerate("xy"):
                expected = where[c] - simulator.x[0, simulator.fleet.state_slice(i)][c] if known else 0.0
                assert values[f"slot{number}.position.{axis}"] == np.float32(expected)
                shown = np.float32(min(bound[c], layout.fields[layout.index(f"slot{number}.bound.x{c + 1}")].high))
                assert values[f"slot{number}.bound.x{c + 1}"] == shown
    assert seen == {(True, True), (True, False), (False, False)}


@pytest.mark.parametrize("relay", [True, False])
@pytest.mark.parametrize("observe", ["estimate", "local", "oracle"])
def test_a_law_knows_a_neighbour_while_its_link_is_up(observe, relay):
    """At every stage of a step; meanwhile it has the estimate, if there is any, or nothing."""
    seen = set()

    def law(t, view):
        if simulator is None:  # its first reset
            return np.zeros((2, 16))
        state, slot = simulator.plant.now, simulator.observers.layout.slot
        assert np.array_equal(t, state.t)
        assert np.array_equal(view.x.T, state.x)
        up, estimate = simulator.observers.links_up(state), state.memory["estimate"]
        for e, (i, j) in enumerate(view.edges.tolist()):
            link = simulator.design.links.index.get((j, i))
            for b in range(2):
                true, own = (state.x[fleet.state_slice(a), b] for a in (j, i))
                received = observe == "oracle" or (link is not None and bool(up[link, b]))
                estimated = observe == "estimate" and (i, j) in slot
                seen.add((received, estimated))
                assert view.known[b, e] == (received or estimated)
                first = slot.get((i, j), 0)
                where = true if received else estimate[first : first + 2, b] if estimated else own
                assert np.array_equal(view.displacement[b, e], where - own)
        return np.zeros((2, 16))

    scenario = built("paper").replace(relay=relay, task=built("paper").communication)
    scenario = (scenario if relay else scenario.sized()).replace(schedule=RandomLinks(0.5) & Range(1.5))
    simulator, fleet = None, scenario.fleet
    simulator = followed(scenario.build(law=law, observe=observe, num_envs=2))
    simulator.reset(seed=1)
    for _ in range(3):
        simulator.step(0.02)
    simulator = followed(copy.deepcopy(simulator))
    simulator.reset(seed=7)
    simulator.step(0.02)
    assert len(seen) == (1 if observe == "oracle" else 2), seen


def followed(simulator):
    """A simulator whose plant keeps the state that its law is evaluated at."""
    actuate = type(simulator.plant).actuate

    def kept(state):
        simulator.plant.now = state
        actuate(simulator.plant, state)

    simulator.plant.actuate = kept
    return simulator


@pytest.mark.parametrize("law", ["tanh", "linear", "formation"])
def test_nothing_pulls_an_agent_that_knows_nobody(law):
    """Zeros in a slot that isn't valid are no position."""
    scenario = built("paper").replace(schedule=Fixed(nx.empty_graph(8)))
    env = formation_v0.parallel_env(scenario, observe="local")
    observations, _ = env.reset(seed=0)
    policy = LawPolicy(law, {} if law == "tanh" else {"cancel_drift": False})
    policy.reset(describe(env), [0])
    for action in policy.act(observations).values():
        assert not action.any()


def test_no_bound_is_the_largest_value_and_not_clipped():
    """Counts of clipped entries are for values that are too large, not for those that aren't there."""
    scenario = built("paper").replace(schedule=Outage(0.1, 1.0, agent=0))
    env = consensus_v0.parallel_env(scenario, bounds=True)
    env.reset(seed=0)
    unbounded = 0
    for _, _, _, _, infos in play(env, 4):
        assert not any(info["clipped_observations"] for info in infos.values())
        layout = env.layout("drifter_0")
        bounds = [q for q, name in enumerate(layout.names) if ".bound.x" in name]
        unbounded += np.sum(env.observe("drifter_0")[bounds] == layout.high[bounds])
    assert unbounded > 0


def test_each_copy_has_its_own_graph():
    """Drawn at each reset: the same alone as in a batch."""
    scenario = built("paper").replace(schedule=RandomLinks(0.5))
    team = consensus_v0.batched_env(scenario, num_envs=16)
    observations, _ = team.reset(seed=0)
    alone = consensus_v0.batched_env(scenario, num_envs=1)
    graphs = set()
    for b in range(16):
        heard = [
            float(layout.read(row)[f"slot{number}.heard"])
            for layout, row in zip(team.layouts, observations[b], strict=True)
            for number, slot in enumerate(layout.slots)
            if slot.heard
        ]
        assert 0.0 < sum(heard) < len(heard)
        graphs.add(tuple(heard))
        if b < 3:
            assert np.array_equal(alone.reset(seed=b)[0][0], observations[b])
    assert len(graphs) > 12  # of 128


LEAKY = partial(changing, "paper", max_cycles=8)


def test_a_neighbour_that_is_observed_all_the_time_is_a_leak(monkeypatch):
    monkeypatch.setattr(batched, "links_up", lambda design, *rest: np.ones((len(design.links), 1), bool))
    report = check_environment(LEAKY, steps=10, skip=set(CHECKS) - {"leak"})
    assert report["leak"].status == "failed"
    assert "changes the observation of" in report["leak"].detail
