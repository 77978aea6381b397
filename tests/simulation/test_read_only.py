"""Nobody but the simulator writes its state: users, laws, models and disturbances get read-only views."""

from dataclasses import dataclass

import networkx as nx
import numpy as np
import pytest

from khop_env.observers import Explicit, Exponential, Proximal
from khop_env.physics import SingleIntegrator, Sinusoid
from khop_env.scenarios import Scenario, paper

READ_ONLY = "read-only"


def scenario(model=None, disturbance=None):
    return Scenario(
        name="line",
        description="a line of four",
        models=(model or SingleIntegrator(),) * 4,
        communication=nx.path_graph(4),
        task=nx.path_graph(4),
        k=2,
        delta=Exponential(20.0, 1.0, 1.0),
        theta=Exponential(50.0, 1.0, 1.0),
        disturbance=disturbance,
    )


def same(one, other):
    return all(np.array_equal(values, other.arrays()[name]) for name, values in one.arrays().items())


@pytest.mark.parametrize("name", ["t", "x", "u", "g", "estimates", "input_estimates"])
@pytest.mark.parametrize("num_envs", [1, 3])
def test_what_a_simulator_shows_cannot_be_written_through(name, num_envs):
    simulator = paper().build(num_envs=num_envs)
    before = simulator.save()
    with pytest.raises(ValueError, match=READ_ONLY):
        getattr(simulator, name)[...] = 1.0
    assert same(simulator.save(), before)
    simulator.step(0.01)  # which writes all the same
    assert not same(simulator.save(), before)


class Culprit:
    """Writes into one of the arrays that it gets, once it is armed; a law, and its own model's or disturbance's."""

    armed = False

    def touch(self, arrays, name):
        if self.armed:
            arrays[name][...] = 1e3


def refused(simulator, culprit):
    """Steps, arms the culprit, and finds its step refused without a trace."""
    simulator.reset(seed=0)
    simulator.step(1e-4)
    before = simulator.save()
    culprit.armed = True
    with pytest.raises(ValueError, match=READ_ONLY):
        simulator.step(1e-4)
    assert same(simulator.save(), before)
    culprit.armed = False
    simulator.step(1e-4)


@pytest.mark.parametrize("name", ["t", "x", "edges", "known", "displacement"])
@pytest.mark.parametrize("observers", [Proximal(1), Proximal(2), Explicit()])
@pytest.mark.parametrize("num_envs", [1, 3])
def test_a_law_cannot_overwrite_the_plant(name, observers, num_envs):
    culprit = Culprit()

    def law(t, view):
        culprit.touch({"t": t, **{each: getattr(view, each) for each in ("x", "edges", "known", "displacement")}}, name)
        return np.zeros((num_envs, 8))

    refused(scenario().build(law=law, observers=observers, num_envs=num_envs), culprit)


@pytest.mark.parametrize("name", ["drift t", "drift x", "input_map t", "input_map x", "input_map u"])
@pytest.mark.parametrize("observers", [Proximal(1), Proximal(2), Explicit()])
@pytest.mark.parametrize("num_envs", [1, 3])
def test_a_model_cannot_overwrite_the_plant_or_the_estimates(name, observers, num_envs):
    culprit, where = Culprit(), name.split()

    class Model(SingleIntegrator):
        def drift(self, t, x):
            if where[0] == "drift":
                culprit.touch({"t": t, "x": x}, where[1])
            return np.zeros_like(x)

        def input_map(self, t, x, u):
            if where[0] == "input_map":
                culprit.touch({"t": t, "x": x, "u": u}, where[1])
            return 1.0 * u

    law = lambda t, view: np.zeros((num_envs, 8))  # noqa: E731
    refused(scenario(Model()).build(law=law, observers=observers, num_envs=num_envs), culprit)


def test_inputs_given_to_step_are_not_the_model_s_to_change():
    """Without a law, too, where the simulator holds what `step` was given."""
    culprit = Culprit()

    class Model(SingleIntegrator):
        def input_map(self, t, x, u):
            culprit.touch({"u": u}, "u")
            return 1.0 * u

    simulator = scenario(Model()).build()
    simulator.step(0.01, u=np.ones(8))
    culprit.armed = True
    with pytest.raises(ValueError, match=READ_ONLY):
        simulator.step(0.01, u=np.ones(8))
    assert np.all(simulator.u == 1.0)


@pytest.mark.parametrize("observers", [Proximal(1), Explicit()])
def test_a_bound_cannot_turn_the_clock(observers):
    culprit = Culprit()

    class Bound:
        def __call__(self, t):
            culprit.touch({"t": t}, "t")
            return np.full_like(t, 20.0)

        def infimum(self):
            return 20.0

    refused(scenario().replace(delta=Bound()).build(observers=observers), culprit)


@pytest.mark.parametrize("name", ["t", "x", "drawn"])
@pytest.mark.parametrize("observers", [Proximal(1), Proximal(2), Explicit()])
@pytest.mark.parametrize("num_envs", [1, 3])
def test_a_disturbance_cannot_overwrite_the_plant_or_its_draws(name, observers, num_envs):
    culprit = Culprit()

    @dataclass(frozen=True)
    class Own(Sinusoid):
        def add(self, t, x, drawn, channels, out):
            culprit.touch({"t": t, "x": x, "drawn": drawn}, name)
            super().add(t, x, drawn, channels, out)

    refused(scenario(disturbance=Own(0.1)).build(observers=observers, num_envs=num_envs), culprit)
