"""Steps of controlled size: errors follow the tolerance; every funnel is kept, also in steps that are taken back."""

import copy
import dataclasses
import pickle

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents import TanhConsensus, make_law
from khop_env.network import Outage, Range, Switching
from khop_env.observers import Explicit, Exponential, Extremes, Networked, ObserverDesign, Proximal, SolveError
from khop_env.physics import DoubleIntegrator, Fleet, SingleIntegrator, SurfaceVessel
from khop_env.registry import scenario
from khop_env.scenarios import paper
from khop_env.simulation import InitialSet, Simulator, StepControl
from tests.simulation.test_simulator_errors import assert_same, held
from tests.strategies import SmoothSignals, schedules, systems

TOLERANCES = st.floats(np.log(1e-5), np.log(1.0)).map(lambda exponent: float(np.exp(exponent)))
JUMP = 1e-7  # s: steps of this length are taken whatever their estimated error


@st.composite
def changing_systems(draw):
    """A random system, most often with links that come and go."""
    system = draw(systems() | systems(directed=True))
    schedule = draw(st.none() | schedules(system.design.communication))
    return dataclasses.replace(system, design=dataclasses.replace(system.design, schedule=schedule))


class Tried:
    """Notes what becomes of every step that a simulator's observers try, taken back or not.

    By Python: the compiled step has the same bits (test_compiled_step.py), and nothing in it can be noted.
    """

    def __init__(self, simulator: Simulator) -> None:
        simulator._compiled = None
        self.simulator, self.sizes, self.links = simulator, [], []
        self.extremes = Extremes(*(np.zeros(simulator.num_envs) for _ in Extremes._fields))
        self.advance, self.stage = simulator.observers.advance, simulator.plant.stage
        simulator.observers.advance, simulator.plant.stage = self.advance_noted, self.stage_noted

    def up(self, state) -> np.ndarray:
        found = self.simulator.observers.links_up(state)
        return np.zeros(0) if found is None else found.copy()

    def advance_noted(self, plant, before, state, dt):
        self.sizes.append(dt)
        self.links.append([self.up(before)])
        self.advance(plant, before, state, dt)
        self.simulator.observers.raise_extremes(state, self.extremes)

    def stage_noted(self, number, weights, elapsed, before, state):
        self.stage(number, weights, elapsed, before, state)
        self.links[-1].append(self.up(state))


def assert_inside(extremes: Extremes) -> None:
    for name, ratios in extremes._asdict().items():
        assert np.all(ratios < 1.0), f"{name}: {ratios}"


@pytest.mark.parametrize("order", [2, 3])
@pytest.mark.parametrize("name", ["paper", "mixed_fleet"])
def test_errors_follow_the_tolerance(name, order):
    """Of states, estimates and input estimates at the end, against a fixed step of 0.5 ms."""
    chosen = scenario(name)
    simulator = chosen.build(law=make_law(chosen.law), observers=Proximal(order)).reset(3)

    def end() -> np.ndarray:
        return np.concatenate([simulator.x[0], simulator.estimates[0], simulator.input_estimates[0]])

    for _ in range(2000):
        simulator.step(5e-4)
    true, errors, steps, tolerances = end(), [], [], [1e-2, 1e-3, 1e-4]
    for tolerance in tolerances:
        simulator.reset(3)
        count = simulator.advance(1.0, tolerance=tolerance)
        assert simulator.t[0] == pytest.approx(1.0, abs=1e-12)
        assert_inside(simulator.extremes)
        errors.append(np.abs(end() - true).max())
        steps.append(count.accepted)
        assert count.rejected <= 0.1 * count.accepted
    print(f"{name}, order {order}: tolerances {tolerances}, errors {errors}, steps {steps}")
    assert np.all(np.array(errors) < 3.0 * np.array(tolerances))
    assert errors[2] < 0.15 * errors[0]
    assert steps[2] == pytest.approx(100.0 ** (1.0 / order) * steps[0], rel=0.4)  # for a hundredth of the error


@settings(max_examples=60)
@given(
    system=changing_systems(),
    tolerance=TOLERANCES,
    decades=st.floats(-1.0, 3.0),
    law=st.booleans(),
    batch=st.integers(1, 3),
    order=st.sampled_from([2, 3]),
)
def test_funnels_are_kept_in_every_step_accepted_or_not(system, tolerance, decades, law, batch, order):
    """For any tolerance, random fleets, graphs, directed or not, links that come and go; states and inputs jump.

    And no step but a jump has links that change between its beginning and its end, though they change at any time.
    """
    fleet = system.design.fleet
    vessels = any(isinstance(model, SurfaceVessel) for model in fleet.models)
    reach = 10.0 ** (min(decades, 0.0) if vessels else decades)
    options = {"law": SmoothSignals(fleet, system.seed)} if law else {}
    simulator = system.simulator(Proximal(order), batch, **options)
    tried, rng, t = Tried(simulator), np.random.default_rng(system.seed), 0.0
    for _ in range(4):
        u = None
        if not law:
            simulator.state.x[...] = reach * rng.uniform(-1.0, 1.0, simulator.state.x.shape)
            u = reach * rng.choice((-1.0, 0.0, 0.3, 1.0), (batch, fleet.m))
        t += 10.0 ** rng.uniform(-3.0, -1.0)
        simulator.advance(t, tolerance=tolerance, u=u)
        assert_inside(simulator.extremes)
        assert simulator.t == pytest.approx(t, abs=1e-12)
    assert_inside(tried.extremes)


@settings(max_examples=60)
@given(system=changing_systems(), tolerance=TOLERANCES, order=st.sampled_from([2, 3]))
def test_no_step_goes_on_over_a_change_of_links(system, tolerance, order):
    """All stages of a step have the links of its beginning, unless it is shorter than 1e-7 s.

    Links that depend on distances may be down for a moment within a step, which only its inner stages could see.
    """
    simulator = system.simulator(Proximal(order), law=SmoothSignals(system.design.fleet, system.seed))
    tried, control = Tried(simulator), StepControl(simulator, tolerance)
    schedule = system.design.schedule
    distances = schedule is not None and any(isinstance(part, Range) for part in schedule.parts)
    while simulator.t[0] < 1.0 - 1e-12:
        control.step(1.0)
        assert tried.sizes[-1] == control.last
        if control.last > JUMP:
            beginning, *inside, end = tried.links[-1]
            assert np.array_equal(beginning, end)
            assert distances or all(np.array_equal(beginning, stage) for stage in inside)
    assert_inside(tried.extremes)


def changing(schedule) -> Simulator:
    """The paper's closed loop under a schedule."""
    chosen = paper().replace(schedule=schedule)
    return chosen.build(law=make_law(chosen.law), observers=Proximal(2)).reset(1)


def ends_of(simulator: Simulator, until: float) -> np.ndarray:
    control, ends = StepControl(simulator, 0.1), []
    while simulator.t[0] < until - 1e-12:
        control.step(until)
        ends.append(simulator.t[0])
    return np.array(ends)


def test_steps_end_on_both_sides_of_a_change_at_a_known_time():
    """Of an outage shorter than the steps around it, and of graphs that switch."""
    every = paper().communication
    some = nx.Graph(sorted(every.edges)[:-1])
    ends = ends_of(changing(Outage(0.9, 1e-3, agent=3) & Switching((every, some), times=(0.0, 0.5))), 1.0)
    for change in (0.5, 0.9, 0.901):
        just_before = ends[(ends < change - 1e-9) & (ends > change - 1e-8)]
        assert just_before.size == 1, change
        assert np.abs(ends - change).min() < 1e-12
    assert np.median(np.diff(ends[ends < 0.5])) > 0.01


def test_a_change_that_follows_from_states_is_found():
    """Two agents that drive apart lose their link at 1 m: at t = 0.5 s, whatever the steps."""
    fleet = Fleet([SingleIntegrator(input_limit=1.0)] * 3)
    bound = Exponential(10.0, 1.0, 1.0)
    design = ObserverDesign(fleet, nx.path_graph(3), 2, bound, bound, relay=False, schedule=Range(1.0))
    u = np.array([-1.0, 0.0, 0.0, 0.0, 0.0, 0.0])
    simulator = Simulator(design, InitialSet(np.zeros(6), np.ones(6)), observers=Proximal(2))
    simulator.reset(0, x0=np.array([-0.5, 0.0, 0.0, 0.0, 0.5, 0.0]))
    simulator.step(1e-9, u)
    ends = ends_of(simulator, 1.0)
    assert np.abs(ends - 0.5).min() < 2e-7
    assert len(ends) < 100


def test_a_drift_s_own_step_is_not_exceeded():
    """A cart whose velocity decays within 10 ms."""
    fleet = Fleet([SingleIntegrator(), DoubleIntegrator(100.0), SingleIntegrator()])
    design = ObserverDesign(fleet, nx.path_graph(3), 2, Exponential(30.0, 1.0, 1.0), Exponential(3e3, 3e3, 1.0))
    simulator = Simulator(design, InitialSet(np.zeros(fleet.n), np.ones(fleet.n))).reset(1)
    tried = Tried(simulator)
    simulator.advance(3.0, tolerance=1.0)
    assert max(tried.sizes) <= simulator.longest_step == pytest.approx(0.01)
    assert np.abs(simulator.x).max() < 3.0


def test_inputs_are_held_from_call_to_call():
    """An input that jumps between two calls is that of its own call, from its first stage on."""
    simulator, exact = held(1), held(1)
    u = np.full(6, 0.5)
    for sign in (1.0, -1.0, 1.0):
        t = float(exact.t[0]) + 0.1
        simulator.advance(t, tolerance=1e-4, u=sign * u)
        for _ in range(1000):
            exact.step(1e-4, sign * u)
        assert np.array_equal(simulator.u[0], sign * u)
        for name in ("x", "estimates", "input_estimates"):
            assert np.abs(getattr(simulator, name) - getattr(exact, name)).max() < 1e-3, name


def jumping() -> Simulator:
    """The paper's agents without a law, at rest in their funnels; inputs are held."""
    simulator = paper().build(observers=Proximal(3)).reset(1)
    for _ in range(100):
        simulator.step(0.01, np.zeros(simulator.fleet.m))
    return simulator


def test_a_jump_is_passed_in_few_steps():
    """Of inputs, to which input observers settle within 0.1 ms: the filter knows that their error dies out."""
    simulator = jumping()
    calm = simulator.advance(1.2, tolerance=1e-3, u=np.zeros(16))
    jumped = simulator.advance(1.4, tolerance=1e-3, u=np.full(16, 1.0))
    print(calm, jumped)
    assert sum(jumped) < sum(calm) + 12


def test_extremes_are_those_of_accepted_steps():
    """Though steps that are taken back raise them for a moment."""
    simulator = jumping()
    simulator.restore(simulator.save())
    control, own = StepControl(simulator, 1e-4), simulator.extremes
    simulator.state.u[...] = 2.0
    simulator.plant.actuate(simulator.state)
    while simulator.t[0] < 1.2 - 1e-12:
        control.step(1.2)
        simulator.observers.raise_extremes(simulator.state, own)
    assert control.rejected > 0
    for ours, theirs in zip(own, simulator.extremes, strict=True):
        assert np.array_equal(ours, theirs)


def test_the_largest_error_of_the_batch_decides():
    """Every environment is as accurate as alone; the same call gives the same bits."""
    chosen = paper()
    batch, alone = (
        chosen.build(law=make_law(chosen.law), observers=Proximal(2, threads=threads), num_envs=num_envs)
        for threads, num_envs in ((2, 3), (1, 1))
    )
    batch.reset(0)
    count = batch.advance(1.0, tolerance=1e-3)
    for env in range(3):
        alone.reset(env)
        assert alone.advance(1.0, tolerance=1e-3).accepted <= count.accepted + 2
        assert np.abs(alone.x[0] - batch.x[env]).max() < 3e-3
    saved = batch.save()
    batch.reset(0)
    assert batch.advance(1.0, tolerance=1e-3) == count
    assert_same(batch.save(), saved)


def test_numbers_that_are_not_finite_end_at_the_last_step_before_them():
    """From t = 0.5 s on the law returns nan: steps become short before it, and the state at their end is kept."""
    fleet = Fleet([SingleIntegrator()] * 3)
    bound = Exponential(100.0, 1.0, 1.0)
    design = ObserverDesign(fleet, nx.path_graph(3), 2, bound, bound)

    def law(t, view):
        return np.where(t[:, None] < 0.5, 0.1, np.nan) * np.ones((1, fleet.m))

    simulator = Simulator(design, InitialSet(np.zeros(6), np.ones(6)), law=law, task=nx.path_graph(3))
    with pytest.raises(SolveError, match="input map became nan"):
        simulator.advance(1.0, tolerance=1e-3)
    assert 0.5 - 1e-6 < simulator.t[0] < 0.5
    assert np.isfinite(simulator.x).all()
    assert np.isfinite(simulator.u).all()


@pytest.mark.parametrize(
    ("until", "tolerance", "expected"),
    [
        (1.0, 0.0, "tolerance must be a number from 1e-09 to 1; got 0.0"),
        (1.0, np.nan, "got nan"),
        (1.0, True, "got True"),
        (1.0, "1e-3", "got '1e-3'"),
        (0.05, 1e-3, r"not before now, t = 0.1 s; got 0.05"),
        (np.inf, 1e-3, "until must be a finite time"),
    ],
)
def test_bad_arguments_are_refused(until, tolerance, expected):
    simulator = held()
    before = simulator.save()
    with pytest.raises(ValueError, match=expected):
        simulator.advance(until, tolerance=tolerance, u=np.zeros(6))
    assert_same(simulator.save(), before)


@pytest.mark.parametrize("observers", [Proximal(1), Explicit(), Networked("ideal")])
def test_other_observers_are_refused(observers):
    simulator = paper().build(observers=observers)
    with pytest.raises(ValueError, match=r"for the proximal step of order 2 or 3, not for"):
        simulator.advance(1.0, tolerance=1e-3)


def test_environments_at_different_times_are_refused():
    simulator = held(3)
    simulator.reset(1, env_ids=[1])
    with pytest.raises(ValueError, match=r"at different times, 0 to 0\.1 s"):
        simulator.advance(1.0, tolerance=1e-3)


def test_the_present_is_reached_without_a_step():
    simulator = held()
    assert simulator.advance(float(simulator.t[0]), tolerance=1e-3) == (0, 0)


@pytest.mark.parametrize("in_python", [False, True])
@pytest.mark.parametrize("copied", [copy.deepcopy, lambda simulator: pickle.loads(pickle.dumps(simulator))])
def test_copies_take_the_same_steps(copied, in_python):
    """Errors are estimated from arrays of the copy's own, whichever code filled them."""
    simulator = paper().build(law=TanhConsensus(), observers=Proximal(3), num_envs=2)
    if in_python:
        simulator._compiled = None
    simulator.step(0.02)
    twin = copied(simulator)
    counts = [each.advance(0.5, tolerance=1e-4) for each in (simulator, twin)]
    assert counts[0] == counts[1]
    assert_same(simulator.state, twin.state)
