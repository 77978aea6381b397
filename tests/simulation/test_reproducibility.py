"""Same seed, same bits: over runs, batch sizes, threads, and saving and restoring in the middle."""

import pickle

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents import TanhConsensus, make_law
from khop_env.observers import Explicit, Exponential, ObserverDesign, Proximal
from khop_env.observers.solve import LANES as LANES_OF_SOLVE
from khop_env.physics import BandLimitedNoise, DriftingIntegrator, Fleet, Sinusoid, Unicycle
from khop_env.scenarios import paper
from khop_env.simulation import InitialSet, Simulator, SimulatorState
from tests.strategies import SmoothSignals, systems

LANES = LANES_OF_SOLVE // 2  # environments whose agents have two components
INTEGRATORS = {"explicit": Explicit, "order 1": lambda: Proximal(1), "order 2": lambda: Proximal(2)}


def assert_same_bits(one: SimulatorState, other: SimulatorState) -> None:
    """All arrays of two states are equal, NaN included."""
    for name, values in one.arrays().items():
        np.testing.assert_array_equal(values, other.arrays()[name], err_msg=name)


def environment(state: SimulatorState, b: int) -> SimulatorState:
    """Environment b of a batch as a state of its own."""
    memory = {name: values[:, b : b + 1] for name, values in state.memory.items()}
    parts = {name: getattr(state, name)[..., b : b + 1] for name in ("t", "x", "u", "g")}
    return SimulatorState(**parts, drawn=state.drawn[b : b + 1], memory=memory)


def steps(integrator: str) -> tuple[float, int]:
    """(dt, steps) that every drawn system can be stepped with."""
    return (1e-7, 20) if integrator == "explicit" else (0.03, 10)


@pytest.mark.parametrize("integrator", INTEGRATORS)
@settings(max_examples=25)
@given(system=systems(), batch=st.integers(2, 5), smooth=st.booleans())
def test_a_row_of_a_batch_is_the_single_run_of_its_seed(integrator, system, batch, smooth):
    """Row b of a batch seeded s equals the single run seeded s + b, with every disturbance, drawn start and law."""
    dt, count = steps(integrator)
    seed = system.seed % 1000

    def run(size: int, first: int) -> SimulatorState:
        law = SmoothSignals(system.design.fleet, 1) if smooth else TanhConsensus(1.0)
        simulator = system.simulator(INTEGRATORS[integrator](), size, law=law).reset(first)
        for _ in range(count):
            simulator.step(dt)
        return simulator.save()

    whole = run(batch, seed)
    for b in range(batch):
        assert_same_bits(environment(whole, b), run(1, seed + b))


def large_batch(batch: int, threads: int) -> Simulator:
    """A small closed loop with disturbances, stepped a few times; LANES environments a thread are split by rows."""
    fleet = Fleet([DriftingIntegrator()] * 3 + [Unicycle()])
    bound = Exponential(60.0, 0.2, 3.0)
    graph = nx.path_graph(4)
    simulator = Simulator(
        ObserverDesign(fleet, graph, 3, bound, bound),
        InitialSet(np.zeros(fleet.n), np.ones(fleet.n)),
        disturbance=Sinusoid(0.3) + BandLimitedNoise(0.2),
        law=TanhConsensus(),
        task=nx.cycle_graph(4),
        observers=Proximal(2, threads),
        num_envs=batch,
    ).reset(7)
    for _ in range(5):
        simulator.step(0.05)
    return simulator


@pytest.mark.parametrize("batch", [1, 5, LANES + 1, 3 * LANES, 3 * LANES + 17])
def test_results_do_not_depend_on_threads(batch):
    """Proximal(threads=1, 2, 3): split by targets in small batches, by environments in large ones, the same bits."""
    one = large_batch(batch, 1)
    for threads in (2, 3, 7):
        several = large_batch(batch, threads)
        assert_same_bits(several.save(), one.save())
        np.testing.assert_array_equal(several.extremes.normalized, one.extremes.normalized)


def test_large_batches_have_the_bits_of_small_ones():
    """As above across batch sizes: from one lane to several full tiles."""
    whole = large_batch(3 * LANES + 17, 3).save()
    for batch in (1, 2, LANES - 1, LANES, LANES + 1):
        part = large_batch(batch, 1).save()
        for b in (0, batch - 1):
            assert_same_bits(environment(part, b), environment(whole, b))


@pytest.mark.parametrize("integrator", INTEGRATORS)
def test_same_seed_same_bits_and_other_seeds_differ(integrator):
    """The paper's experiment, disturbance on: a seed fixes the initial state and w, and so every bit of the run."""
    dt, count = steps(integrator)

    def run(seed):
        simulator = paper().build(law=make_law("tanh"), observers=INTEGRATORS[integrator]()).reset(seed)
        for _ in range(count):
            simulator.step(dt)
        return simulator

    first = run(11)
    assert_same_bits(first.save(), run(11).save())
    other = run(12)
    assert np.all(other.x != first.x)
    assert np.all(other.save().drawn != first.save().drawn)
    first.reset(12)
    for _ in range(count):
        first.step(dt)
    assert_same_bits(first.save(), other.save())


def test_seeds_may_be_given_one_by_one_and_as_generators():
    """seed + b, a list of seeds, and generators of those seeds are the same thing; rows differ from each other."""
    simulator = paper().build(num_envs=3)
    by_number = simulator.reset(5).save()
    assert_same_bits(simulator.reset([5, 6, 7]).save(), by_number)
    assert_same_bits(simulator.reset([np.random.default_rng(seed) for seed in (5, 6, 7)]).save(), by_number)
    assert_same_bits(simulator.reset(np.int64(5)).save(), by_number)
    assert np.all(by_number.x[:, 0] != by_number.x[:, 1])
    assert np.all(by_number.drawn[1] != by_number.drawn[2])


@pytest.mark.parametrize("integrator", INTEGRATORS)
@settings(max_examples=25)
@given(system=systems(), batch=st.integers(1, 3), held=st.booleans())
def test_saved_and_restored_runs_continue_bit_for_bit(integrator, system, batch, held):
    """Through a pickle, into the same simulator and into a fresh one; with a law and with held inputs."""
    dt, count = steps(integrator)
    law = None if held else TanhConsensus(1.0)
    simulator = system.simulator(INTEGRATORS[integrator](), batch, law=law)
    u = 0.5 * system.design.fleet.input_limit
    first = u if held else None
    if integrator == "explicit" and held and system.design.inputs.layout.size:
        first = 0.0 * u  # a jump of g needs a proximal step
    for _ in range(count):
        simulator.step(dt, first)
    saved = simulator.save()
    stored = pickle.dumps(saved)
    for _ in range(count):
        simulator.step(dt)
    expected = simulator.save()

    assert_same_bits(saved, pickle.loads(stored))  # saving made a copy: later steps didn't touch it
    fresh = system.simulator(INTEGRATORS[integrator](), batch, law=law).reset(99)
    for one in (simulator, fresh):
        one.restore(pickle.loads(stored))
        assert_same_bits(one.save(), saved)
        for _ in range(count):
            one.step(dt)
        assert_same_bits(one.save(), expected)


def test_a_state_of_another_shape_is_refused_and_changes_nothing():
    """Batch size and scenario have to match."""
    simulator = paper().build(num_envs=2)
    before = simulator.save()
    with pytest.raises(ValueError, match=r"t has shape \(3,\), this simulator's is \(2,\)"):
        simulator.restore(paper().build(num_envs=3).save())
    other = paper().replace(k=2, task=nx.empty_graph(8)).build(num_envs=2)
    with pytest.raises(ValueError, match=r"estimate has shape .* saved by another scenario or number of environments"):
        simulator.restore(other.save())
    assert_same_bits(simulator.save(), before)


def test_states_copy_and_pickle_independently():
    """A copy and a pickled state share no memory with the original."""
    state = paper().build().save()
    copy, loaded = state.copy(), pickle.loads(pickle.dumps(state))
    assert_same_bits(loaded, state)
    for name, values in state.arrays().items():
        assert not np.shares_memory(copy.arrays()[name], values)
    state.x[...] = np.nan
    assert np.all(np.isfinite(copy.x))


def test_reading_does_not_change_a_run():
    """Errors, disagreements and extremes are computed from the state and leave it alone."""
    simulator = paper().build(law=make_law("tanh")).reset(2)
    simulator.step(0.01)
    before = simulator.save()
    for _ in range(2):
        simulator.errors()
        simulator.disagreements()
        simulator.input_errors()
        simulator.input_disagreements()
        extremes = simulator.extremes
    extremes.normalized[...] = 7.0
    assert simulator.extremes.normalized[0] < 1.0
    assert_same_bits(simulator.save(), before)


def test_a_pickled_simulator_plays_the_same_episode():
    """Worker processes get simulators by pickle; threads are not carried along."""
    simulator = paper().build(law=make_law("tanh"), observers=Proximal(threads=2)).reset(4)
    simulator.step(0.01)
    clone = pickle.loads(pickle.dumps(simulator))
    for one in (simulator, clone):
        for _ in range(3):
            one.step(0.01)
    assert_same_bits(clone.save(), simulator.save())
