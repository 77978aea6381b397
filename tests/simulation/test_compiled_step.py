"""The step in one compiled call: the bits of the Python loop, and the loop wherever something of a user's is in it."""

import dataclasses

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents import FormationLaw, LeaderFollowingLaw, LinearConsensus, TanhConsensus, make_law
from khop_env.observers import Exponential, Proximal, SolveError
from khop_env.observers.performance import FunnelBank, Scaled, scaled
from khop_env.physics import VELOCITY_CONTROLLERS, DriftingIntegrator, Sinusoid
from khop_env.physics.disturbance import AttachedDisturbance
from khop_env.scenarios import Scenario, mixed_fleet, paper
from khop_env.simulation import Simulator, compiled_step
from tests.strategies import SmoothSignals, System, systems

LAWS = {
    "held": lambda: None,
    "tanh": lambda: TanhConsensus(1.5),
    "linear": lambda: LinearConsensus(1.5, cancel_drift=True),
    "formation": lambda: FormationLaw(1.5, speed=0.4),
    "formation with drift": lambda: FormationLaw(1.5, speed=0.4, cancel_drift=False),
    "leader following": lambda: LeaderFollowingLaw(1.5, shrink=0.8),
}


class Drifter(DriftingIntegrator):
    """A user's model: equal in all but its class."""

    def drift(self, t, x):
        """That of its base class."""
        return super().drift(t, x)


class Breeze(Sinusoid):
    """A user's disturbance, likewise."""


class Halved(AttachedDisturbance):
    """A disturbance attached to a fleet, likewise."""

    def __call__(self, t, x, drawn, out):
        """Half of what its base class gives."""
        return np.multiply(super().__call__(t, x, drawn, out), 0.5, out=out)


class HalfSinusoid(Sinusoid):
    """A disturbance that is attached in a way of its own."""

    form = Sinusoid.form

    def attach(self, fleet):
        """Halved."""
        return Halved(self.terms, fleet)


@dataclasses.dataclass(frozen=True)
class Wavy(Exponential):
    """A user's funnel, with other values than its base class."""

    def __call__(self, t):
        """Up to 10 % narrower than the exponential."""
        return super().__call__(t) * (0.95 + 0.05 * np.cos(t))

    def infimum(self):
        """A tenth below the exponential's."""
        return 0.9 * super().infimum()


def with_a_drifter(scenario: Scenario) -> Scenario:
    """The scenario with a user's model in the place of agent 3's."""
    models = tuple(Drifter() if i == 3 else model for i, model in enumerate(scenario.models))
    return dataclasses.replace(scenario, models=models)


def in_python(simulator: Simulator) -> Simulator:
    """The same simulator, whose steps are the Python loop."""
    simulator._compiled = None
    return simulator


def assert_same_run(compiled: Simulator, python: Simulator, dt: float, steps: int, jump: float = 0.0) -> None:
    """All arrays and running maxima are equal after each step."""
    compiled.warm_up(long=True)
    python.warm_up()
    compiled.observers.evaluations = python.observers.evaluations
    rng = np.random.default_rng(0)
    for _ in range(steps):
        u = None if compiled.plant.law else jump * rng.uniform(-1.0, 1.0, (compiled.num_envs, compiled.fleet.m))
        for simulator in (compiled, python):
            simulator.step(dt, u)
        for name, values in compiled.state.arrays().items():
            np.testing.assert_array_equal(values, python.state.arrays()[name], err_msg=name)
        for ours, theirs in zip(compiled.extremes, python.extremes, strict=True):
            np.testing.assert_array_equal(ours, theirs)


@pytest.mark.parametrize("law", LAWS)
@settings(max_examples=8)
@given(system=systems(), order=st.sampled_from([1, 2]), batch=st.integers(1, 4))
def test_it_has_the_bits_of_the_python_loop(law, system: System, order, batch):
    """For random fleets, graphs, funnels, disturbances, laws, orders and batches."""
    compiled, python = (system.simulator(Proximal(order), batch, law=LAWS[law]()) for _ in range(2))
    assert_same_run(compiled, in_python(python), 0.03, 6, jump=1.0)
    assert compiled.observers.evaluations == python.observers.evaluations


@pytest.mark.parametrize("threads", [2, 3])
def test_threads_and_blocks_have_the_bits_of_the_python_loop(threads):
    """Of a batch of several blocks, divided in uneven parts."""
    for scenario, batch in ((paper(), 2 * compiled_step.BLOCK + 44), (mixed_fleet(), 135)):
        compiled, python = (
            scenario.build(law=make_law(scenario.law), observers=Proximal(2, threads=count), num_envs=batch)
            for count in (threads, 1)
        )
        assert_same_run(compiled, in_python(python), 0.05, 3)


def test_a_law_whose_parameters_change_is_followed():
    scenario = paper()
    laws = [TanhConsensus(2.0), TanhConsensus(2.0)]
    compiled, python = (scenario.build(law=law) for law in laws)
    assert_same_run(compiled, in_python(python), 0.02, 3)
    for law in laws:
        law.gain = 5.0
    assert_same_run(compiled, python, 0.02, 3)


@pytest.mark.parametrize(
    "owned",
    [
        "model",
        "disturbance",
        "attached disturbance",
        "law",
        "subclass of a law",
        "funnel",
        "subclass of a funnel",
        "controller",
    ],
)
def test_what_is_a_users_goes_through_python(owned, monkeypatch):
    """A subclass of a library's class, whose methods may differ, counts as a user's own."""
    scenario, law = paper(), None
    if owned == "model":
        scenario = with_a_drifter(scenario)
    elif owned == "disturbance":
        scenario = dataclasses.replace(scenario, disturbance=scenario.disturbance + Breeze(0.1))
    elif owned == "attached disturbance":
        scenario = dataclasses.replace(scenario, disturbance=HalfSinusoid(0.1))
    elif owned == "law":
        law = SmoothSignals(scenario.build().fleet, 0)
    elif owned == "subclass of a law":
        law = type("Own", (TanhConsensus,), {})()
    elif owned == "controller":
        law = TanhConsensus()
        monkeypatch.setitem(VELOCITY_CONTROLLERS, "drifter", lambda model, x, velocity: 0.5 * velocity)
    elif owned == "funnel":
        scenario = dataclasses.replace(scenario, delta=Scaled(Exponential(40.0, 1.0, 1.0), 1.0))
    elif owned == "subclass of a funnel":
        scenario = dataclasses.replace(scenario, delta=Wavy(40.0, 1.0, 1.0))
    assert scenario.build(law=law)._compiled is None


def test_a_funnel_of_a_class_derived_from_the_librarys_has_its_own_values():
    bank = FunnelBank([Exponential(4.0, 1.0, 0.5), Wavy(4.0, 1.0, 0.5), scaled(Wavy(4.0, 1.0, 0.5), 2.0)])
    t = np.array([0.0, 1.0, 3.0])
    found = bank.evaluate(t, np.zeros((3, 3)))
    np.testing.assert_allclose(found[1], Wavy(4.0, 1.0, 0.5)(t))
    np.testing.assert_allclose(found[2], 2.0 * found[1])


def test_a_users_model_beside_the_librarys_moves_as_theirs():
    """A fleet with a user's model is stepped in Python: the same right-hand side gives the same bits."""
    scenario = paper()
    own = with_a_drifter(scenario).build()
    library = scenario.build()
    assert own._compiled is None
    for _ in range(5):
        own.step(0.05)
        library.step(0.05)
    np.testing.assert_array_equal(own.x, library.x)


@pytest.mark.parametrize("threads", [1, 2])
def test_a_step_that_fails_says_why_and_changes_nothing(threads):
    scenario = mixed_fleet()
    failing = compiled_step.BLOCK + 20
    simulator = scenario.build(observers=Proximal(2, threads=threads), num_envs=failing + 50)
    simulator.warm_up(long=True)
    simulator.step(0.02)
    column = next(q for q, (_, name, _) in enumerate(simulator.fleet.component_names()) if name == "surge")
    simulator.state.x[column, failing] = 1e200  # whose quadratic drag overflows
    saved, extremes = simulator.save(), simulator.extremes
    with pytest.raises(SolveError, match=rf"environment {failing}: state '\w+' of 'vessel_0' became"):
        simulator.step(0.02)
    for name, values in simulator.state.arrays().items():
        np.testing.assert_array_equal(values, saved.arrays()[name], err_msg=name)
    for ours, theirs in zip(simulator.extremes, extremes, strict=True):
        np.testing.assert_array_equal(ours, theirs)


def test_inputs_that_are_new_have_their_effect_where_a_step_did_not_begin():
    """In the environments behind the one that fails, and where Ctrl-C came before the compiled code."""
    simulator = paper().build(num_envs=compiled_step.BLOCK + 1)
    simulator.warm_up(long=True)
    u = np.ones((simulator.fleet.m, simulator.num_envs))
    simulator.state.x[3, 1] = np.nan
    with pytest.raises(SolveError, match="environment 1:"):
        simulator.step_unchecked(0.02, 1, u)
    np.testing.assert_array_equal(simulator.g, u.T)  # of drifters


def test_it_is_compiled_where_it_has_been_before_or_in_long_runs_only(monkeypatch):
    """A short run doesn't wait for its compilation; the bits are the same before and after."""
    monkeypatch.setattr(compiled_step, "available", lambda *arguments: False)
    monkeypatch.setattr(compiled_step, "PATIENCE", 3)
    late, python = paper().build(), in_python(paper().build())
    chosen = []
    for _ in range(6):
        for simulator in (late, python):
            simulator.step(0.02)
        chosen.append(late._in_one_call)
        np.testing.assert_array_equal(late.estimates, python.estimates)
    assert chosen == [False] * 3 + [True] * 3
    monkeypatch.setattr(compiled_step, "available", lambda *arguments: True)
    early = paper().build()
    early.step(0.02)
    assert early._in_one_call


@pytest.mark.parametrize("parts", [1, 3])
def test_an_interrupt_before_or_between_threads_changes_nothing(parts, monkeypatch):
    """Ctrl-C may come before the compiled code has begun, or after it has ended in some threads only."""
    simulator = paper().build(observers=Proximal(1, threads=2), num_envs=6)
    simulator.warm_up(long=True)
    simulator.step(0.05)
    saved = simulator.save()

    def before_it(function, ranges):
        raise KeyboardInterrupt

    def in_the_middle(function, ranges):
        function(ranges[-1])
        raise KeyboardInterrupt

    for run in (before_it, in_the_middle):
        with monkeypatch.context() as patched:
            patched.setattr(simulator.plant.threads, "run", run)
            with pytest.raises(KeyboardInterrupt):
                simulator.step_unchecked(0.05, parts)
        for name, values in simulator.state.arrays().items():
            np.testing.assert_array_equal(values, saved.arrays()[name], err_msg=name)
    simulator.step(0.05)
    assert simulator.t == pytest.approx(0.1)


@pytest.mark.parametrize("go_on", [lambda each: each.step(0.05), lambda each: each.advance(0.1, tolerance=1e-3)])
def test_an_interrupt_at_the_very_beginning_changes_nothing(go_on, monkeypatch):
    """Before the compiled code is even called: the state isn't that before the last step."""
    simulator = paper().build(law=TanhConsensus(), observers=Proximal(2), num_envs=3)
    simulator.warm_up(long=True)
    simulator.step(0.05)
    saved = simulator.save()

    def interrupted(dt, held):
        raise KeyboardInterrupt

    monkeypatch.setattr(simulator, "_one_step", interrupted)
    with pytest.raises(KeyboardInterrupt):
        go_on(simulator)
    for name, values in simulator.state.arrays().items():
        np.testing.assert_array_equal(values, saved.arrays()[name], err_msg=name)
