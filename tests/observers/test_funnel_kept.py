"""The guarantee: the proximal step keeps every funnel at every grid point, whatever the step and whatever jumps."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st
from strategies import System, systems

from khop_env.observers import Proximal
from khop_env.physics import SurfaceVessel
from khop_env.simulation import Simulator

STEPS = st.floats(np.log(1e-4), 0.0).map(lambda exponent: float(np.exp(exponent)))
"""Any step from 1e-4 s to 1 s, as likely in each decade."""


def has_vessels(system: System) -> bool:
    """Whether the fleet has agents whose drift grows with the square of a state."""
    return any(isinstance(model, SurfaceVessel) for model in system.design.fleet.models)


def assert_inside(simulator: Simulator) -> None:
    """|xi| < rho and |mu| < omega, and what the design rule makes of them: |x_tilde| < delta and |g_tilde| < theta."""
    extremes = simulator.extremes
    for name in ("normalized", "relative", "input_normalized", "input_relative"):
        assert np.all(getattr(extremes, name) < 1.0), f"{name}: {getattr(extremes, name)}"
    for numbers in (simulator.x, simulator.estimates, simulator.input_estimates):
        assert np.all(np.isfinite(numbers))


@pytest.mark.parametrize("order", [1, 2])
@settings(max_examples=150)
@given(system=systems(), dt=STEPS, decades=st.floats(-1.0, 3.0), vary=st.booleans(), batch=st.integers(1, 3))
def test_funnels_are_kept_for_any_step_and_any_jump_of_input_and_state(order, system, dt, decades, vary, batch):
    """numerics, section 2: |xi+| < rho(t+) for every tau > 0, every predictor and every jump of x_i, u_i or rho.

    Random graphs, relay or not, fleets, funnels, observers with and without f and g_hat, and disturbances. Before each
    step every state and every input jumps to somewhere else, up to a thousand metres away; the step may change too.
    Vessels jump by 1 (m, rad, m/s, rad/s) at most: their drift is quadratic, and what an explicit step of 1 s makes of
    10 m/s sends the next predictor 1e8 m away, where the rounding of a position is felt in a funnel of a centimetre.
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


@pytest.mark.parametrize("order", [1, 2])
@settings(max_examples=60)
@given(system=systems(input_observer=True), dt=STEPS)
def test_funnels_are_kept_from_the_start_under_inputs_at_their_limits(order, system, dt):
    """The same for what a policy can do: inputs that flip between their limits every step, states that follow.

    An explicit step of a vessel's quadratic drag diverges above about 0.1 s; that is the plant's, not the observers'.
    """
    longest = 0.05 if has_vessels(system) else 1.0
    simulator = system.simulator(Proximal(order), 2)
    rng = np.random.default_rng(system.seed)
    limit = np.minimum(system.design.fleet.input_limit, 10.0)
    for _ in range(15):
        simulator.step(min(dt, longest), limit * rng.choice((-1.0, 1.0), (2, len(limit))))
        assert_inside(simulator)


@settings(max_examples=60)
@given(system=systems(), dt=STEPS, where=st.floats(0.0, 1.0))
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
