"""Observers on graphs whose links come and go: docs/theory/graphs.md, section 3."""

import copy
import dataclasses
import pickle

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from khop_env import consensus_v0
from khop_env.network import Fixed, Outage, RandomLinks, Range, Switching
from khop_env.observers import (
    BatchedRightHandSide,
    Explicit,
    Exponential,
    FunnelError,
    MessagePassing,
    ObserverDesign,
    Proximal,
)
from khop_env.observers.funnel_observers import LinksNow
from khop_env.physics import Fleet, SingleIntegrator, SurfaceVessel
from khop_env.registry import scenario
from khop_env.results import design_report
from khop_env.scenarios.files import ScenarioFileError, read_scenario, write_scenario
from khop_env.simulation import InitialSet, Simulator
from khop_env.testing import check_environment
from tests.strategies import (
    SmoothSignals,
    System,
    definition_of_m,
    observers_of,
    relays,
    schedules,
    systems,
)

STEPS = st.floats(np.log(1e-4), 0.0).map(lambda exponent: float(np.exp(exponent)))


@st.composite
def changing_systems(draw, **options) -> System:
    """A random system whose links follow a random schedule."""
    system = draw(systems(**options) | systems(directed=True, **options))
    schedule = draw(schedules(system.design.communication))
    return dataclasses.replace(system, design=dataclasses.replace(system.design, schedule=schedule))


def graph_now(simulator: Simulator, env: int) -> nx.DiGraph:
    """The links that are up, as a graph."""
    up, links = LinksNow(simulator.design, simulator.num_envs).up(simulator.state), simulator.design.links
    graph = nx.DiGraph()
    graph.add_nodes_from(range(links.agents))
    graph.add_edges_from((int(links.sender[q]), int(links.receiver[q])) for q in np.flatnonzero(up[:, env]))
    return graph


def reached_observers(graph: nx.DiGraph, members: list[int], target: int, relay: bool) -> list[int]:
    """Those of the target's observers to which news of it comes, by neighbours or through other observers."""
    first = {a for a in members if relays(graph, a, target, relay)}
    between = graph.subgraph(members)
    return [a for a in members if a in first.union(*(nx.descendants(between, root) for root in first))]


def assert_inside(simulator: Simulator) -> None:
    extremes = simulator.extremes
    for name, values in zip(extremes._fields, extremes, strict=True):
        assert np.all(values < 1.0), f"{name}: {values}"
    assert np.all(np.isfinite(simulator.estimates))
    assert np.all(np.isfinite(simulator.input_estimates))


@settings(max_examples=25)
@given(system=changing_systems(), batch=st.integers(1, 3))
def test_matrices_and_bounds_are_those_of_the_links_that_are_up(system, batch):
    """xi = M(t) x_tilde and the bound M(t)^-1 rho over the observers that the target reaches, from the definitions of
    the paper on the graph of this instant; 0 and inf for the others.
    """
    simulator = system.simulator(Proximal(), batch)
    design, layout = system.design, system.design.states.layout
    for _ in range(3):
        simulator.step(0.3)
        rho = design.states.rho.evaluate(simulator.t, np.empty((layout.rows, batch)))
        xi, errors, bound = simulator.disagreements(), simulator.errors(), simulator.error_bounds().bound
        for env in range(batch):
            graph = graph_now(simulator, env)
            for index, block in enumerate(layout.blocks):
                members = observers_of(layout, index)
                reached = reached_observers(graph, members, block.agent, design.relay)
                m = definition_of_m(graph, reached, block.agent, design.relay)
                inside = np.isin(members, reached)
                shape = block.observers, block.components
                expected, own = np.zeros(shape), np.full(shape, np.inf)
                expected[inside] = m @ errors[env, block.columns].reshape(shape)[inside]
                own[inside] = np.linalg.solve(m, np.ones((len(m), 1))) * rho[block.rows, env]
                size = np.abs(simulator.estimates).max() + np.abs(simulator.x).max()
                np.testing.assert_allclose(xi[env, block.columns].reshape(shape), expected, atol=1e-13 * size)
                np.testing.assert_allclose(bound[block.columns, env].reshape(shape), own, rtol=1e-9)


@pytest.mark.parametrize("order", [1, 2])
@settings(max_examples=60)
@given(system=changing_systems(), dt=STEPS, decades=st.floats(-1.0, 2.0), batch=st.integers(1, 3))
def test_funnels_and_own_bounds_are_kept_whatever_links_do(order, system, dt, decades, batch):
    """At every grid point, for random digraphs, schedules, fleets and steps, under jumps of states and inputs."""
    simulator = system.simulator(Proximal(order), batch)
    assert_inside(simulator)
    rng = np.random.default_rng(system.seed)
    vessels = any(isinstance(model, SurfaceVessel) for model in system.design.fleet.models)
    reach = 10.0 ** (min(decades, 0.0) if vessels else decades)
    for _ in range(12):
        simulator.state.x[...] = reach * rng.uniform(-1.0, 1.0, simulator.state.x.shape)
        simulator.step(dt, reach * rng.choice((-1.0, 0.0, 0.3, 1.0), (batch, system.design.fleet.m)))
        assert_inside(simulator)
        error = np.abs(simulator.errors().T)
        assert np.all(error < simulator.error_bounds().bound)


@settings(max_examples=20)
@given(system=changing_systems(), dt=STEPS)
def test_alone_as_in_a_batch_and_from_any_saved_state(system, dt):
    """Bit for bit: an environment alone, one that was saved halfway, and one that was pickled."""
    batch = system.simulator(Proximal(), 3)
    alone = system.simulator(Proximal()).reset(system.seed + 2)
    saved = None
    for step in range(8):
        if step == 4:
            saved = batch.save()
        batch.step(dt)
        alone.step(dt)
    for name in ("x", "estimates", "input_estimates"):
        np.testing.assert_array_equal(getattr(batch, name)[2], getattr(alone, name)[0])
    np.testing.assert_array_equal(batch.error_bounds().bound[:, 2], alone.error_bounds().bound[:, 0])
    other = pickle.loads(pickle.dumps(system.simulator(Proximal(), 3).reset(1)))
    other.restore(saved)
    for _ in range(4):
        other.step(dt)
    for name, values in other.save().arrays().items():
        np.testing.assert_array_equal(values, batch.save().arrays()[name], err_msg=name)
    np.testing.assert_array_equal(other.error_bounds().bound, batch.error_bounds().bound)


@settings(max_examples=30)
@given(system=systems() | systems(directed=True), dt=STEPS)
def test_with_all_links_up_it_is_the_fixed_graph(system, dt):
    """To the same bits where links go one way, and to rounding where another factorisation is used."""
    changing = dataclasses.replace(system, design=dataclasses.replace(system.design, schedule=Fixed()))
    simulators = [each.simulator(Proximal(), 2) for each in (system, changing)]
    rng = np.random.default_rng(system.seed)
    for _ in range(6):
        u = rng.uniform(-1.0, 1.0, system.design.fleet.m)
        for simulator in simulators:
            simulator.step(dt, u)
        fixed, free = simulators
        for name in ("estimates", "input_estimates"):
            ours, theirs = getattr(fixed, name), getattr(free, name)
            if system.design.links.symmetric:
                np.testing.assert_allclose(theirs, ours, rtol=0.0, atol=1e-10 * max(1.0, np.abs(ours).max(initial=0.0)))
            else:
                np.testing.assert_array_equal(theirs, ours)
        np.testing.assert_allclose(free.error_bounds().bound, fixed.error_bounds().bound, rtol=1e-9)


@settings(max_examples=15)
@given(system=changing_systems(input_observer=True), env=st.integers(0, 1))
def test_a_run_by_messages_equals_the_batched_one(system, env):
    """Each agent reads what came over the links that are up, and passes on who has reached it."""
    layouts, runs = (system.design.states.layout, system.design.inputs.layout), []
    for right_hand_side in (BatchedRightHandSide, MessagePassing):
        law = SmoothSignals(system.design.fleet, system.seed)
        simulator = system.simulator(Explicit(right_hand_side), 2, law=law)
        rng, state = np.random.default_rng(system.seed), simulator.state
        state.t[env] = rng.uniform(0.0, 5.0)
        simulator.plant.actuate(state)
        for name, layout, truth in (
            ("estimate", layouts[0], state.x),
            ("input_estimate", layouts[1], state.g),
        ):
            state.memory[name][...] = truth[layout.column_source] + 1e-4 * rng.uniform(-1.0, 1.0, (layout.size, 2))
        for _ in range(10):
            simulator.step(1e-6)
        runs.append(simulator.save().memory)
    for name in ("estimate", "input_estimate"):
        np.testing.assert_allclose(runs[0][name], runs[1][name], rtol=1e-10, atol=1e-10)


PATH = nx.path_graph(5)


def path_simulator(schedule, observers=None, radius=0.1, **options) -> Simulator:
    """Five integrators on a line; agent 0 is observed by 2, 3 and 4 for k = 4."""
    fleet = Fleet([SingleIntegrator(dim=1)] * 5)
    bound = Exponential(2.0, 0.1, 5.0)
    design = ObserverDesign(fleet, PATH, 4, bound, Exponential(40.0, 1.0, 1.0), schedule=schedule)
    return Simulator(design, InitialSet(np.zeros(5), np.full(5, radius)), observers=observers, **options)


class TestAPathThatBreaks:
    """The link from 2 to 3 and back is off from 1 s to 2 s: 3 and 4 hear nothing of 0."""

    SCHEDULE = Outage(1.0, 1.0, link=(2, 3)) & Outage(1.0, 1.0, link=(3, 2))

    def test_who_is_cut_off_keeps_predicting_without_a_bound(self):
        simulator = path_simulator(self.SCHEDULE)
        slot = simulator.design.states.layout.slot
        cut, near = slot[3, 0], slot[2, 0]
        held = []
        for step in range(30):
            simulator.step(0.1, np.ones(5))
            down = 1.0 <= round(0.1 * (step + 1), 6) < 2.0
            bound = simulator.error_bounds().bound[:, 0]
            assert np.isinf(bound[cut]) == np.isinf(bound[slot[4, 0]]) == down
            assert np.isfinite(bound[near])
            assert (simulator.disagreements()[0, cut] == 0.0) == down
            if down:
                held.append(simulator.estimates[0, cut] - simulator.t[0] * simulator.input_estimates[0, cut])
        np.testing.assert_allclose(held, held[0], rtol=1e-9)  # x' = f + g, with g as it was last known
        assert_inside(simulator)
        assert abs(simulator.errors()[0, cut]) < simulator.error_bounds().bound[cut, 0]

    def test_the_bound_grows_where_links_are_missing(self):
        """Without the link 4 -> 3 observer 3 hears 2 alone, and M(t)^-1 1 is that of the shorter chain."""
        whole, broken = (path_simulator(s).reset(0) for s in (Fixed(), Outage(0.0, 9.0, link=(4, 3))))
        slot = whole.design.states.layout.slot
        for simulator in (whole, broken):
            simulator.step(0.1)
        bounds = [s.error_bounds().bound[[slot[a, 0] for a in (2, 3, 4)], 0] for s in (whole, broken)]
        rho = whole.observers.rho.at(whole.t)[0, 0]
        np.testing.assert_allclose(bounds[0], rho * np.array([3.0, 5.0, 6.0]))
        np.testing.assert_allclose(bounds[1], rho * np.array([2.0, 3.0, 4.0]))

    def test_an_explicit_step_reports_the_jump(self):
        simulator = path_simulator(self.SCHEDULE, Explicit())
        layout, state = simulator.design.states.layout, simulator.state
        state.t[...] = 2.0 - 3e-5
        state.memory["estimate"][...] = state.x[layout.column_source]
        for observer in (3, 4):  # cut off, and far off when the link comes back
            state.memory["estimate"][layout.slot[observer, 0]] += 1.0
        simulator.step(1e-5)
        simulator.step(1e-5)
        simulator.step(1e-5)
        with pytest.raises(FunnelError, match=r"or links went or came\. No explicit step can go on"):
            simulator.step(1e-5)

    def test_the_proximal_step_goes_on(self):
        simulator = path_simulator(self.SCHEDULE, Proximal())
        for _ in range(40):
            simulator.step(0.1, np.ones(5) * 20.0)
        assert_inside(simulator)
        assert np.abs(simulator.errors()).max() < 0.1


def test_each_environment_has_its_own_graph():
    simulator = path_simulator(RandomLinks(0.5), num_envs=64)
    simulator.step(0.1)
    up = LinksNow(simulator.design, 64).up(simulator.state)
    assert len(np.unique(up, axis=1).T) == 16  # of 2^4 edges
    finite = np.isfinite(simulator.error_bounds().bound)
    assert 0 < finite.sum() < finite.size
    assert_inside(simulator)


def test_copies_do_not_share_what_they_know_of_links():
    first = path_simulator(Range(0.15), num_envs=2)
    second = copy.deepcopy(first)
    for _ in range(5):
        first.step(0.1, np.array([1.0, 0.0, -1.0, 0.5, 0.0]))
    bound = second.error_bounds().bound.copy()
    second.step(0.1, np.zeros(5))
    assert second.error_bounds().bound.shape == bound.shape
    assert_inside(second)


def test_without_a_schedule_nothing_is_kept():
    simulator = path_simulator(None)
    assert simulator.observers.links is None
    assert sorted(simulator.state.memory) == ["eps", "estimate", "input_estimate", "nu"]
    assert simulator.design.states.layout.arrays.last.size == 0


class TestCheck:
    """What `khop check` says of Assumption 3."""

    @staticmethod
    def why(schedule, **changes) -> str:
        chosen = scenario("paper").replace(schedule=schedule, **changes)
        (assumption,) = [each for each in design_report(chosen)["assumptions"] if each["number"] == "3"]
        assert assumption["status"] == "doesn't hold"
        return assumption["why"]

    def test_names_the_pairs_that_a_periodic_schedule_cuts_off(self):
        tree = scenario("paper").communication
        without = nx.Graph(edge for edge in tree.edges if edge != (4, 7))
        why = self.why(Switching((tree, without), period=2.0))
        assert "by construction at the grid points" in why
        assert "8 of 26 pairs are cut off at times" in why  # agent 7 and those 2 or 3 links away, 2, 3, 5 and 6
        assert "'drifter_7' from 'drifter_2'" in why
        assert "'drifter_0' from 'drifter_3'" not in why
        assert "(at 1 s)" in why

    def test_finds_nobody_cut_off(self):
        tree = scenario("paper").communication
        assert "each target reaches all its observers all the time" in self.why(Switching((tree, tree), period=2.0))

    def test_random_schedules_are_drawn(self):
        assert "in 100 drawn episodes" in self.why(RandomLinks(0.8))
        assert "who is in range depends on the run" in self.why(Range(3.0))

    def test_bounds_above_delta_are_said(self):
        """On a ring with chords the sharp rule is used up; without the chords observers are further away."""
        ring = nx.cycle_graph(8)
        chords = nx.compose(ring, nx.Graph([(i, i + 4) for i in range(4)]))
        task = nx.cycle_graph(8)
        why = self.why(Fixed(ring), communication=chords, task=task, k=4, design_rule="sharp")
        assert "a part of the links that doesn't change" in why
        assert "times delta" in why


def test_a_file_keeps_the_schedule(tmp_path):
    schedule = (
        Switching((PATH, nx.path_graph(4)), period=2.0)
        & RandomLinks((0.5, 1.0), connected=True)
        & Range(5.0)
        & Outage((0.0, 2.0), 1.0)
        & Outage(1.0, 0.5, link=(0, 1))
        & Fixed(nx.DiGraph([(0, 1), (1, 0), (1, 2)]))
    )
    path = tmp_path / "changing.toml"
    text = write_scenario(scenario("paper").replace(schedule=schedule))
    path.write_text(text)
    again = read_scenario(path)
    assert write_scenario(again) == text
    simulators = [each.build(num_envs=3) for each in (scenario("paper").replace(schedule=schedule), again)]
    for _ in range(10):
        for simulator in simulators:
            simulator.step(0.1)
    np.testing.assert_array_equal(simulators[0].estimates, simulators[1].estimates)
    path.write_text(text.replace("radius = 5.0", "radus = 5.0"))
    with pytest.raises(ScenarioFileError, match=r"schedule\[2\]: Range: unknown key 'radus'; did you mean 'radius'"):
        read_scenario(path)


def test_a_scenario_refuses_links_that_it_does_not_have():
    with pytest.raises(ValueError, match=r"scenario 'paper': Fixed.graph has 2 links that the communication graph"):
        scenario("paper").replace(schedule=Fixed(nx.Graph([(0, 7)])))


def test_the_environment_keeps_its_contract():
    schedule = RandomLinks((0.5, 1.0)) & Outage((0.0, 0.5), 0.3) & Range(30.0)
    changing = scenario("paper").replace(schedule=schedule)
    report = check_environment(lambda **options: consensus_v0.parallel_env(changing, max_cycles=15, **options))
    assert report.ok, str(report)
    env = consensus_v0.parallel_env(changing, bounds=True)
    observations, _ = env.reset(seed=0)
    for agent, observation in observations.items():
        assert env.observation_space(agent).contains(observation)  # a bound of inf is clipped
