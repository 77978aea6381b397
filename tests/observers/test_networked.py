"""Observers over a network: certified bounds, what is passed on, and the paper's observers by rounds."""

import copy
from dataclasses import replace

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from khop_env.network import Network
from khop_env.observers import (
    ESTIMATORS,
    Exponential,
    FunnelObservers,
    Networked,
    ObserverDesign,
    Proximal,
    Relay,
)
from khop_env.observers.merging import largest_share
from khop_env.observers.scalar import solve_alone
from khop_env.observers.solve import solve
from khop_env.physics import AgentModel, DoubleIntegrator, Fleet, Growth, SingleIntegrator
from khop_env.scenarios import mixed_fleet, paper
from khop_env.simulation import InitialSet, Simulator
from tests.strategies import NETWORKS, SEEDS, systems

NOISES = st.sampled_from([0.0, 0.1])
PERIODS = st.sampled_from([0.01, 0.05, 0.07])


def bang_bang(simulator: Simulator, rng: np.random.Generator) -> np.ndarray:
    limit = np.where(np.isfinite(simulator.fleet.input_limit), simulator.fleet.input_limit, 3.0)
    return limit * rng.choice([-1.0, 1.0], (simulator.num_envs, simulator.fleet.m))


def excess(simulator: Simulator) -> float:
    """The largest |error| over its certified bound, where there is a bound above rounding."""
    bound = simulator.error_bounds().bound.T
    assert not np.isnan(bound).any()
    error = np.abs(simulator.errors())
    return float((error / (bound + 1e-12)).max(initial=0.0))


@settings(max_examples=25)
@given(
    system=systems() | systems(directed=True),
    network=NETWORKS,
    noise=NOISES,
    dt=PERIODS,
    estimator=st.sampled_from(list(ESTIMATORS)),
)
def test_no_error_exceeds_its_certified_bound(system, network, noise, dt, estimator):
    """Whatever is lost, late or noisy, for the inputs that part agents fastest, from the first instant on."""
    observers = Networked(replace(network, noise=noise), estimator)
    simulator, rng = system.simulator(observers, num_envs=3), np.random.default_rng(system.seed)
    assert excess(simulator) <= 1.0
    u = bang_bang(simulator, rng)
    for _ in range(40):
        u = np.where(rng.random(u.shape) < 0.1, -u, u)
        simulator.step(dt, u)
        assert excess(simulator) <= 1.0
    assert simulator.extremes.relative.max() <= 1.0 + 1e-9
    assert simulator.extremes.normalized.max() < 1.0


def chain(models: list, network: Network | str, estimator: str = "relay", k: int = 3, num_envs: int = 1) -> Simulator:
    """Agents in a row, k hops, that start at 0 within +-1."""
    fleet, bound = Fleet(models), Exponential(50.0, 5.0, 1.0)
    design = ObserverDesign(fleet, nx.path_graph(len(fleet)), k, bound, bound)
    initial = InitialSet(np.zeros(fleet.n), np.ones(fleet.n))
    return Simulator(design, initial, observers=Networked(network, estimator), num_envs=num_envs)


def test_inputs_beyond_their_limits_are_refused():
    """Bounds assume that they aren't; without a network no bound does."""
    simulator = chain([SingleIntegrator(input_limit=0.5)] * 3, "ideal")
    for u in (np.full(6, 3.0), np.array([[0.0, 0.0, 3.0, 0.0, 0.0, 0.0]]), np.array([0.0, 0.0, -3.0, 0.0, 0.0, 0.0])):
        with pytest.raises(ValueError, match=r"'integrator_\d' is 3 m/s in size, beyond its limit 0.5, and certified"):
            simulator.step(0.05, u)
    assert simulator.t[0] == 0.0
    simulator.step(0.05, np.full(6, 0.5, np.float32))
    Simulator(simulator.design, simulator.initial).step(0.05, np.full(6, 3.0))


def test_an_integrator_under_full_input_is_on_the_face():
    simulator = chain([SingleIntegrator(input_limit=1.0)] * 3, "ideal:latency=0.1")
    for _ in range(40):
        simulator.step(0.05, np.ones(6))
    error, bound = np.abs(simulator.errors()), simulator.error_bounds().bound.T
    np.testing.assert_allclose(error, bound, rtol=1e-8)


@pytest.mark.parametrize(("latency", "rounds"), [(0.0, [0, 1, 2]), (0.01, [1, 2, 3]), (0.12, [3, 6, 9])])
def test_states_come_one_link_a_round(latency, rounds):
    """Without losses a state is as old as its way is long, and the prediction is its model's."""
    simulator = chain([DoubleIntegrator()] * 4, Network(period=0.05, latency=latency))
    history = [simulator.x[0].copy()]
    rng = np.random.default_rng(0)
    for _ in range(20):
        simulator.step(0.05, rng.uniform(-1, 1, simulator.fleet.m))
        history.append(simulator.x[0].copy())
    layout, information = simulator.observers.layout, simulator.observers.information(simulator.state)
    for (a, i), at in layout.slot.items():
        pair, distance = layout.column_pair[at], abs(a - i)
        assert information.hops[pair, 0] == distance
        assert information.age[pair, 0] == pytest.approx(0.05 * rounds[distance - 1])
        p = history[20 - rounds[distance - 1]][simulator.fleet.state_slice(i)]
        for _ in range(rounds[distance - 1]):
            p = p + 0.05 * simulator.fleet.models[i].drift(np.zeros(1), p[None])[0]
        np.testing.assert_allclose(simulator.estimates[0, at : at + 4], p, atol=1e-12)


def test_rounds_between_grid_points_take_place_at_the_next_one():
    simulator = chain([SingleIntegrator()] * 2, Network(period=0.03), k=2)
    ages = []
    for _ in range(6):
        simulator.step(0.02, np.ones(4))
        ages.append(simulator.observers.information(simulator.state).age[0, 0])
    # due at 0.03, 0.06, 0.09, 0.12 s; grid times 0.02, 0.04, ...
    np.testing.assert_allclose(ages, [0.02, 0.0, 0.0, 0.02, 0.0, 0.0], atol=1e-12)
    assert simulator.parts_of(0.1) == 4  # steps longer than a period are divided


def everything(simulator: Simulator, b: int) -> dict[str, np.ndarray]:
    return {name: values[..., b].copy() for name, values in simulator.state.arrays().items() if name != "drawn"}


@settings(max_examples=12)
@given(system=systems(), network=NETWORKS, estimator=st.sampled_from(list(ESTIMATORS)), noise=NOISES)
def test_a_batch_is_its_single_runs_and_restored_ones_go_on_with_the_same_bits(system, network, estimator, noise):
    observers = Networked(replace(network, noise=noise), estimator)
    batch, single = system.simulator(observers, num_envs=3), system.simulator(observers)
    single.reset(system.seed + 1)
    rng = np.random.default_rng(system.seed)
    inputs = [bang_bang(batch, rng) for _ in range(12)]
    for number, u in enumerate(inputs):
        if number == 6:
            saved = copy.deepcopy(batch.save())
        batch.step(0.05, u)
        single.step(0.05, u[1:2])
    for name, values in everything(batch, 1).items():
        np.testing.assert_array_equal(values, everything(single, 0)[name], err_msg=name)
    last = everything(batch, 2)
    other = system.simulator(Networked(replace(network, noise=noise), estimator), num_envs=3)
    other.restore(saved)
    for u in inputs[6:]:
        other.step(0.05, u)
    for name, values in everything(other, 2).items():
        np.testing.assert_array_equal(values, last[name], err_msg=name)
    other.reset(system.seed + 7, env_ids=[0])
    for name, values in everything(other, 2).items():
        np.testing.assert_array_equal(values, last[name], err_msg=name)


@settings(max_examples=20)
@given(seed=SEEDS, estimator=st.sampled_from(list(ESTIMATORS)), loss=st.sampled_from([0.5, 1.0]))
def test_what_was_not_delivered_changes_nothing(seed, estimator, loss):
    """Other agents' true states since the last delivery, and with a loss of 1 all of them, are unknown."""
    simulator = paper().build(observers=Networked(f"ideal:loss={loss}", estimator)).reset(seed)
    rng = np.random.default_rng(seed)
    for _ in range(10):
        simulator.step(0.05, bang_bang(simulator, rng))
    before = simulator.estimates.copy(), simulator.error_bounds().bound.copy()
    saved = simulator.save()
    saved.x[...] += 1.0
    channel = saved.memory
    arrived = np.zeros(channel["channel.sent"].shape[0], bool)
    arrived[channel["channel.newest"][channel["channel.newest"] >= 0] % len(arrived)] = True
    channel["channel.sent"][~arrived] += 1.0
    simulator.restore(saved)
    np.testing.assert_array_equal(simulator.estimates, before[0])
    np.testing.assert_array_equal(simulator.error_bounds().bound, before[1])
    if loss == 1.0:
        assert np.isinf(simulator.observers.information(simulator.state).age).all()
        other = paper().build(observers=Networked("ideal:loss=1", estimator)).reset(seed + 1)
        for _ in range(10):
            other.step(0.05, bang_bang(other, rng))
        np.testing.assert_array_equal(simulator.estimates, other.estimates)


def test_rounds_converge_to_the_ideal_observers_as_the_period_falls():
    """To order 1: what a neighbour sent is one period old."""
    scenario = paper()
    u = np.random.default_rng(0).uniform(-2.0, 2.0, scenario.fleet.m)

    def estimates(observers, dt: float) -> np.ndarray:
        simulator = scenario.build(observers=observers).reset(3)
        for _ in range(round(1.0 / dt)):
            simulator.step(dt, u)
        return simulator.state.memory.get("ppso.estimate", simulator.state.memory["estimate"])[:, 0]

    ideal = estimates(Proximal(2), 5e-4)
    periods = np.array([0.02, 0.01, 0.005, 0.0025])
    gaps = np.array([np.abs(estimates(Networked(Network(period=T), "ppso"), T) - ideal).max() for T in periods])
    order = np.polyfit(np.log(periods), np.log(gaps), 1)[0]
    print(f"largest distance to the ideal estimates: {gaps.round(4)} m at {periods} s, order {order:.2f}")
    assert 0.9 < order < 1.3
    assert gaps[-1] < 0.02


@settings(max_examples=30)
@given(system=systems(), seed=SEEDS, tau=st.floats(1e-4, 1.0))
def test_rounds_of_one_instant_end_at_the_proximal_step(system, seed, tau):
    """Each observer solves its own equation with the others' last solutions: the fixed point is the coupled one."""
    layout = system.design.states.layout
    if not layout.size:
        return
    rng, batch = np.random.default_rng(seed), 2
    predictor = rng.normal(0.0, 1.0, (layout.size, batch))
    source = rng.normal(0.0, 1.0, (system.design.fleet.n, batch))
    rho = rng.uniform(0.1, 2.0, (layout.rows, batch))
    coupled, slope, eps = predictor.copy(), np.zeros_like(predictor), np.zeros_like(predictor)
    solve(layout.packed, tau, coupled, source, rho, eps, coupled, slope, (0, batch), (0, len(layout.target)))
    arrays, places, start, offset, relayed = layout.arrays, [], [0], [], []
    for block in layout.blocks:
        for pair in range(block.pairs.start, block.pairs.stop):
            offset.append(len(places))
            ways = [
                block.columns.start + int(b) * block.components
                for b in arrays.entry[arrays.entry_start[pair] : arrays.entry_start[pair + 1]]
            ]
            count = int(arrays.relay[pair])
            for first in ways:
                places += [first + c for c in range(block.components)]
                relayed += [-1] * block.components
            places += list(range(block.sources.start, block.sources.stop)) * count
            relayed += [1] * block.components * count
            start.append(start[-1] + len(ways) + count)
    places, from_source = np.array(places), np.array(relayed) > 0
    y, eps, e = predictor.copy(), np.zeros_like(predictor), np.zeros_like(predictor)
    for _ in range(20_000):
        held = np.where(from_source[:, None], source[places * from_source], y[places * ~from_source])
        following = predictor.copy()
        solve_alone(
            layout.packed,
            np.array(start),
            np.array(offset),
            tau,
            held,
            rho,
            np.ones(batch, bool),
            eps,
            following,
            e,
            0,
            batch,
        )
        if np.abs(following - y).max() < 1e-13:
            break
        y = following
    np.testing.assert_allclose(y, coupled, atol=1e-8)


@settings(max_examples=50)
@given(seed=SEEDS, scale=st.floats(-6, 6), stiffness=st.floats(-8, 8))
def test_the_scalar_solve_is_exact_from_any_warm_start(seed, scale, stiffness):
    layout = ObserverDesign(Fleet([SingleIntegrator()] * 3), nx.path_graph(3), 2, *[Exponential(9.0, 9.0, 1.0)] * 2)
    packed, rng, batch = layout.states.layout.packed, np.random.default_rng(seed), 200
    size = layout.states.layout.size
    predictor, held = 10.0**scale * rng.normal(size=(size, batch)), np.zeros((size, batch))
    rho, tau = np.ones((layout.states.layout.rows, batch)), 10.0**stiffness
    found = []
    for warm in (np.zeros((size, batch)), rng.normal(0.0, 30.0, (size, batch))):
        y, e = predictor.copy(), np.zeros((size, batch))
        pairs = layout.states.layout.pairs
        solve_alone(
            packed,
            np.arange(pairs + 1),
            2 * np.arange(pairs),
            tau,
            held,
            rho,
            np.ones(batch, bool),
            warm,
            y,
            e,
            0,
            batch,
        )
        np.testing.assert_allclose(e, np.tanh(warm / 2.0), atol=1e-14)  # of eps, which is returned in its place
        for side in (-1.0, 1.0):  # the equation changes its sign within 1e-9 of the solution
            near = warm + side * 1e-9 * (1.0 + np.abs(warm))
            excess = np.tanh(near / 2.0) + tau * near * (1.0 + np.cosh(near)) - predictor
            assert (side * excess >= 0.0).all()
        found.append(y)
    np.testing.assert_allclose(found[0], found[1], rtol=1e-11, atol=1e-12)


class LastHeard(Relay):
    """An estimator of a user's own: the freshest state as it was, without prediction."""

    name = "held"
    proposed = "held.state"

    def prepare(self, design, network, num_envs, first_row):
        super().prepare(design, network, num_envs, first_row)
        self._size, self._batch = design.knowledge.size, num_envs
        self.proposal = np.array(sorted(design.knowledge.slot.values()))

    def allocate(self):
        return {"held.state": np.zeros((self._size, self._batch))}

    def receive(self, state, take, due):
        fresh = state.memory["arrived"] == state.t
        fresh = fresh[np.repeat(np.arange(len(fresh)), 2)]
        state.memory["held.state"][fresh] = state.memory["center"][fresh]


def test_an_estimator_of_ones_own_is_a_class():
    simulator = chain([SingleIntegrator()] * 4, "wifi", LastHeard(), num_envs=2)
    for _ in range(20):
        simulator.step(0.05, np.ones(8))
        assert excess(simulator) <= 1.0
    assert repr(simulator.observers).endswith("held)")


class Drag(AgentModel):
    """x' = -30 x + u: faster than steps of 50 ms can follow."""

    type, states, inputs, position, input_limit = "drag", {"x": "m"}, {"u": "m/s"}, ("x",), 1.0

    def drift(self, t, x):
        return -30.0 * x

    def input_map(self, t, x, u):
        return u

    def drift_lipschitz(self):
        return self.lipschitz

    def drift_growth(self, region=None):
        return Growth(np.array([[self.declared]]))


@pytest.mark.parametrize(("declared", "lipschitz"), [(-30.0, 30.0), (-30.0, np.inf), (0.0, 30.0), (0.0, np.inf)])
def test_steps_are_divided_until_fast_decays_are_certified(declared, lipschitz):
    """As declared, as the Lipschitz constant allows, or as seen; too long a step makes 1 + h df/dx negative."""
    Drag.declared, Drag.lipschitz = declared, lipschitz
    simulator = chain([Drag()] * 4, "wifi:loss=0.3", num_envs=4).reset(0)
    rng = np.random.default_rng(0)
    for _ in range(60):
        simulator.step(0.05, bang_bang(simulator, rng))
        assert excess(simulator) <= 1.0
    assert simulator.parts_of(0.05) == 2


@pytest.mark.parametrize("network", ["ideal:latency=0.05", "ideal:latency=0.12", "lossy:loss=0.3"])
def test_steps_of_changing_length_leave_bounds_certified(network):
    """What is on its way meanwhile can't be moved as the plant was: it counts as lost."""
    simulator = mixed_fleet().build(observers=Networked(network, "relay"), num_envs=8).reset(0)
    rng = np.random.default_rng(0)
    for number in range(120):
        simulator.step((0.05, 0.002)[number % 2] if number < 80 else 0.05, bang_bang(simulator, rng))
        assert excess(simulator) <= 1.0
    assert simulator.extremes.relative.max() <= 1.0 + 1e-9
    assert np.isfinite(simulator.observers.information(simulator.state).age).all()


def test_a_limit_is_the_same_after_a_restore():
    first, second = (paper().build(observers=Networked("wifi", "relay")).reset(0) for _ in range(2))
    for _ in range(7):
        first.step(0.02, np.ones(first.fleet.m))
    second.restore(first.save())
    found = [each.observers.limits(each.state, np.empty_like(each.state.memory["bound"])) for each in (first, second)]
    np.testing.assert_array_equal(*found)


def test_an_error_that_is_not_a_number_is_reported():
    for error in ([np.nan, 0.1], [0.1, np.nan]):
        largest = np.zeros(1)
        largest_share(np.array([0, 0]), np.array(error)[:, None], np.zeros((1, 1)), np.ones((2, 1)), largest, 0, 1)
        assert np.isnan(largest[0])


def test_a_proposal_that_is_not_a_number_gives_the_prediction():
    simulator = chain([SingleIntegrator()] * 3, "wifi", LastHeard())
    simulator.state.memory["held.state"][...] = np.nan
    simulator.observers._clip(simulator.state.memory, (0, 1))
    np.testing.assert_array_equal(simulator.estimates.T, simulator.state.memory["center"])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"proposal": np.zeros(3, int)}, r"proposal must be \(6,\) integers, a row of 'held.state' for each pair"),
        ({"proposal": np.full(6, 50)}, "proposal asks for 52 rows, and 'held.state' has 12"),
        ({"proposed": "kept.state"}, "proposed = 'kept.state' isn't in its memory, held.state"),
        ({"width": 2}, r"message\(\) has 0 rows, its width is 2"),
        ({"width": None}, r"width must be the number of rows of message\(\), 0 for none; got None"),
        (
            {"allocate": lambda: {"held.state": np.zeros((12, 1)), "stamp": np.zeros(6)}},
            "its memory has 'stamp', which messages use themselves; choose other names, e.g. 'held.stamp'",
        ),
        ({"allocate": lambda: None}, r"allocate\(\) must return a dictionary of arrays, empty for none; got None"),
    ],
)
def test_estimators_that_would_write_beyond_their_rows_are_refused(changes, message):
    class Wrong(LastHeard):
        def prepare(self, *arguments):
            super().prepare(*arguments)
            vars(self).update(changes)

    with pytest.raises(ValueError, match=f"estimator 'held': {message}"):
        chain([SingleIntegrator()] * 3, "wifi", Wrong())


def test_mistakes_are_named():
    with pytest.raises(ValueError, match="no estimator 'realy'; did you mean 'relay'"):
        Networked("wifi", "realy")
    with pytest.raises(ValueError, match="no network 'wify'; did you mean 'wifi'"):
        Networked("wify")
    with pytest.raises(ValueError, match=r"needs a network, e\.g\. .wifi."):
        Networked(None)
    with pytest.raises(ValueError, match="which has no prepare"):
        Networked("wifi", type("Mine", (), {"name": "mine"})())
    with pytest.raises(ValueError, match=r"an estimator is an object, not a class: write Relay\(\)"):
        Networked("wifi", Relay)
    with pytest.raises(ValueError, match=r"observers are an object, not a class: write Proximal\(\)"):
        paper().build(observers=Proximal)
    with pytest.raises(ValueError, match=r"khop_env\.observers\.Observers says; .* has no name"):
        paper().build(observers=FunnelObservers())


def test_a_step_that_is_interrupted_half_way_cannot_be_gone_on_from():
    simulator = chain([SingleIntegrator()] * 3, "wifi")

    def interrupted(*_):
        raise KeyboardInterrupt

    with pytest.MonkeyPatch.context() as patch:
        patch.setattr(simulator.observers.estimator, "message", interrupted)
        with pytest.raises(KeyboardInterrupt):
            simulator.step(0.05)
    with pytest.raises(RuntimeError, match="interrupted half-way: reset all environments"):
        simulator.step(0.05)
    simulator.reset(1)
    simulator.step(0.05)
