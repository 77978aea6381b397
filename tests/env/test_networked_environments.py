"""Environments over a network: slots say what has arrived, and nothing that hasn't arrived is in them."""

import itertools
from functools import partial

import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from khop_env.network import Network
from khop_env.observers.networked import missed_rounds
from tests.env.playing import (
    batched,
    parallel,
    play,
    require_contract,
    same,
)

CASES = [*itertools.product(("paper", "mixed_fleet"), ("ppso", "relay")), ("convoy", "relay")]
cases = pytest.mark.parametrize(("name", "estimator"), CASES)
BURSTS = "lossy:loss=0.5,burst=4"
DRAWN = "random:loss=0.1..0.7,burst=3..20"
SILENT = Network(loss=1.0)


def known(env):
    """Age, hops, time since arrival, estimate and bound of one environment, by (observer, target), from the memory."""
    simulator = env.batched.simulator
    layout, memory, t = simulator.observers.layout, simulator.state.memory, simulator.t[0]
    bounds = simulator.error_bounds().bound[:, 0]
    found = {}
    for (i, j), first in layout.slot.items():
        pair, part = layout.column_pair[first], slice(first, first + env.batched.fleet.models[j].n)
        stamp, arrived = memory["stamp"][pair, 0], memory["arrived"][pair, 0]
        age, since = (t - each if stamp >= 0.0 else np.inf for each in (stamp, arrived))
        found[i, j] = age, memory["hops"][pair, 0], since, memory["estimate"][part, 0], bounds[part]
    return found


@pytest.mark.parametrize("observe", ["estimate", "oracle", "local"])
@cases
def test_slots_hold_estimates_and_what_they_rest_on(name, estimator, observe):
    """Of neighbours, too: field by field from the observers' memory, at reset and in the middle of an episode."""
    arguments = {"network": BURSTS, "estimator": estimator, "bounds": True, "limit": 1e3, "observe": observe}
    env = parallel("consensus_v0", name, uniform=observe != "local", **arguments)
    env.reset(seed=3)
    seen = set()
    for cycles in (0, 3, 4):
        play(env, cycles, seed=cycles)
        told, x, t = known(env), env.batched.simulator.x[0], env.batched.simulator.t[0]
        for agent in env.possible_agents:
            i, fleet = env.batched.fleet.agent(agent), env.batched.fleet
            layout = env.layout(agent)
            values = layout.read(env.observe(agent))
            for number, slot in enumerate(layout.slots):
                age, hops, since, estimate, bound = told[i, slot.agent]
                model, field = fleet.models[slot.agent], f"slot{number}"
                if observe == "local" and not slot.heard:
                    assert not env.observe(agent)[layout.columns(field)].any()
                    continue
                arrived = np.isfinite(age)
                assert values[f"{field}.valid"] == (arrived or observe == "oracle")
                assert values[f"{field}.heard"] == (arrived and since < 0.04)
                assert values[f"{field}.hops"] == hops
                assert values[f"{field}.age"] == pytest.approx(age if arrived else t, abs=1e-6)
                content = x[fleet.state_slice(slot.agent)] if observe == "oracle" else estimate
                own = x[fleet.position_index[i]]
                for axis, c, mine in zip("xyz", model.position_index, own, strict=False):
                    assert values[f"{field}.position.{axis}"] == pytest.approx(content[c] - mine, rel=1e-6, abs=1e-6)
                for c, state_name in enumerate(model.states):
                    assert values[f"{field}.bound.{state_name}"] == pytest.approx(bound[c], rel=1e-6)
                seen |= {(arrived, since < 0.04, slot.heard, hops > 1)}
    assert {valid for valid, *_ in seen} == {heard for _, heard, *_ in seen} == {True, False}
    assert any(far for *_, far in seen) != (observe == "local")


@settings(max_examples=15)
@given(
    st.sampled_from([0.02, 0.05, 0.07, 0.2]),
    st.sampled_from([None, 0.01, 0.025]),
    st.floats(0.0, 0.8),
    st.sampled_from([0.0, 0.03, 0.12]),
    st.integers(0, 99),
)
def test_heard_means_that_something_newer_has_arrived_since_the_last_observation(period, dt, loss, latency, seed):
    """Whatever period, step and delay: exactly where the stamp of what is known has risen, and ages never exceed t."""
    network = Network(period=period, loss=loss, latency=latency)
    env = parallel("consensus_v0", network=network, estimator="relay", dt=dt)
    env.reset(seed=seed)
    stamps = np.full_like(env.batched.simulator.state.memory["stamp"], -1.0)
    pair = env.batched.simulator.observers.layout
    for _ in range(8):
        newer = env.batched.simulator.state.memory["stamp"] > stamps
        stamps = env.batched.simulator.state.memory["stamp"].copy()
        for agent in env.possible_agents:
            layout, i = env.layout(agent), env.batched.fleet.agent(agent)
            values = layout.read(env.observe(agent))
            for number, slot in enumerate(layout.slots):
                row = pair.column_pair[pair.slot[i, slot.agent]]
                assert values[f"slot{number}.heard"] == newer[row, 0]
                assert values[f"slot{number}.valid"] == (stamps[row, 0] >= 0.0)
                assert 0.0 <= values[f"slot{number}.age"] <= env.batched.simulator.t[0] + 1e-6
        play(env, 1, seed)


def test_without_any_message_slots_hold_the_first_guess():
    """Never valid, never heard, as old as the episode, and with the bound of the initial set, which grows."""
    env = parallel("consensus_v0", network=SILENT, bounds=True)
    env.reset(seed=2)
    widths = []
    for cycles in (0, 2, 2):
        play(env, cycles)
        for agent in env.possible_agents:
            values = env.layout(agent).read(env.observe(agent))
            for number in range(len(env.layout(agent).slots)):
                flags = [values[f"slot{number}.{name}"] for name in ("valid", "heard", "hops")]
                assert flags == [0.0, 0.0, 0.0]
                assert values[f"slot{number}.age"] == pytest.approx(env.batched.simulator.t[0])
                assert values[f"slot{number}.position.x"] == pytest.approx(-values["own.x1"], abs=1e-6)
        widths.append(values["slot0.bound.x1"])
    assert 0.0 < widths[0] < widths[1] < widths[2]


def test_ages_and_bounds_that_are_too_large_are_clipped_and_counted():
    """A bound of inf, of a model that declares nothing, is the largest of its field; nothing is clipped there."""
    env = parallel("consensus_v0", network=SILENT, bounds=True, limit=0.2)
    env.reset(seed=2)
    play(env, 6)
    values = env.layout("drifter_0").read(env.observe("drifter_0"))
    assert values["slot0.age"] == np.float32(0.2)
    layout = env.layout("drifter_0")
    high, counted = layout.high[layout.columns("slot0.bound")], []
    for bound in (0.0, np.inf, 1e6):
        env.batched.simulator.state.memory["bound"][...] = bound
        observations, counts = env.batched._observe()
        shown = observations[0, 0, layout.columns("slot0.bound")]
        np.testing.assert_array_equal(shown, high if bound else np.zeros(2))
        counted.append(int(counts[0, 0]))
    assert counted[0] >= len(layout.slots)
    assert counted == [counted[0], counted[0], counted[0] + 2 * len(layout.slots)]


def test_exchange_without_a_network_has_no_ages():
    """And its columns are those that it always had."""
    ideal, networked = (parallel("consensus_v0", "mixed_fleet", bounds=True, network=net) for net in (None, "wifi"))
    for agent in ideal.possible_agents:
        names, more = ideal.layout(agent).names, networked.layout(agent).names
        ages = [f"slot{number}.age" for number in range(len(ideal.layout(agent).slots))]
        assert [name for name in names if "padding" not in name] == [
            name for name in more if name not in ages and "padding" not in name
        ]
        assert [name for name in more if name.endswith("age")] == ages


@pytest.mark.parametrize(
    ("environment", "name", "arguments", "checks"),
    [
        ("consensus_v0", "paper", {"network": DRAWN, "bounds": True}, ()),
        ("leader_following_v0", "convoy", {"network": "lossy:noise=0.01", "observe": "local", "bounds": True}, ()),
        (
            "formation_v0",
            "mixed_fleet",
            {"network": "lossy", "estimator": "relay", "actuator": "lag"},
            ("pickle", "restore", "views", "leak"),
        ),
    ],
)
def test_the_public_checks_pass(environment, name, arguments, checks):
    """PettingZoo's, Gymnasium's and SB3's, views, copies, saved states, leaks."""
    require_contract(partial(parallel, environment, name, max_cycles=8, **arguments), *checks, steps=10)


def drawn(env):
    """The networks of an environment's episodes."""
    return env.simulator.observers.drawn(env.simulator.state)


def limits_and_missed(env):
    """The information limit of each estimate, and rounds missed on each link."""
    observers, state = env.simulator.observers, env.simulator.state
    return observers.limits(state, np.empty((observers.layout.size, env.num_envs))), missed_rounds(observers, state)


def test_partial_resets_start_a_new_network():
    """The environments that go on keep every bit; those that begin anew have those of their own seed."""
    env = batched("consensus_v0", num_envs=3, network=DRAWN, bounds=True)
    twin = batched("consensus_v0", num_envs=3, network=DRAWN, bounds=True)
    assert same(env.reset(seed=5), twin.reset(seed=5))
    rng = np.random.default_rng(0)
    for _ in range(5):
        actions = rng.uniform(-1.0, 1.0, (3, 8, 2))
        assert same(env.step(actions), twin.step(actions))
    observations, _ = env.reset(seed=[40], env_ids=[1])
    alone = batched("consensus_v0", network=DRAWN, bounds=True)
    np.testing.assert_array_equal(observations[1], alone.reset(seed=40)[0][0])
    for _ in range(5):
        actions = rng.uniform(-1.0, 1.0, (3, 8, 2))
        found, expected = env.step(actions)[0], twin.step(actions)[0]
        np.testing.assert_array_equal(found[[0, 2]], expected[[0, 2]])
        np.testing.assert_array_equal(found[1], alone.step(actions[1:2])[0][0])
        assert not np.array_equal(found[1], expected[1])
    (first, other, last), before = drawn(env), drawn(twin)
    assert (first, last) == (before[0], before[2])
    assert [other] == drawn(alone) != [before[1]]
    assert len({each.latency for each in (*before, other)}) == 4  # every episode has its own


@pytest.mark.parametrize("estimator", ["ppso", "relay"])
def test_an_episode_over_ranges_is_that_over_the_network_it_drew(estimator):
    """Observations and bounds to the last bit; the next episode of the same generator draws another network."""
    env = batched("consensus_v0", num_envs=2, network=DRAWN, estimator=estimator, bounds=True)
    observations, _ = env.reset(seed=[5, 6])
    fixed = [batched("consensus_v0", network=each, estimator=estimator, bounds=True) for each in drawn(env)]
    for number, each in enumerate(fixed):
        assert same(each.reset(seed=[5 + number])[0][0], observations[number])
    rng = np.random.default_rng(0)
    for _ in range(20):
        actions = rng.uniform(-1.0, 1.0, (2, 8, 2))
        observations = env.step(actions)[0]
        for number, each in enumerate(fixed):
            assert same(each.step(actions[number][None])[0][0], observations[number])
    limits, missed = limits_and_missed(env)
    for number, each in enumerate(fixed):
        for values, expected in zip((limits, missed), limits_and_missed(each), strict=True):
            np.testing.assert_array_equal(values[:, number], expected[:, 0])
    before = drawn(env)
    env.reset(env_ids=[1])
    assert drawn(env)[0] == before[0]
    assert drawn(env)[1] != before[1]


@pytest.mark.parametrize("estimator", ["ppso", "relay"])
def test_the_same_bits_alone_or_in_a_batch(estimator):
    """All of the observers' memory, of many environments at once, in other bursts of losses each."""
    env = batched("consensus_v0", num_envs=37, network=DRAWN, estimator=estimator)
    alone = [batched("consensus_v0", network=DRAWN, estimator=estimator) for _ in range(0, 37, 6)]
    env.reset(seed=3)
    for number, each in enumerate(alone):
        each.reset(seed=3 + 6 * number)
    rng = np.random.default_rng(0)
    for _ in range(8):
        actions = rng.uniform(-1.0, 1.0, (37, 8, 2))
        env.step(actions)
        for number, each in enumerate(alone):
            each.step(actions[6 * number][None])
            for name, values in each.simulator.state.arrays().items():
                ours = env.simulator.state.arrays()[name]
                ours = ours[6 * number][None] if name == "drawn" else ours[..., 6 * number][..., None]
                assert same(np.ascontiguousarray(ours), np.ascontiguousarray(values)), name


def test_errors_stay_within_certified_bounds():
    """Also for full inputs of alternating sign: "max_error_to_bound" is over the certified bound."""
    for (name, estimator), network in itertools.product(CASES, (BURSTS, DRAWN)):
        env = batched("consensus_v0", name, num_envs=4, network=network, estimator=estimator)
        env.reset(seed=1)
        largest = 0.0
        for number in range(20):
            sign = np.where(np.arange(len(env.agents)) % 2 == number // 5 % 2, 1.0, -1.0)
            shape = 4, len(env.agents), int(env.action_offset[1])
            infos = env.step(np.broadcast_to(sign[None, :, None], shape))[-1]
            largest = max(largest, float(infos["max_error_to_bound"].max()))
        assert 0.0 < largest <= 1.0 + 1e-9
