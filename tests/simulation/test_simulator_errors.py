"""Errors of the simulator; after each its state is unchanged."""

import networkx as nx
import numpy as np
import pytest

from agents import make_law
from khop_env.observers import DesignError, Explicit, Exponential, ObserverDesign, Proximal, SolveError, TargetObservers
from khop_env.observers.solve import LANES
from khop_env.physics import AgentModel, DriftingIntegrator, Fleet, SingleIntegrator
from khop_env.scenarios import paper
from khop_env.simulation import InitialSet, Simulator, SimulatorState

WIDE = Exponential(100.0, 1.0, 1.0)
INTEGRATORS = {
    "order 1": lambda: Proximal(1),
    "order 2": Proximal,
    "two threads": lambda: Proximal(threads=2),
    "explicit": Explicit,
}


def assert_same(one: SimulatorState, other: SimulatorState) -> None:
    """Bit for bit."""
    for name, values in one.arrays().items():
        np.testing.assert_array_equal(values, other.arrays()[name], err_msg=name)


def held(batch: int = 3) -> Simulator:
    """Mixed agents without a law, a few steps into an episode."""
    fleet = Fleet([SingleIntegrator(), DriftingIntegrator(), SingleIntegrator()])
    design = ObserverDesign(fleet, nx.path_graph(3), 2, WIDE, WIDE)
    simulator = Simulator(design, InitialSet(np.zeros(6), np.ones(6)), num_envs=batch)
    simulator.step(0.1, np.full(6, 0.5))
    return simulator


@pytest.mark.parametrize("dt", [0.0, -0.1, np.nan, np.inf])
def test_steps_that_are_no_steps_are_refused(dt):
    """dt must be positive and finite."""
    simulator = held()
    before = simulator.save()
    with pytest.raises(ValueError, match="dt must be positive and finite; got"):
        simulator.step(dt, np.zeros(6))
    assert_same(simulator.save(), before)


@pytest.mark.parametrize("shape", [(5,), (3, 5), (2, 6), (6, 3), (1, 3, 6), ()])
def test_inputs_of_a_wrong_shape_are_refused(shape):
    """(m,) or (B, m), nothing else: no broadcasting of what might be a mistake."""
    simulator = held()
    before = simulator.save()
    with pytest.raises(ValueError, match=r"u must have shape \(6,\) or \(3, 6\); got"):
        simulator.step(0.1, np.zeros(shape))
    assert_same(simulator.save(), before)


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_inputs_that_are_not_finite_name_the_agent(bad):
    """Architecture, decision 8: an error that names the agent, and its input."""
    simulator = held()
    before = simulator.save()
    u = np.zeros((3, 6))
    u[1, 3] = bad
    with pytest.raises(ValueError, match=r"input 'u2' \(m/s\) of 'drifter_0' isn't finite"):
        simulator.step(0.1, u)
    u = np.zeros(6)
    u[4] = bad
    with pytest.raises(ValueError, match=r"input 'vx' \(m/s\) of 'integrator_1' isn't finite"):
        simulator.step(0.1, u)
    assert_same(simulator.save(), before)


def test_inputs_are_held_until_others_are_given():
    """Both shapes mean what they say, and no inputs mean the last ones."""
    simulator, other = held(), held()
    simulator.step(0.1, np.arange(6.0) / 10)
    other.step(0.1, np.tile(np.arange(6.0) / 10, (3, 1)))
    assert_same(simulator.save(), other.save())
    simulator.step(0.1)
    other.step(0.1, simulator.u)
    assert_same(simulator.save(), other.save())
    np.testing.assert_array_equal(simulator.u[2], np.arange(6.0) / 10)


def test_inputs_for_a_simulator_with_a_law_are_refused():
    """The law computes them."""
    simulator = paper().build(law=make_law("tanh"))
    before = simulator.save()
    with pytest.raises(ValueError, match=r"this simulator has a law.*law=None"):
        simulator.step(0.1, np.zeros(16))
    assert_same(simulator.save(), before)


@pytest.mark.parametrize(
    "x0", [np.zeros(5), np.zeros((2, 6)), np.zeros((6, 3)), np.full(6, np.nan), np.full((3, 6), np.inf)]
)
def test_initial_states_of_a_wrong_shape_or_not_finite_are_refused(x0):
    """(n,) or (B, n), and the episode under way goes on."""
    simulator = held()
    before = simulator.save()
    with pytest.raises(ValueError, match=r"x0 must be finite, of shape \(6,\) or \(3, 6\); got shape"):
        simulator.reset(0, x0=x0)
    assert_same(simulator.save(), before)


def test_an_initial_state_that_no_funnel_holds_is_refused():
    """|xi(0)| < rho(0) is a condition of every theorem, for given initial states as well as drawn ones."""
    simulator = held()
    before = simulator.save()
    x0 = np.zeros((3, 6))
    x0[2, 4] = 101.0
    with pytest.raises(
        DesignError, match=r"state observers of 'integrator_1'.*component 'x' may have \|xi\(0\)\| = 101"
    ):
        simulator.reset(0, x0=x0)
    assert_same(simulator.save(), before)
    x0[2, 4] = 99.0
    simulator.reset(0, x0=x0)
    np.testing.assert_array_equal(simulator.x, x0)
    assert simulator.extremes.normalized[2] == pytest.approx(0.99)


def test_seeds_have_to_match_the_batch():
    """One, or one per environment."""
    with pytest.raises(ValueError, match="expected one seed or 3, one per environment; got 2"):
        held().reset([1, 2])


def test_what_a_simulator_is_built_from_is_checked():
    """A law without task graph, an empty batch, an unknown view, an infeasible initial set, unknown orders."""
    simulator = held()
    design, initial = simulator.design, simulator.initial
    with pytest.raises(ValueError, match="task graph; give task="):
        Simulator(design, initial, law=make_law("tanh"))
    with pytest.raises(ValueError, match="num_envs must be at least 1; got 0"):
        Simulator(design, initial, num_envs=0)
    with pytest.raises(ValueError, match="observe must be one of estimate, oracle, local; got 'truth'"):
        Simulator(design, initial, task=nx.path_graph(3), observe="truth")
    with pytest.raises(DesignError, match=r"take delta\(0\) above 200"):
        Simulator(design, InitialSet(np.zeros(6), np.full(6, 200.0)))
    with pytest.raises(ValueError, match="order 1, 2 and 3; got order=4"):
        Proximal(order=4)
    for threads in (0, 10**6, 2.5, True):
        with pytest.raises(ValueError, match=f"threads must be an integer from 1 to 256; got {threads}"):
            Proximal(threads=threads)


@pytest.mark.parametrize(
    ("center", "radius", "message"),
    [
        (np.zeros(6), np.full(6, -1.0), "radius must not be negative; got -1 for component 0"),
        (np.zeros(6), np.full(6, np.nan), "center and radius must be finite"),
        (np.full(6, np.inf), np.ones(6), "center and radius must be finite"),
        (np.zeros(6), np.ones(5), r"\(n,\) each"),
    ],
)
def test_initial_sets_are_boxes(center, radius, message):
    with pytest.raises(ValueError, match=message):
        InitialSet(center, radius)


def test_a_law_that_returns_a_wrong_shape_is_named():
    """(B, m), and the message says what came instead."""

    def wrong(t, view):
        return np.zeros(6)

    simulator = held()
    with pytest.raises(ValueError, match=r"wrong.* returned inputs of shape \(6,\); expected .* \(1, 6\)"):
        Simulator(simulator.design, simulator.initial, law=wrong, task=nx.path_graph(3))


class Broken(AgentModel):
    """An agent whose drift is no number any more after a tenth of a second, in one component of one environment."""

    type = "broken"
    states = {"x": "m", "y": "m"}  # noqa: RUF012
    inputs = {"vx": "m/s", "vy": "m/s"}  # noqa: RUF012
    position = ("x", "y")
    input_limit = 1.0

    def __init__(self, value, component, environment):
        self.value, self.component, self.environment = value, component, environment
        super().__init__()

    def drift(self, t, x):
        rate = np.zeros_like(x)
        if x.ndim == 3 and np.any(t > 0.1):
            rate[self.environment, ..., self.component] = self.value
        return rate

    def input_map(self, t, x, u):
        return u


@pytest.mark.filterwarnings("ignore:invalid value")  # inf - inf on the way to the error
@pytest.mark.parametrize("integrator", INTEGRATORS)
@pytest.mark.parametrize("value", [np.nan, np.inf])
@pytest.mark.parametrize(("batch", "environment"), [(1, 0), (5, 3), (LANES + 3, LANES + 1)])
@pytest.mark.parametrize("component", [0, 1])
def test_a_model_that_returns_no_number_is_an_error(integrator, value, batch, environment, component):
    """`Simulator.step`: SolveError if a right-hand side gives numbers that aren't finite, naming agent and
    environment; the state is then the one before the step.
    """
    fleet = Fleet([SingleIntegrator(), SingleIntegrator(), Broken(value, component, environment), SingleIntegrator()])
    design = ObserverDesign(fleet, nx.path_graph(4), 3, WIDE, WIDE)
    simulator = Simulator(
        design, InitialSet(np.zeros(8), np.ones(8)), observers=INTEGRATORS[integrator](), num_envs=batch
    )
    with pytest.raises(SolveError, match=rf"environment {environment}\b.*'broken_0'"):  # noqa: PT012
        for _ in range(20):
            before = simulator.save()
            simulator.step(0.01, np.zeros(8))
    assert 0.09 < before.t[0] < 0.13
    after = simulator.save()
    assert_same(after, before)
    assert all(np.all(np.isfinite(values)) for values in after.memory.values())


@pytest.mark.parametrize("integrator", [Proximal, Explicit])
def test_a_model_that_returns_no_number_is_an_error_though_nobody_observes_it(integrator):
    """The middle of a star is everybody's neighbour, so nobody's target; its state mustn't turn into NaN in silence."""
    fleet = Fleet([Broken(np.nan, 0, 0), SingleIntegrator(), SingleIntegrator(), SingleIntegrator()])
    design = ObserverDesign(fleet, nx.star_graph(3), 2, WIDE, WIDE)
    simulator = Simulator(design, InitialSet(np.zeros(8), np.ones(8)), observers=integrator())
    with pytest.raises(SolveError, match="'broken_0'"):  # noqa: PT012
        for _ in range(20):
            simulator.step(0.01, np.zeros(8))


@pytest.mark.parametrize("batch", [1, 5])
def test_an_estimate_that_is_no_number_is_an_error(batch):
    """A drift may fail at an estimate though not at the state. In a star without relay M is the identity, so one
    observer's NaN doesn't spread to others that would show it.
    """
    fleet = Fleet([SingleIntegrator()] * 4)
    design = ObserverDesign(fleet, nx.star_graph(3), 1, WIDE, WIDE, relay=False)
    simulator = Simulator(design, InitialSet(np.zeros(8), np.ones(8)), num_envs=batch)
    state = simulator.save()
    state.memory["estimate"][design.states.layout.slot[1, 0], batch - 1] = np.nan
    simulator.restore(state)
    with pytest.raises(SolveError, match=rf"environment {batch - 1}\b.*'integrator_0'"):
        simulator.step(0.01, np.zeros(8))


def test_extremes_show_a_state_that_is_not_finite():
    """A restored state isn't checked; the guarantee must not look kept then."""
    simulator = held()
    state = simulator.save()
    state.x[0, 1] = np.nan
    simulator.restore(state)
    assert np.isinf(simulator.extremes.normalized[1])
    assert np.all(simulator.extremes.normalized[[0, 2]] < 1.0)


def test_a_wrong_shape_from_a_model_is_the_user_s_own_error():
    """A user's mistake names the model, and a user's own exception in a step comes through as it is."""

    class Flat(Broken):
        type = "flat"

        def drift(self, t, x):
            return x if len(x) > 1 else x[..., 0]  # right where the fleet checks it

    class Raising(Broken):
        type = "raising"

        def drift(self, t, x):
            if len(x) > 1:
                return x
            raise KeyError("mine")

    for model, error, message in ((Flat, ValueError, "Flat.drift"), (Raising, KeyError, "mine")):
        fleet = Fleet([SingleIntegrator(), SingleIntegrator(), model(0.0, 0, 0)])
        design = ObserverDesign(fleet, nx.path_graph(3), 2, WIDE, WIDE)
        simulator = Simulator(design, InitialSet(np.zeros(6), np.ones(6)))
        with pytest.raises(error, match=message):
            simulator.step(0.1, np.zeros(6))


def test_an_input_observer_for_unbounded_inputs_can_be_simulated():
    """Theorem 3 needs a bounded derivative of g_i and |mu(0)| < omega(0), not a bounded g_i: with no limit on the
    inputs the initial set of g is what bounds mu(0), and inputs start at 0 here.
    """
    fleet = Fleet([DriftingIntegrator(input_limit=np.inf)] * 3)
    design = ObserverDesign(fleet, nx.path_graph(3), 2, WIDE, WIDE, targets=[TargetObservers()] * 3)
    simulator = Simulator(design, InitialSet(np.zeros(6), np.ones(6)))
    simulator.step(0.1, np.full(6, 3.0))
    assert simulator.extremes.input_normalized[0] < 1.0
