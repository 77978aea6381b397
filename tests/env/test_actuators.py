"""Actuators between action and input: each one's equation, through env.step."""

import itertools
import math
from dataclasses import dataclass

import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from khop_env.env import ACTUATORS, Direct, Hold, Lag, SlewLimit
from tests.env.playing import ENVIRONMENTS, parallel, play, random_actions

PERIOD, SUBSTEPS = 0.06, 3


def made(actuator, name="mixed_fleet", **arguments):
    arguments = {"control_period": PERIOD, "dt": PERIOD / SUBSTEPS, **arguments}
    return parallel("consensus_v0", name, actuator=actuator, **arguments)


def recorded(env):
    """The inputs that the simulator is stepped with, as fractions of the limits, one (m,) per substep."""
    simulator, seen = env.batched.simulator, []
    advance = simulator.step_unchecked

    def spied(dt, parts, u):
        assert dt == pytest.approx(PERIOD / SUBSTEPS)
        held = u.T.copy()
        seen.append(held[0] / env.batched.fleet.input_limit)
        advance(dt, parts, u)
        np.testing.assert_array_equal(simulator.u, held)

    simulator.step_unchecked = spied
    return seen


def commands(env, actions):
    """Actions as one (m,) vector, clipped."""
    fleet, whole = env.batched.fleet, np.zeros(env.batched.fleet.m)
    for agent, action in actions.items():
        part = fleet.input_slice(fleet.agent(agent))
        whole[part] = np.clip(action[: part.stop - part.start].astype(float), -1.0, 1.0)
    return whole


def run(env, cycles=6):
    """(commands, inputs) per substep of random actions."""
    env.reset(seed=0)
    seen, asked = recorded(env), []
    rng = np.random.default_rng(1)
    for _ in range(cycles):
        actions = random_actions(env, rng, 1.5)
        env.step(actions)
        asked += [commands(env, actions)] * SUBSTEPS
    return np.array(asked), np.array(seen)


def test_direct_inputs_are_the_commands():
    asked, inputs = run(made("direct"))
    np.testing.assert_allclose(inputs, asked, atol=1e-15)


def test_a_lag_is_exact_at_every_substep():
    """u(t + s) = c + (u(t) - c) exp(-s / T), from u = 0, whatever the step."""
    tau = 0.17
    asked, inputs = run(made(Lag(tau)))
    u = np.zeros(asked.shape[1])
    for command, got in zip(asked, inputs, strict=True):
        u = command + (u - command) * math.exp(-PERIOD / SUBSTEPS / tau)
        np.testing.assert_allclose(got, u, atol=1e-12)


def test_a_slew_limit_is_never_exceeded_and_used_up():
    """|u(t + s) - u(t)| <= rate * s; the command is reached where that lets it be, otherwise the rate is."""
    rate = 5.0
    asked, inputs = run(made(SlewLimit(rate)))
    before = np.vstack([np.zeros_like(inputs[:1]), inputs[:-1]])
    change, most = np.abs(inputs - before), rate * PERIOD / SUBSTEPS
    assert change.max() <= most * (1.0 + 1e-12)
    short = ~np.isclose(inputs, asked, atol=1e-12)
    assert short.any()
    assert not short.all()
    np.testing.assert_allclose(change[short], most)
    assert np.all(np.sign(inputs - before)[short] == np.sign(asked - before)[short])


def test_a_hold_is_a_line_that_ends_at_the_command():
    asked, inputs = run(made("hold"))
    ends = np.vstack([np.zeros_like(asked[:1]), asked[::SUBSTEPS]])
    for cycle, (first, last) in enumerate(itertools.pairwise(ends)):
        for number in range(SUBSTEPS):
            expected = first + (last - first) * (number + 1) / SUBSTEPS
            np.testing.assert_allclose(inputs[cycle * SUBSTEPS + number], expected, atol=1e-12)


@pytest.mark.parametrize("environment", ENVIRONMENTS)
@pytest.mark.parametrize("actuator", ["lag", "slew", "hold"])
def test_the_input_in_force_is_in_the_observation(environment, actuator):
    """own.input.<name> is the fraction of the limit that the simulator was stepped with last; zero at reset."""
    env = parallel(environment, "mixed_fleet", actuator=actuator, control_period=PERIOD, dt=PERIOD / SUBSTEPS)
    fleet = env.batched.fleet
    for cycles in (0, 1, 2):
        env.reset(seed=cycles)
        play(env, cycles)
        applied = env.batched.simulator.u[0] / fleet.input_limit
        assert applied.any() == (cycles > 0)
        for agent in env.possible_agents:
            seen = env.layout(agent).read(env.observe(agent))
            i = fleet.agent(agent)
            shown = [seen[f"own.input.{name}"] for name in fleet.models[i].inputs]
            np.testing.assert_allclose(shown, applied[fleet.input_slice(i)], rtol=1e-6)


def test_without_an_actuator_of_its_own_no_input_is_shown():
    env = made("direct")
    assert not any("input" in name for agent in env.possible_agents for name in env.layout(agent).names)


def test_inputs_start_at_zero_in_every_episode():
    """The lag of one episode isn't carried into the next."""
    env = made("lag", max_cycles=2)
    first = run(env, 2)[1]
    assert np.abs(first).max() > 0.1
    env.reset()
    assert not env.get_state().inputs.any()
    assert all(
        env.layout(agent).read(env.observe(agent))["own.input.vx"] == 0.0
        for agent in env.possible_agents
        if agent.startswith("integrator")
    )


def test_clipped_action_entries_are_counted_per_agent():
    """Of the entries that are inputs; an entry at its bound isn't clipped."""
    env = made("direct")
    _, infos = env.reset(seed=0)
    assert all(info["clipped_actions"] == 0 for info in infos.values())
    actions = {agent: np.zeros(3, np.float32) for agent in env.possible_agents}
    actions["vessel_0"] = np.array([1.5, -1.0, -2.0], np.float32)
    actions["cart_2"] = np.array([1.0, 1.0 + 1e-6, 9.0], np.float32)  # a cart has two inputs
    _, _, _, _, infos = env.step(actions)
    counted = {agent: info["clipped_actions"] for agent, info in infos.items() if info["clipped_actions"]}
    assert counted == {"vessel_0": 2, "cart_2": 1}
    _, infos = env.reset()
    assert all(info["clipped_actions"] == 0 for info in infos.values())


UNIT = st.floats(-1.0, 1.0)


@given(command=UNIT, u=UNIT, dt=st.floats(1e-4, 10.0), step=st.integers(0, 4), parameter=st.floats(1e-3, 1e3))
def test_inputs_stay_between_where_they_are_and_the_command(command, u, dt, step, parameter):
    """So they never leave [-1, 1], which the library's own actuators promise."""
    for actuator in (Direct(), Lag(parameter), SlewLimit(parameter), Hold()):
        after = actuator(np.array([[command]]), np.array([[u]]), dt, step, 5)[0, 0]
        assert min(command, u) - 1e-12 <= after <= max(command, u) + 1e-12


def test_an_actuator_of_the_users_own():
    """Anything callable will do, and its parameters are its own."""

    @dataclass(frozen=True)
    class Half:
        share: float = 0.5

        def __call__(self, command, u, dt, step, steps):
            return self.share * command

    asked, inputs = run(made(Half(0.25)))
    np.testing.assert_allclose(inputs, 0.25 * asked, atol=1e-15)


@pytest.mark.parametrize("make", [Lag, SlewLimit])
@pytest.mark.parametrize("value", [0.0, -1.0, math.inf, math.nan])
def test_parameters_must_be_positive(make, value):
    with pytest.raises(ValueError, match=rf"{make.__name__}\.\w+ must be positive and finite; got"):
        make(value)


def test_actuators_by_name_have_their_default_parameters():
    assert {name: made(name).batched.settings.actuator for name in ACTUATORS} == {
        "direct": Direct(),
        "lag": Lag(0.1),
        "slew": SlewLimit(10.0),
        "hold": Hold(),
    }
