"""An observation's content is what its layout says: recomputed from the simulator and the graph, field by field."""

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from khop_env import consensus_v0
from khop_env.tasks import EdgeTask
from tests.env.playing import EVERY, batched, built, parallel, play
from tests.strategies import definition_of_m

every = pytest.mark.parametrize(("environment", "name"), EVERY)
uniform_or_ragged = pytest.mark.parametrize("uniform", [True, False])
AXES = "xyz"


def expected_state(model, states, prefix):
    """A model's states other than its position by field name; angles as cosine and sine."""
    position = set(model.position_index.tolist())
    values = {}
    for c, (state, unit) in enumerate(model.states.items()):
        if c in position:
            continue
        if unit == "rad":
            values[f"{prefix}.{state}.cos"], values[f"{prefix}.{state}.sin"] = np.cos(states[c]), np.sin(states[c])
        else:
            values[f"{prefix}.{state}"] = states[c]
    return values


def expected_own(env, i):
    """Expected values of agent i's own fields."""
    fleet, settings_ = env.batched.fleet, env.batched.settings
    model, states = fleet.models[i], env.batched.simulator.x[0, fleet.state_slice(i)]
    names = list(model.states)
    values = {f"own.{names[c]}": states[c] for c in model.position_index.tolist()}
    values |= expected_state(model, states, "own")
    if settings_.actuator.__class__.__name__ != "Direct":
        inputs = env.get_state().inputs[fleet.input_slice(i), 0]
        values |= {f"own.input.{name}": value for name, value in zip(model.inputs, inputs, strict=True)}
    if settings_.uniform:
        values |= {f"own.type.{one.type}": float(one.type == model.type) for one in fleet.models}
    return values


def order_of_slots(env, i):
    """Everybody within k hops: task edges first, then the nearest, then by number."""
    design, task = env.batched.simulator.design, env.batched.task
    hops = nx.single_source_shortest_path_length(design.communication, i)
    wanted = {j for one, j in task.edges.tolist() if one == i}
    known = [j for j in hops if j != i and hops[j] <= design.k]
    return sorted(known, key=lambda j: (j not in wanted, hops[j], j)), hops, wanted


def known_state(env, i, j, hops):
    """The state of agent j that agent i should observe in this mode; None for zeros."""
    simulator, fleet, mode = env.batched.simulator, env.batched.fleet, env.batched.settings.observe
    truth = simulator.x[0, fleet.state_slice(j)]
    if hops[j] == 1 or mode == "oracle":
        return truth
    if mode == "local":
        return None
    first = simulator.design.states.layout.slot[i, j]
    return simulator.estimates[0, first : first + len(truth)]


def expected_of_task(env, i):
    """What navigation adds: the goal, and the agents' size."""
    task, fleet = env.batched.task, env.batched.fleet
    if isinstance(task, EdgeTask):
        return {}
    gap = task.memory["goal"][i, :, 0] - env.batched.simulator.x[0, fleet.position_index[i]]
    goal = {f"goal.{axis}": gap[c] for c, axis in enumerate(AXES[: fleet.position_dim])}
    return {**goal, "radius": task.arena.radius}


def own_bounds(env, i, j):
    """[M_j^-1 rho_j]_i, the bounds on the errors of agent i's estimate of j, one per state, from the definitions."""
    simulator, model = env.batched.simulator, env.batched.fleet.models[j]
    design, layout = simulator.design, simulator.design.states.layout
    members = list(design.neighborhoods[j])
    m = definition_of_m(design.communication, members, j, design.relay)
    share = np.linalg.eigvalsh(m)[0] / np.sqrt(len(m)) * np.linalg.inv(m).sum(axis=1)[members.index(i)]
    rows = [int(np.flatnonzero(layout.row_source == env.batched.fleet.state_offset[j] + c)[0]) for c in range(model.n)]
    return [share * float(design.states.bounds[row](simulator.t)[0]) for row in rows]


def expected_slot(env, i, number, j, hops, wanted):
    """Expected values of the slot of agent j."""
    fleet, task, name = env.batched.fleet, env.batched.task, f"slot{number}"
    known = known_state(env, i, j, hops)
    if known is None:
        return {}
    model = fleet.models[j]
    own = env.batched.simulator.x[0, fleet.position_index[i]]
    displacement = np.zeros(fleet.position_dim)
    if j in wanted:
        displacement = task.displacement[(task.edges == [i, j]).all(axis=1)][0]
    values = {
        f"{name}.valid": 1.0,
        f"{name}.heard": float(hops[j] == 1),
        f"{name}.hops": hops[j],
        f"{name}.task_edge": float(j in wanted),
    }
    types = dict.fromkeys(one.type for one in fleet.models)
    if env.batched.settings.uniform and len(types) > 1:
        values |= {f"{name}.type.{kind}": float(kind == model.type) for kind in types}
    for c, axis in enumerate(AXES[: fleet.position_dim]):
        if isinstance(task, EdgeTask):
            values[f"{name}.displacement.{axis}"] = displacement[c]
        values[f"{name}.position.{axis}"] = known[model.position_index[c]] - own[c]
    values |= expected_state(model, known, name)
    if env.batched.settings.bounds:
        bounds = np.zeros(model.n) if hops[j] == 1 else own_bounds(env, i, j)
        values |= {f"{name}.bound.{state}": bound for state, bound in zip(model.states, bounds, strict=True)}
    return values


@pytest.mark.parametrize("observe", ["estimate", "oracle", "local"])
@uniform_or_ragged
@every
def test_every_field_holds_what_its_name_says(environment, name, observe, uniform):
    """Of every agent, at reset and in mid episode; whatever isn't named is padding, and zero."""
    arguments = {"observe": observe, "uniform": uniform, "bounds": True, "limit": 1e6}
    env = parallel(environment, name, actuator="lag" if uniform else "direct", **arguments)
    env.reset(seed=3)
    for cycles in (0, 3):
        play(env, cycles)
        for agent in env.possible_agents:
            i, layout = env.batched.fleet.agent(agent), env.layout(agent)
            seen = layout.read(env.observe(agent))
            order, hops, wanted = order_of_slots(env, i)
            assert [slot.agent for slot in layout.slots] == order
            expected = expected_own(env, i) | expected_of_task(env, i)
            for number, j in enumerate(order):
                expected |= expected_slot(env, i, number, j, hops, wanted)
                slot = layout.slots[number]
                assert (slot.id, slot.hops) == (env.batched.fleet.ids[j], hops[j])
                assert (slot.heard, slot.task_edge) == (hops[j] == 1, j in wanted)
            for field, value in expected.items():
                assert seen[field] == pytest.approx(value, rel=1e-6, abs=1e-6), (agent, field)
            assert not any(seen[field] for field in set(seen) - set(expected))
            if not uniform and observe != "local":
                assert set(seen) == set(expected)


@every
def test_invalid_slots_are_all_zero(environment, name):
    """The list of slots is padded to the longest, and a padded slot has nothing in any column."""
    env = parallel(environment, name, bounds=True)
    env.reset(seed=1)
    longest = max(len(env.layout(agent).slots) for agent in env.possible_agents)
    for agent in env.possible_agents:
        layout, observation = env.layout(agent), env.observe(agent)
        for number in range(longest):
            columns = layout.columns(f"slot{number}")
            if number < len(layout.slots):
                assert observation[layout.index(f"slot{number}.valid")] == 1.0
            else:
                assert not observation[columns].any()
        assert f"slot{longest}.valid" not in layout.names


@every
def test_estimates_are_as_near_as_the_bound_fields_say(environment, name):
    """|estimate - truth| <= bound in every slot and component along a run, compared by name between two modes."""
    env, oracle = (parallel(environment, name, bounds=True, observe=one) for one in ("estimate", "oracle"))
    env.reset(seed=6)
    oracle.reset(seed=6)
    checked = 0
    for seed in range(12):
        for agent in env.possible_agents:
            layout = env.layout(agent)
            guess, truth = layout.read(env.observe(agent)), layout.read(oracle.observe(agent))
            for number, slot in enumerate(layout.slots):
                model = env.batched.fleet.models[slot.agent]
                position = model.position_index.tolist()
                for c, (state, unit) in enumerate(model.states.items()):
                    field = f"position.{AXES[position.index(c)]}" if c in position else state
                    bound = guess[f"slot{number}.bound.{state}"]
                    if unit == "rad":
                        field += ".sin"  # |sin a - sin b| <= |a - b|
                    error = abs(guess[f"slot{number}.{field}"] - truth[f"slot{number}.{field}"])
                    assert error <= bound + 1e-6
                    assert (bound > 0.0) == (slot.hops > 1)
                    checked += slot.hops > 1
        play(env, 1, seed)
        play(oracle, 1, seed)
    assert checked > 100


@uniform_or_ragged
@every
def test_names_are_unique_and_bounds_are_the_box(environment, name, uniform):
    env = parallel(environment, name, uniform=uniform, bounds=True, actuator="slew")
    for agent in env.possible_agents:
        layout, space = env.layout(agent), env.observation_space(agent)
        assert len(set(layout.names)) == len(layout.names) == len(layout) == space.shape[0]
        np.testing.assert_array_equal(space.low, [field.low for field in layout.fields])
        np.testing.assert_array_equal(space.high, [field.high for field in layout.fields])
        assert [layout.index(one) for one in layout.names] == list(range(len(layout)))
        assert all(layout.columns(one).tolist() == [layout.index(one)] for one in layout.names)
    state = env.batched.state_fields
    assert len({field.name for field in state}) == len(state) == env.state_space.shape[0]


LAYOUTS = [
    parallel_layout
    for uniform in (True, False)
    for env in [batched("formation_v0", "mixed_fleet", uniform=uniform, bounds=True)]
    for parallel_layout in (env.layouts[0], env.layouts[7])
]


@settings(max_examples=50)
@given(data=st.data(), layout=st.sampled_from(LAYOUTS), shape=st.sampled_from([(), (3,), (2, 2)]))
def test_reading_and_building_are_inverse(data, layout, shape):
    """Any vectors in the space come back bit for bit, whatever axes come before the last."""
    seed = data.draw(st.integers(0, 2**32 - 1))
    fraction = np.random.default_rng(seed).uniform(0.0, 1.0, (*shape, len(layout)))
    observation = (layout.low + fraction * (layout.high - layout.low)).astype(np.float32)
    values = layout.read(observation)
    assert list(values) == list(layout.names)
    assert all(one.shape == shape for one in values.values())
    assert shape or isinstance(values["slot0.valid"], np.float32)  # a number, not an array without axes
    built_again = layout.build(values)
    assert built_again.dtype == np.float32
    np.testing.assert_array_equal(built_again, observation)
    shuffled = data.draw(st.permutations(list(values.items())))
    np.testing.assert_array_equal(layout.build(dict(shuffled)), observation)


def test_building_broadcasts():
    """One number for a field stands for all vectors."""
    layout = LAYOUTS[0]
    values = dict.fromkeys(layout.names, 0.0) | {"own.x": [1.0, 2.0, 3.0]}
    vectors = layout.build(values)
    assert vectors.shape == (3, len(layout))
    np.testing.assert_array_equal(vectors[:, layout.index("own.x")], [1.0, 2.0, 3.0])
    assert np.abs(vectors).sum() == 6.0


def test_mistakes_name_the_nearest_field():
    layout = LAYOUTS[0]
    with pytest.raises(
        KeyError, match=r"'integrator_0' has no field 'slot0.positon.x'; did you mean 'slot0.position.x'"
    ):
        layout.index("slot0.positon.x")
    with pytest.raises(KeyError, match=r"has no field 'slot0.positon'; did you mean 'slot0.position'"):
        layout.columns("slot0.positon")
    with pytest.raises(KeyError, match="has no field 'slot99'"):
        layout.columns("slot99")
    with pytest.raises(KeyError, match=r"has no field 'own.xx'; did you mean 'own\.x"):
        layout.build({"own.xx": 0.0})
    with pytest.raises(KeyError, match=rf"need {len(layout) - 1} more fields, e.g. 'own.y'"):
        layout.build({"own.x": 0.0})
    with pytest.raises(ValueError, match=rf"have {len(layout)} columns; got shape \(3,\)"):
        layout.read(np.zeros(3))


def test_columns_are_whole_words():
    """slot1 isn't slot10, and a prefix gives all below it, in order."""
    layout = LAYOUTS[0]
    names = np.array(layout.names)
    assert all(one.startswith("slot1.") for one in names[layout.columns("slot1")])
    assert any(one.startswith("slot10.") for one in names)
    assert names[layout.columns("slot0.position")].tolist() == ["slot0.position.x", "slot0.position.y"]
    np.testing.assert_array_equal(layout.columns("slot1"), np.arange(*(layout.index(f"slot{q}.valid") for q in (1, 2))))


@every
def test_the_global_state_is_the_truth_of_everybody(environment, name):
    """By its fields' names, leaders included, and every agent's input where an actuator keeps it."""
    env = parallel(environment, name, actuator="lag", limit=1e6)
    env.reset(seed=2)
    play(env, 3)
    fleet, state = env.batched.fleet, env.state()
    assert state.dtype == np.float32
    expected = {}
    for i, agent in enumerate(fleet.ids):
        states, model = env.batched.simulator.x[0, fleet.state_slice(i)], fleet.models[i]
        names = list(model.states)
        expected |= {f"{agent}.{names[c]}": states[c] for c in model.position_index.tolist()}
        expected |= expected_state(model, states, agent)
    for (agent, name_, _), value in zip(fleet.input_names(), env.get_state().inputs[:, 0], strict=True):
        expected[f"{agent}.input.{name_}"] = value
    got = dict(zip([field.name for field in env.batched.state_fields], state.tolist(), strict=True))
    assert got == pytest.approx(expected, rel=1e-6, abs=1e-6)


def test_units_are_the_models_own():
    """Positions in m, angles as numbers without a unit, speeds in m/s."""
    layout = parallel("consensus_v0", "mixed_fleet", uniform=False).layout("unicycle_0")
    units = {field.name: field.unit for field in layout.fields}
    model = built("mixed_fleet").models[6]
    for state, unit in model.states.items():
        shown = {one: u for one, u in units.items() if one == f"own.{state}" or one.startswith(f"own.{state}.")}
        assert shown == ({f"own.{state}.cos": "", f"own.{state}.sin": ""} if unit == "rad" else {f"own.{state}": unit})
    assert units["slot0.displacement.x"] == units["slot0.position.y"] == "m"


@pytest.mark.parametrize("limit", [0.25, 0.9, 1.0, 3.0])
def test_a_component_keeps_its_own_bounds_in_a_column_that_agents_of_several_types_share(limit):
    """With a limit below 1 an angle's cosine may be larger than a speed; one Box has to hold both."""
    padded = parallel("consensus_v0", "mixed_fleet", uniform=True, bounds=True, limit=limit)
    ragged = parallel("consensus_v0", "mixed_fleet", uniform=False, bounds=True, limit=limit)
    seen, counts = set(), []
    for seed in range(3):
        observations, infos = padded.reset(seed=seed)
        expected, infos_expected = ragged.reset(seed=seed)
        for _ in range(3):
            for i, agent in enumerate(padded.agents):
                found = padded.layout(agent).read(observations[agent])
                exact = ragged.layout(agent).read(expected[agent])
                assert {name: found[name] for name in exact} == exact
                for name, value in expected_own(ragged, i).items():
                    most = 1.0 if name.endswith((".cos", ".sin")) else limit
                    assert found[name] == np.float32(np.clip(value, -np.float32(most), np.float32(most)))
                    seen |= {name.rpartition(".")[2]} if abs(value) > most else set()
                assert infos[agent]["clipped_observations"] == infos_expected[agent]["clipped_observations"]
                counts.append(infos[agent]["clipped_observations"])
                assert padded.observation_space(agent).contains(observations[agent])
            actions = {agent: np.full(padded.action_space(agent).shape, 0.5, np.float32) for agent in padded.agents}
            sizes = {agent: ragged.action_space(agent).shape[0] for agent in ragged.agents}
            observations, _, _, _, infos = padded.step(actions)
            expected, _, _, _, infos_expected = ragged.step({a: u[: sizes[a]] for a, u in actions.items()})
    assert max(counts) > 0
    if limit == 0.25:
        assert {"surge", "vx"} & seen  # clipped, where other types have a cosine in the same column


def test_agents_with_equal_columns_share_them_in_memory():
    env = consensus_v0.batched_env("random_geometric:agents=60")
    layouts = {}
    for layout in env.layouts:
        layouts.setdefault(layout.names, []).append(layout)
    assert len(layouts) < len(env.layouts) / 3
    for alike in layouts.values():
        for other in alike:
            assert other.fields is alike[0].fields
            assert other.names is alike[0].names
            assert other.low is alike[0].low
    assert [layout.agent for layout in env.layouts] == list(env.agents)
    with pytest.raises(ValueError, match="read-only"):
        env.layouts[0].low[0] = 1.0


@pytest.mark.parametrize("network", [None, "wifi"])
def test_hundreds_of_agents(network):
    env = consensus_v0.parallel_env("random_geometric:agents=300", network=network)
    before, _ = env.reset(seed=0)
    for _ in range(3):
        after, rewards, _, _, infos = env.step({agent: np.zeros(2, np.float32) for agent in env.agents})
    assert len(rewards) == 300
    assert all(env.observation_space(agent).contains(values) for agent, values in after.items())
    assert infos["integrator_0"]["max_error_to_bound"] <= 1.0
    valid = [env.layout(agent).index("slot0.valid") for agent in env.agents]
    assert all(after[agent][column] == 1.0 for agent, column in zip(env.agents, valid, strict=True))
    assert all((before[agent] != after[agent]).any() for agent in env.agents)
