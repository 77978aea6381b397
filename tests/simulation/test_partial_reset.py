"""Simulator.reset(env_ids=...): the chosen ones begin anew, and the others keep every bit."""

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents import make_law
from khop_env.observers import DesignError, Explicit, Proximal
from khop_env.registry import scenario
from tests.strategies import systems

BATCH = 5
SCENARIOS = ("paper", "convoy", "mixed_fleet", "random_geometric:agents=12")
every = pytest.mark.parametrize("name", SCENARIOS)


def everything(simulator):
    """The state's arrays and the running extremes, environments last."""
    saved, seen = simulator.save(), simulator.extremes
    arrays = saved.arrays()
    arrays["drawn"] = arrays["drawn"].T
    return arrays | seen._asdict()


def require_same(one, other, which, others=None):
    """Bit for bit in the environments `which`, which are numbered `others` in the other one."""
    others = which if others is None else others
    for name, value in one.items():
        np.testing.assert_array_equal(value[..., which], other[name][..., others], err_msg=name)


def running(name, batch=BATCH):
    """Some steps into an episode, with inputs that jump."""
    simulator = scenario(name).build(num_envs=batch).reset(3)
    advance(simulator, 3)
    return simulator


def advance(simulator, steps):
    for number in range(steps):
        simulator.step(0.02, 0.5 * simulator.fleet.input_limit * (-1.0) ** number)


@every
@pytest.mark.parametrize("which", [[0], [4], [1, 3], [3, 1], np.array([0, 2, 4]), [2, 0, 1, 4, 3], []])
def test_others_keep_every_bit_and_the_chosen_begin_as_a_fresh_reset(name, which):
    """At once and over the steps that follow, running extremes included."""
    simulator, untouched = running(name), running(name)
    numbers = np.asarray(which, np.int64)
    rest = np.setdiff1d(np.arange(BATCH), numbers)
    fresh = scenario(name).build(num_envs=max(len(numbers), 1))
    fresh.reset([100 + b for b in numbers.tolist()] or 0)
    simulator.reset(100, env_ids=which)
    for _ in range(2):
        now = everything(simulator)
        require_same(now, everything(untouched), rest)
        require_same(now, everything(fresh), numbers, np.arange(len(numbers)))
        for one in (simulator, untouched, fresh):
            advance(one, 3)
    assert np.all(simulator.t[numbers] < simulator.t[rest].max(initial=1.0))


@every
def test_with_a_law_too(name):
    """The closed loop evaluates the law for all, and moves nothing by that."""
    built = scenario(name)
    law = make_law(built.law)
    simulator, untouched, fresh = (built.build(num_envs=3, law=law).reset(5) for _ in range(3))
    for _ in range(3):
        simulator.step(0.02)
        untouched.step(0.02)
    simulator.reset([6], env_ids=[1])
    fresh.reset(5)  # environment 1 from seed 6
    for _ in range(3):
        now = everything(simulator)
        require_same(now, everything(untouched), [0, 2])
        require_same(now, everything(fresh), [1])
        for one in (simulator, untouched, fresh):
            one.step(0.02)


@pytest.mark.parametrize("integrator", [Explicit, lambda: Proximal(1), lambda: Proximal(2, threads=2)])
def test_with_every_integrator(integrator):
    def build():
        return scenario("paper").build(num_envs=3, observers=integrator()).reset(1)

    simulator, untouched, fresh = build(), build(), build()
    for _ in range(3):
        simulator.step(1e-5, np.zeros(16))
        untouched.step(1e-5, np.zeros(16))
    simulator.reset(1, env_ids=[2])
    require_same(everything(simulator), everything(untouched), [0, 1])
    require_same(everything(simulator), everything(fresh), [2])


@settings(max_examples=25)
@given(system=systems(), batch=st.integers(2, 4), data=st.data())
def test_of_any_system(system, batch, data):
    """Whatever the fleet and its observers: a reset of some is a reset of each alone."""
    which = np.array(data.draw(st.lists(st.integers(0, batch - 1), min_size=1, unique=True)))
    simulator, untouched = (system.simulator(Proximal(2), batch) for _ in range(2))
    u = 0.3 * simulator.fleet.input_limit
    for one in (simulator, untouched):
        one.step(0.01, u)
        one.step(0.01, -u)
    simulator.reset(77, env_ids=which)
    fresh = system.simulator(Proximal(2), batch).reset(77)
    require_same(everything(simulator), everything(untouched), np.setdiff1d(np.arange(batch), which))
    require_same(everything(simulator), everything(fresh), which)


def test_initial_states_and_generators_for_the_chosen():
    """x0 is theirs, one for all or one each; generators go on where they are."""
    simulator = running("paper")
    before, n = everything(simulator), simulator.fleet.n
    x0 = np.linspace(-1.0, 1.0, 2 * n).reshape(2, n)
    simulator.reset(9, x0, env_ids=[4, 1])
    np.testing.assert_array_equal(simulator.x[[4, 1]], x0)
    simulator.reset([np.random.default_rng(9)], x0[0], [3])
    np.testing.assert_array_equal(simulator.x[3], x0[0])
    np.testing.assert_array_equal(simulator.save().drawn[3], scenario("paper").build().reset(9).save().drawn[0])
    require_same(everything(simulator), before, [0, 2])


@pytest.mark.parametrize(
    ("arguments", "error", "message"),
    [
        ({"env_ids": [0, 5]}, ValueError, r"env_ids must be different indices from 0 to 4; got \[0, 5\]"),
        ({"env_ids": [-1]}, ValueError, r"from 0 to 4; got \[-1\]"),
        ({"env_ids": [1, 1]}, ValueError, r"different indices from 0 to 4; got \[1, 1\]"),
        ({"env_ids": [[0, 1]]}, ValueError, r"from 0 to 4; got \[\[0, 1\]\]"),
        ({"env_ids": 2}, ValueError, r"from 0 to 4; got 2"),
        ({"env_ids": [0.5]}, ValueError, r"from 0 to 4; got \[0.5\]"),
        ({"env_ids": np.eye(5, dtype=bool)[1]}, ValueError, r"not a mask: give np.flatnonzero\(mask\)"),
        ({"env_ids": [0, 1], "seed": [1]}, ValueError, "expected one seed or 2, one per environment; got 1"),
        ({"env_ids": [0, 1], "seed": [1, -2]}, ValueError, "non-negative"),
        ({"env_ids": [0, 1], "x0": np.zeros((5, 16))}, ValueError, r"of shape \(16,\) or \(2, 16\)"),
        ({"env_ids": [0, 1], "x0": np.full(16, np.nan)}, ValueError, "x0 must be finite"),
        ({"env_ids": [0, 1], "x0": np.full(16, 1e3)}, DesignError, "can't start inside their funnel"),
    ],
)
def test_mistakes_are_refused_and_change_nothing(arguments, error, message):
    """Neither in the chosen environments nor in the others."""
    simulator = running("paper")
    before = everything(simulator)
    with pytest.raises(error, match=message):
        simulator.reset(**arguments)
    require_same(everything(simulator), before, np.arange(BATCH))


def test_all_environments_by_name_are_all():
    """env_ids=range(B) is what leaving them out is."""
    one, other = running("mixed_fleet", 3).reset(8), running("mixed_fleet", 3).reset(8, env_ids=range(3))
    require_same(everything(one), everything(other), np.arange(3))
