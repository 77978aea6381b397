"""Observers over a network in threads: the same bits for any number of them and any batch."""

import copy
import dataclasses
import pickle
import threading
from unittest import mock

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from khop_env import consensus_v0
from khop_env.network import Network
from khop_env.observers import ESTIMATORS, Exponential, Networked, ObserverDesign, Relay, networked
from khop_env.observers.scalar import solve_alone
from khop_env.physics import AgentModel, DoubleIntegrator, DriftingIntegrator, Fleet
from khop_env.scenarios import mixed_fleet, paper
from khop_env.simulation import InitialSet, Simulator
from tests.strategies import NETWORKS, SEEDS, schedules, systems


def inputs(simulator: Simulator, rng: np.random.Generator, num_envs: int) -> np.ndarray:
    limit = np.where(np.isfinite(simulator.fleet.input_limit), simulator.fleet.input_limit, 3.0)
    return limit * rng.uniform(-1.0, 1.0, (num_envs, simulator.fleet.m))


def everything(simulator: Simulator) -> dict[str, np.ndarray]:
    """All that a step writes and all that is read from it, batch last."""
    found = {name: values for name, values in simulator.state.arrays().items() if name != "drawn"}
    found |= simulator.extremes._asdict() | simulator.observers.information(simulator.state)._asdict()
    found["certified"] = simulator.error_bounds().bound
    return {name: values.copy() for name, values in found.items()}


def require_equal(first: dict, second: dict, part: object = slice(None)) -> None:
    for name, values in first.items():
        np.testing.assert_array_equal(values, second[name][..., part], err_msg=name)


@settings(max_examples=8)
@given(data=st.data(), system=systems(), network=NETWORKS, noise=st.sampled_from([0.0, 0.1]), seed=SEEDS)
@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_threads_and_batches_leave_every_bit(data, system, network, noise, seed, estimator):
    """One thread, two and three with a range of some environments each, one environment alone; resets included."""
    if data.draw(st.booleans()):
        schedule = data.draw(schedules(system.design.communication))
        system = dataclasses.replace(system, design=dataclasses.replace(system.design, schedule=schedule))
    network, batch = dataclasses.replace(network, noise=noise), 5
    with mock.patch.object(networked, "LANES", 1):  # the fewest environments of a thread
        many = [system.simulator(Networked(network, estimator, 1, count), num_envs=batch) for count in (1, 2, 3)]
        assert [len(each.observers._ranges) for each in many] == [1, 2, 3]
        alone = system.simulator(Networked(network, estimator, 1), num_envs=1)
    rng = np.random.default_rng(seed)
    for simulator in many:
        simulator.reset(seed)
    alone.reset(seed + 3)
    for number in range(12):
        u, dt, said = inputs(alone, rng, batch), (0.05, 0.02)[number % 5 == 4], rng.normal(size=batch)
        if number == 7:
            for simulator in many:
                simulator.reset(seed + 9, env_ids=[1])
        for simulator, columns in [(each, slice(None)) for each in many] + [(alone, slice(3, 4))]:
            simulator.state.memory["said"][...] = said[columns]
            simulator.step(dt, u[columns])
    first = everything(many[0])
    for simulator in many[1:]:
        require_equal(everything(simulator), first)
    require_equal(everything(alone), first, slice(3, 4))


@pytest.mark.parametrize("estimator", ESTIMATORS)
@pytest.mark.parametrize("scenario", [paper, mixed_fleet])
def test_batches_of_more_than_one_block_leave_every_bit(scenario, estimator):
    """130 environments: blocks of 64 equations and one of 2 with several equations side by side; a thread or two."""
    network, batch = "lossy:loss=0.2,latency=0.07", 130
    both = [scenario().build(observers=Networked(network, estimator, 0, n), num_envs=batch).reset(3) for n in (1, 2)]
    alone = {b: scenario().build(observers=Networked(network, estimator)).reset(3 + b) for b in (0, 66, 129)}
    assert [len(each.observers._ranges) for each in both] == [1, 2]
    rng = np.random.default_rng(0)
    for _ in range(10):
        u = inputs(both[0], rng, batch)
        for simulator in both:
            simulator.step(0.05, u)
        for b, simulator in alone.items():
            simulator.step(0.05, u[b])
    first = everything(both[0])
    require_equal(everything(both[1]), first)
    for b, simulator in alone.items():
        require_equal(everything(simulator), first, slice(b, b + 1))


@settings(max_examples=20)
@given(seed=SEEDS, scale=st.floats(-3, 3), split=st.integers(1, 199))
def test_an_equation_does_not_depend_on_those_beside_it(seed, scale, split):
    """Nor on ranges; one without a solution, NaN, changes itself alone."""
    fleet = Fleet([DriftingIntegrator(), DoubleIntegrator(), DriftingIntegrator(), DriftingIntegrator()])
    layout = ObserverDesign(fleet, nx.path_graph(4), 3, *[Exponential(9.0, 9.0, 1.0)] * 2).states.layout
    rng, batch, tau = np.random.default_rng(seed), 200, 10.0**scale
    size, pairs = layout.size, layout.pairs
    counts = np.repeat(layout.arrays.components, layout.arrays.observers)
    start, offset = 2 * np.arange(pairs + 1), 2 * (np.cumsum(counts) - counts)
    held, rho = rng.normal(size=(2 * size, batch)), rng.uniform(0.01, 2.0, (layout.rows, batch))
    held[:, 7] = np.nan
    due = rng.random(batch) < 0.9
    y, eps = 10.0 * rng.normal(size=(size, batch)), rng.normal(0.0, 3.0, (size, batch))

    def solved(ranges, columns=slice(None)):
        found = [values[:, columns].copy() for values in (eps, y, np.zeros_like(y))]
        parts = [values[..., columns].copy() for values in (held, rho, due)]
        for low, high in ranges:
            solve_alone(layout.packed, start, offset, tau, *parts, *found, low, high)
        return np.array(found)

    whole = solved([(0, batch)])
    np.testing.assert_array_equal(solved([(0, split), (split, batch)]), whole)
    for b in (0, 6, 7, 8, 199):
        np.testing.assert_array_equal(solved([(0, 1)], slice(b, b + 1))[:, :, 0], whole[:, :, b])
    others = np.arange(batch) != 7
    assert np.isfinite(whole[:, :, others]).all()
    np.testing.assert_array_equal(whole[:2, :, ~due], [eps[:, ~due], y[:, ~due]])


class Counting(Relay):
    """An estimator of a user's own that derives from the library's: it notes how it is called."""

    name = "counting"
    proposed = "counting.last"

    def prepare(self, design, network, num_envs, first_row):
        super().prepare(design, network, num_envs, first_row)
        self.row, self.link = first_row - 1, np.arange(len(design.links))
        self.calls, self.batch = [], num_envs
        self.width = 1

    def allocate(self):
        return {"counting.last": np.zeros((len(self.link), self.batch))}

    def predict(self, memory, t, dt):
        self.calls.append(("predict", threading.current_thread(), t.shape, memory["center"].copy()))

    def message(self, state):
        self.calls.append(("message", threading.current_thread(), state.t.shape, state.memory["center"].copy()))
        return [np.asfortranarray(state.x[:1].T).T.astype(np.float32)]  # neither contiguous nor of 64 bits

    def receive(self, state, take, due):
        take(self.link, np.full(len(self.link), self.row + 1), state.memory["counting.last"])
        self.calls.append(("receive", threading.current_thread(), due.shape, state.memory["counting.last"].copy()))


def test_an_estimator_of_ones_own_is_called_with_all_environments_on_one_thread():
    network, batch = Network(loss=0.2, latency=0.01), 130
    both = [paper().build(observers=Networked(network, Counting(), 0, n), num_envs=batch).reset(0) for n in (1, 2)]
    rng = np.random.default_rng(0)
    for _ in range(8):
        u = inputs(both[0], rng, batch)
        for simulator in both:
            simulator.step(0.05, u)
    require_equal(everything(both[1]), everything(both[0]))
    calls = [simulator.observers.estimator.calls for simulator in both]
    assert [name for name, *_ in calls[1]] == ["message", "receive"] * 2 + ["predict", "message", "receive"] * 8
    for (_, _, _, one), (_, thread, shape, two) in zip(*calls, strict=True):
        assert thread is threading.main_thread()
        assert shape == (batch,)
        np.testing.assert_array_equal(one, two)
    assert np.abs(calls[1][-1][3]).max() > 0.0


class Own(AgentModel):
    """x' = tanh(x) + u, of a user who counts on whole batches."""

    type, states, inputs, position, input_limit = "own", {"x": "m"}, {"u": "m/s"}, ("x",), 1.0
    batches: set = set()  # noqa: RUF012

    def drift(self, t, x):
        Own.batches.add((threading.current_thread() is threading.main_thread(), x.shape[0]))
        return np.tanh(x)

    def input_map(self, t, x, u):
        return u

    def drift_lipschitz(self):
        return 1.0


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_a_model_of_ones_own_is_called_with_all_environments_on_one_thread(estimator):
    fleet, bound, batch = Fleet([Own()] * 4), Exponential(50.0, 5.0, 1.0), 130
    design = ObserverDesign(fleet, nx.path_graph(4), 3, bound, bound)
    initial = InitialSet(np.zeros(4), np.ones(4))
    both = [
        Simulator(design, initial, observers=Networked("lossy:latency=0.12", estimator, 0, n), num_envs=batch)
        for n in (1, 2)
    ]
    Own.batches.clear()
    rng = np.random.default_rng(0)
    for _ in range(8):
        u = inputs(both[0], rng, batch)
        for simulator in both:
            simulator.step(0.05, u)
    require_equal(everything(both[1]), everything(both[0]))
    assert Own.batches == {(True, batch)}


def test_threads_are_an_argument():
    env = consensus_v0.batched_env("paper", num_envs=2, network="wifi", threads=3)
    assert env.simulator.observers.threads == 3
    for wrong in (0, True, 1.5, 257):
        with pytest.raises(ValueError, match=f"threads must be an integer from 1 to 256; got {wrong!r}"):
            Networked("wifi", threads=wrong)


@pytest.mark.parametrize("estimator", ESTIMATORS)
def test_copies_and_pickles_go_on_with_the_same_bits(estimator):
    simulator = paper().build(observers=Networked("wifi", estimator, 0, 2), num_envs=130).reset(0)
    simulator.step(0.05)
    others = [copy.deepcopy(simulator), pickle.loads(pickle.dumps(simulator))]
    for each in (simulator, *others):
        each.step(0.05)
    for other in others:
        require_equal(everything(other), everything(simulator))
