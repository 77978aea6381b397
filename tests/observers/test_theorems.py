"""The paper's theorems on random systems: every bound at every step, from the definitions and not from the library's
own.

Each theorem is run with the proximal step at steps of 0.05 s, where the funnels hold by construction and the theorem
says that the equations solved are the right ones, and with explicit Euler, which has no guarantee of its own: there
the funnels hold because the continuous-time observers keep them. Disturbances act in all runs.
"""

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents import TanhConsensus
from khop_env.observers import Explicit, Exponential, ObserverDesign, PairLayout, Proximal, TargetObservers
from khop_env.physics import DriftingIntegrator, Fleet
from khop_env.simulation import InitialSet, Simulator
from tests.strategies import OBSERVABLE_INPUT, PLANAR, SmoothSignals, System, definition_of_m, observers_of, systems

BOTH = pytest.mark.parametrize("integrator", ["proximal", "explicit"])


class Bounds:
    """delta, rho and own bound of every estimate, and M, from the graph and the functions that it was given."""

    def __init__(self, system: System, layout: PairLayout, given_bounds: dict) -> None:
        graph, relay = system.design.communication, system.design.relay
        self.m = np.zeros((layout.size, layout.size))
        columns, self.own = [], np.zeros(layout.size)
        for index, block in enumerate(layout.blocks):
            m = definition_of_m(graph, observers_of(layout, index), block.agent, relay)
            self.m[block.columns, block.columns] = np.kron(m, np.eye(block.components))
            sums = np.linalg.inv(m).sum(axis=1)
            sharp = system.design.design_rule == "sharp"
            gain = 1.0 / sums.max() if sharp else np.linalg.eigvalsh(m)[0] / np.sqrt(block.observers)
            self.own[block.columns] = np.repeat(sums * gain, block.components)
            columns += block.observers * [(f.initial, f.final, f.rate, gain) for f in given_bounds[block.agent]]
        self.initial, self.final, self.rate, self.gain = np.array(columns).reshape(-1, 4).T

    def check(self, t: float, error: np.ndarray, difference: np.ndarray) -> None:
        """|x_tilde| < M^-1 rho <= delta(t), |xi| < rho(t) by the design rule, and xi = M x_tilde."""
        delta = (self.initial - self.final) * np.exp(-self.rate * t) + self.final
        assert np.all(self.own <= 1.0 + 1e-12)
        own = self.own * delta
        assert np.all(np.abs(error) < own), f"t = {t}: {np.max(np.abs(error) / own)}"
        assert np.all(np.abs(difference) < self.gain * delta), (
            f"t = {t}: {np.max(np.abs(difference) / self.gain / delta)}"
        )
        np.testing.assert_allclose(difference, error @ self.m.T, rtol=0, atol=1e-9)


def run(system: System, integrator: str, law: object | None) -> Simulator:
    """Run and check every bound at every step; without a law, inputs within their limits jump every step."""
    simulator = system.simulator(Proximal() if integrator == "proximal" else Explicit(), law=law)
    design, rng = system.design, np.random.default_rng(system.seed)
    if integrator == "proximal":
        dt, steps = 0.05, 40
    else:
        bounds = [funnels.explicit_step_bound() for funnels in (design.states, design.inputs)]
        dt = min(2e-3, np.concatenate(bounds).min(initial=1.0) / 10.0)
        steps = min(round(0.5 / dt), 800)
    states = Bounds(system, design.states.layout, system.deltas)
    inputs = Bounds(system, design.inputs.layout, system.thetas)
    for step in range(steps):
        if step:
            u = None if law else design.fleet.input_limit * rng.uniform(-1.0, 1.0, design.fleet.m)
            simulator.step(dt, u)
        t = float(simulator.t[0])
        states.check(t, simulator.errors()[0], simulator.disagreements()[0])
        inputs.check(t, simulator.input_errors()[0], simulator.input_disagreements()[0])
    return simulator


def draw_system(data: st.DataObject, integrator: str, **options: object) -> System:
    """Graphs directed or not; wide funnels for the explicit step, which would need 1e-5 s in narrow ones."""
    directed = data.draw(st.booleans())
    return data.draw(
        systems(
            directed=directed,
            **options,
            **({} if integrator == "proximal" else {"floor": 3.0, "margin": 2.0, "largest": 6}),
        )
    )


@BOTH
@settings(max_examples=25)
@given(data=st.data(), gain=st.floats(0.1, 3.0))
def test_theorem_1_state_observers_with_input_observers(integrator, data, gain):
    """Theorem 1: |g_tilde| bounded (by Theorem 3), |xi(0)| < rho(0) and the design rule give |x_tilde| < delta for all
    t.

    The closed loop of Section VI on mixed fleets: the law acts on the estimates.
    """
    system = draw_system(data, integrator, models=OBSERVABLE_INPUT, drift=True, input_observer=True)
    simulator = run(system, integrator, TanhConsensus(gain))
    assert simulator.extremes.input_relative[0] < 1.0


@BOTH
@settings(max_examples=25)
@given(data=st.data())
def test_theorem_2_state_observers_without_drift(integrator, data):
    """Theorem 2: f_i may be left out where g_i keeps the motion in a bounded set, as the consensus law does here."""
    system = draw_system(data, integrator, models=OBSERVABLE_INPUT, drift=False, input_observer=True)
    simulator = run(system, integrator, TanhConsensus(1.0))
    assert np.all(np.abs(simulator.x) < 50.0)


@BOTH
@settings(max_examples=25)
@given(data=st.data())
def test_theorem_3_input_observers_under_lipschitz_inputs(integrator, data):
    """Theorem 3: |g_tilde| < theta where g_i has a bounded derivative, whatever the bound; here sines up to 8 rad/s."""
    system = draw_system(data, integrator, models=OBSERVABLE_INPUT, input_observer=True)
    run(system, integrator, SmoothSignals(system.design.fleet, system.seed))


@BOTH
@settings(max_examples=25)
@given(data=st.data())
def test_remark_no_input_observer_where_g_is_bounded(integrator, data):
    """Remark on omitting the PPIO: under Assumption 2-i, g_i(x_i, u_i) is one more bounded disturbance; inputs may
    jump.

    Unicycles, whose g depends on the state, included.
    """
    system = draw_system(data, integrator, models=PLANAR, drift=True, input_observer=False)
    assert run(system, integrator, None).input_estimates.size == 0


@BOTH
@settings(max_examples=25)
@given(data=st.data())
def test_both_simplifications_together(integrator, data):
    """Theorem 2 and the remark at once: x_hat' = -P^-1 J eps needs no model of the target at all."""
    system = draw_system(data, integrator, models=PLANAR, drift=False, input_observer=False)
    simulator = run(system, integrator, None)
    assert np.all(np.abs(simulator.x) < 50.0)


@BOTH
@settings(max_examples=25)
@given(data=st.data(), gain=st.floats(0.1, 3.0))
def test_without_relay(integrator, data, gain):
    """Remark after Lemma 1: without Assumption 4 the theorems hold with 1-hop neighbours estimated and H = diag(1, ..,
    0).
    """
    system = draw_system(data, integrator, models=PLANAR, relay=False)
    run(system, integrator, TanhConsensus(gain))


@pytest.mark.parametrize("which", ["drift", "input_observer"])
def test_what_a_simplification_leaves_out_is_left_out(which):
    """Theorem 2 and the remark: without disagreement an estimate moves with f_i and g_hat where its observer knows
    them.
    """
    fleet, one = Fleet([DriftingIntegrator()] * 3), Exponential(100.0, 100.0, 1.0)
    options = [TargetObservers(**{which: known}) for known in (True, True, False)]
    design = ObserverDesign(fleet, nx.path_graph(3), 2, one, one, targets=options)
    simulator = Simulator(design, InitialSet(np.full(6, 0.7), np.zeros(6)), observers=Explicit())
    state = simulator.save()
    state.memory["input_estimate"][...] = 0.25
    simulator.restore(state)
    simulator.step(1e-6, np.full(6, 0.25))
    rates = (simulator.estimates - 0.7)[0].reshape(2, 2) / 1e-6
    f = np.array([np.tanh(0.7), 0.0])
    np.testing.assert_allclose(rates[0], f + 0.25, atol=1e-6)
    np.testing.assert_allclose(rates[1], 0.25 if which == "drift" else f, atol=1e-6)
