"""Simulators as objects: copies, integrators given twice, numbers that aren't finite, and steps that fail."""

import copy
import pickle

import networkx as nx
import numpy as np
import pytest

from agents import make_law
from khop_env.observers import DesignError, Explicit, Exponential, FunnelError, Proximal, SolveError
from khop_env.physics import SingleIntegrator
from khop_env.scenarios import Scenario, mixed_fleet, paper


def same(one, other):
    return all(np.array_equal(values, other.arrays()[name]) for name, values in one.arrays().items())


@pytest.mark.parametrize("factory", [paper, mixed_fleet])
@pytest.mark.parametrize("duplicate", [copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))])
@pytest.mark.parametrize("integrator", [Proximal(2, threads=2), Explicit()])
def test_a_copy_continues_bit_for_bit_and_on_its_own(factory, duplicate, integrator):
    scenario = factory()
    dt = 1e-6 if isinstance(integrator, Explicit) else 0.01
    simulator = scenario.build(law=make_law(scenario.law), observers=integrator, num_envs=2)
    for _ in range(5):
        simulator.step(dt)
    twin = duplicate(simulator)
    before = twin.save()
    for _ in range(5):
        simulator.step(dt)
    assert same(twin.save(), before)
    for _ in range(5):
        twin.step(dt)
    assert same(twin.save(), simulator.save())


@pytest.mark.parametrize("make", [Proximal, Explicit])
def test_one_integrator_may_be_given_to_several_simulators(make):
    shared, scenario = make(), paper()
    law = make_law(scenario.law)
    dt = 1e-5 if make is Explicit else 0.01
    alone = scenario.build(law=law, observers=make())
    first = scenario.build(law=law, observers=shared)
    mixed_fleet().build(law=make_law("tanh"), observers=shared)
    for _ in range(10):
        alone.step(dt)
        first.step(dt)
    assert same(alone.save(), first.save())


class Failing(SingleIntegrator):
    """NaN from t = 0.05 s on."""

    def drift(self, t, x):
        return np.where(t[..., None] > 0.05, np.nan, 0.0) * np.ones_like(x)


@pytest.mark.parametrize("integrator", [Proximal(1), Proximal(2), Explicit()])
@pytest.mark.parametrize("graph", [nx.star_graph(3), nx.complete_graph(4)])
def test_a_state_that_nobody_estimates_may_not_become_nan_unseen(integrator, graph):
    """Non-finite states are an error; here those of the hub, the neighbour of all others."""
    scenario = Scenario(
        name="hub",
        description="the hub fails",
        models=(Failing(), *[SingleIntegrator()] * 3),
        communication=graph,
        task=graph,
        k=2,
        delta=Exponential(20.0, 1.0, 1.0),
        theta=Exponential(20.0, 1.0, 1.0),
    )
    simulator = scenario.build(law=make_law("tanh"), observers=integrator)
    for dt in (0.01, 0.01, 0.01, 0.01, 0.02):  # the last stage that evaluates the drift is at 0.046 s
        simulator.step(dt)
    before = simulator.save()
    with pytest.raises(SolveError, match=r"state 'x' of 'integrator_0' became nan"):
        simulator.step(0.01)
    assert same(simulator.save(), before)


@pytest.mark.parametrize("make", [Proximal, Explicit])
def test_a_law_that_raises_leaves_the_state_before_the_step(make):
    scenario = paper()
    law, calls = make_law(scenario.law), []

    def failing(t, view):
        calls.append(t)
        if len(calls) == 6:
            raise KeyError("the law's own mistake")
        return law(t, view)

    simulator = scenario.build(law=failing, observers=make())
    while len(calls) < 5:
        simulator.step(1e-5)
    before = simulator.save()
    with pytest.raises(KeyError, match="own mistake"):
        simulator.step(1e-5)
    assert same(simulator.save(), before)


def test_an_input_that_jumps_out_of_an_explicit_observers_funnel_is_said_to_have_jumped():
    """Assumption 2-ii: the input observer wants a bounded derivative; no explicit step helps after a jump."""
    scenario = Scenario(
        name="line",
        description="a line of four",
        models=(SingleIntegrator(input_limit=100.0),) * 4,
        communication=nx.path_graph(4),
        task=nx.path_graph(4),
        k=2,
        delta=Exponential(20.0, 1.0, 1.0),
        theta=Exponential(500.0, 0.5, 5.0),
        radius=0.1,
    )
    simulator = scenario.build(observers=Explicit())
    for _ in range(3000):
        simulator.step(1e-3)
    before = simulator.save()
    with pytest.raises(FunnelError, match=r"input observer of 'integrator_\d' .* jumped.*proximal"):
        simulator.step(1e-4, u=np.full(8, 50.0))
    assert np.array_equal(simulator.save().x, before.x)
    again = scenario.build()
    again.step(1e-4, u=np.full(8, 50.0))
    assert np.all(again.extremes.normalized < 1.0)


def test_a_refused_start_changes_nothing():
    simulator = paper().build()
    before = simulator.save()
    with pytest.raises(DesignError, match="can't start inside"):
        simulator.reset(seed=5, x0=np.full(16, 100.0))
    assert same(simulator.save(), before)


def test_unbounded_inputs_are_checked_where_they_start():
    scenario = paper().replace(models=tuple(type(m)(input_limit=np.inf) for m in paper().models))
    law = make_law(scenario.law)
    scenario.build(law=law).step(0.01)
    with pytest.raises(DesignError, match=r"\|mu\(0\)\| = .* take theta\(0\) above"):
        scenario.replace(theta=Exponential(20.0, 1.0, 5.0)).build(law=law)


def test_a_performance_class_is_not_an_instance():
    with pytest.raises(DesignError, match=r"expected an instance, got the class Exponential"):
        paper().replace(delta=Exponential).design  # noqa: B018
