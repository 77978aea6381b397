"""The guarantee: the proximal step keeps every funnel at every grid point, whatever the step and whatever jumps."""

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents import make_law
from khop_env.observers import Exponential, ObserverDesign, Proximal
from khop_env.physics import DoubleIntegrator, Fleet, SingleIntegrator, SurfaceVessel
from khop_env.registry import scenario, scenarios
from khop_env.simulation import InitialSet, Simulator
from khop_env.simulation.plant import parts_of_step
from tests.strategies import System, systems

STEPS = st.floats(np.log(1e-4), 0.0).map(lambda exponent: float(np.exp(exponent)))
"""Any step from 1e-4 s to 1 s, as likely in each decade."""


SYSTEMS = systems() | systems(directed=True)


def has_vessels(system: System) -> bool:
    """True if the fleet has agents whose drift grows with the square of a state."""
    return any(isinstance(model, SurfaceVessel) for model in system.design.fleet.models)


def assert_inside(simulator: Simulator) -> None:
    """|xi| < rho and |mu| < omega, and what the design rule makes of them: |x_tilde| < delta and |g_tilde| < theta."""
    extremes = simulator.extremes
    for name in ("normalized", "relative", "input_normalized", "input_relative"):
        assert np.all(getattr(extremes, name) < 1.0), f"{name}: {getattr(extremes, name)}"
    for numbers in (simulator.x, simulator.estimates, simulator.input_estimates):
        assert np.all(np.isfinite(numbers))


@pytest.mark.parametrize("order", [1, 2, 3])
@settings(max_examples=150)
@given(system=SYSTEMS, dt=STEPS, decades=st.floats(-1.0, 3.0), vary=st.booleans(), batch=st.integers(1, 3))
def test_funnels_are_kept_for_any_step_and_any_jump_of_input_and_state(order, system, dt, decades, vary, batch):
    """|xi+| < rho(t+) for every tau > 0, every predictor and every jump of x_i, u_i or rho.

    Random graphs, directed or not, relay or not, fleets, funnels, observers with and without f and g_hat, and
    disturbances. Before each step every state and every input jumps to somewhere else, up to a thousand metres away;
    the step may change too. Vessels jump by 1 (m, rad, m/s, rad/s) at most: their drift is quadratic, and steps are
    divided for velocities that they can come to by themselves. What a step makes of 10 m/s sends the next predictor 1e8
    m away, where the rounding of a position is felt in a funnel of a centimetre.
    """
    simulator = system.simulator(Proximal(order), batch)
    assert_inside(simulator)
    rng = np.random.default_rng(system.seed)
    reach = 10.0 ** (min(decades, 0.0) if has_vessels(system) else decades)
    for _ in range(12):
        simulator.state.x[...] = reach * rng.uniform(-1.0, 1.0, simulator.state.x.shape)
        u = reach * rng.choice((-1.0, 0.0, 0.3, 1.0), (batch, system.design.fleet.m))
        simulator.step(dt * (10.0 ** rng.uniform(-1.0, 0.0) if vary else 1.0), u)
        assert_inside(simulator)


@pytest.mark.parametrize("order", [1, 2, 3])
@settings(max_examples=60)
@given(system=systems(input_observer=True) | systems(input_observer=True, directed=True), dt=STEPS)
def test_funnels_are_kept_from_the_start_under_inputs_at_their_limits(order, system, dt):
    """The same for what a policy can do: inputs that flip between their limits every step, states that follow."""
    simulator = system.simulator(Proximal(order), 2)
    rng = np.random.default_rng(system.seed)
    limit = np.minimum(system.design.fleet.input_limit, 10.0)
    for _ in range(15):
        simulator.step(dt, limit * rng.choice((-1.0, 1.0), (2, len(limit))))
        assert_inside(simulator)


@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize("name", scenarios())
def test_any_step_to_a_second_keeps_the_funnels_of_every_scenario(name, order):
    """In closed loop, to the scenario's end: the plant's own drift, however stiff, doesn't run away from them."""
    chosen = scenario(name)
    simulator = chosen.build(law=make_law(chosen.law), observers=Proximal(order), num_envs=10)
    for dt in (0.1, 0.3, 0.6, 0.7, 0.8, 1.0):
        simulator.reset(0)
        for _ in range(round(chosen.duration / dt)):
            simulator.step(dt)
        assert_inside(simulator)
        assert np.abs(simulator.x).max() < 50.0


@pytest.mark.parametrize("order", [1, 2, 3])
@pytest.mark.parametrize("dt", [0.05, 0.3, 1.0])
def test_a_fleet_with_vessels_is_kept_under_inputs_that_flip_between_their_limits(dt, order):
    chosen = scenario("mixed_fleet")
    simulator = chosen.build(observers=Proximal(order), num_envs=10)
    rng = np.random.default_rng(0)
    for _ in range(round(60.0 / dt)):
        simulator.step(dt, rng.choice((-1.0, 1.0), (10, chosen.fleet.m)) * chosen.fleet.input_limit)
    assert_inside(simulator)


class TestStepsThatTheDriftCannotTake:
    """A cart whose velocity decays within 10 ms, alone on a line of three."""

    @staticmethod
    def simulator(damping: float = 100.0, num_envs: int = 1) -> Simulator:
        fleet = Fleet([SingleIntegrator(), DoubleIntegrator(damping), SingleIntegrator()])
        bound = Exponential(30.0, 1.0, 1.0)
        design = ObserverDesign(fleet, nx.path_graph(3), 2, bound, Exponential(3e3, 3e3, 1.0))
        return Simulator(design, InitialSet(np.zeros(fleet.n), np.ones(fleet.n)), num_envs=num_envs).reset(1)

    def test_are_divided_evenly(self):
        whole, parts = self.simulator(), self.simulator()
        u = np.full(whole.fleet.m, 0.5)
        whole.step(0.035, u)
        for _ in range(4):  # 0.035 s are more than three times the 10 ms that the cart takes
            parts.step(0.035 / 4, u)
        for name in ("t", "x", "estimates", "input_estimates"):
            assert np.array_equal(getattr(whole, name), getattr(parts, name)), name

    def test_do_not_make_states_diverge(self):
        simulator = self.simulator()
        for _ in range(30):
            simulator.step(1.0)
        assert np.abs(simulator.x).max() < 3.0
        assert_inside(simulator)

    def test_shorter_ones_are_single_steps(self):
        assert [parts_of_step(dt, 0.01, "cart_0") for dt in (1e-9, 0.01, 0.0101, 0.02, 1.0)] == [1, 1, 2, 2, 100]
        assert parts_of_step(1e9, np.inf, "cart_0") == 1

    def test_are_refused_where_they_would_have_too_many_parts(self):
        simulator = self.simulator(damping=1e300)
        before = simulator.x.copy()
        with pytest.raises(ValueError, match=r"dt = 1 s is too long: the drift of 'cart_0' takes 1e-300 s at a time"):
            simulator.step(1.0, np.zeros(simulator.fleet.m))
        assert np.array_equal(simulator.x, before)

    def test_a_failure_halfway_leaves_the_state_as_it_was(self):
        simulator = self.simulator(num_envs=2)
        saved, steps = simulator.save(), []
        advance = simulator.observers.advance

        def fails_the_third_time(plant, before, state, dt):
            steps.append(dt)
            if len(steps) == 3:
                raise FloatingPointError
            advance(plant, before, state, dt)

        simulator.observers.advance = fails_the_third_time
        simulator._compiled = None  # which wouldn't call it
        with pytest.raises(FloatingPointError):
            simulator.step(0.05)
        for name, values in simulator.save().arrays().items():
            assert np.array_equal(values, saved.arrays()[name]), name


@settings(max_examples=60)
@given(system=SYSTEMS, dt=STEPS, where=st.floats(0.0, 1.0))
def test_an_episode_may_resume_anywhere(system, dt, where):
    """From a restored state whose estimates lie anywhere, outside their funnels too, one step leads inside."""
    simulator = system.simulator(Proximal(), 2)
    saved = simulator.save()
    rng = np.random.default_rng(system.seed)
    for name, reach in (("estimate", 100.0 * where), ("input_estimate", 100.0 * where), ("eps", 1.0)):
        saved.memory[name][...] = reach * rng.normal(size=saved.memory[name].shape)
    saved.t[...] = rng.uniform(0.0, 20.0, 2)
    simulator.restore(saved)
    simulator.restart_extremes()  # the restored state needn't be inside
    simulator.step(dt, np.zeros(system.design.fleet.m))
    assert_inside(simulator)
