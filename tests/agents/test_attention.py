"""Attention policies: order and number of slots don't matter, from the features to the fleet they play."""

import dataclasses
import json

import numpy as np
import pytest
import torch
from gymnasium.spaces import Box
from hypothesis import given, settings
from hypothesis import strategies as st
from stable_baselines3 import PPO

from agents import describe, play
from agents.learning import LearnedPolicy, PolicyFileError, TrainingConfig
from agents.learning.archive import read_arrays, write_arrays
from agents.learning.attention import SlotAttention
from agents.learning.forward import Attention
from agents.learning.slots import SlotScaler
from agents.learning.training import _Run, train
from agents.policy import by_agent
from khop_env import make_sb3_vec
from tests.agents.training import SMALL, resumed_as_uninterrupted
from tests.env.playing import batched

TINY = dataclasses.replace(
    SMALL, policy="attention", num_envs=4, timesteps=1500, evaluations=1, arguments={"max_cycles": 30}
)
FLEET = dataclasses.replace(TINY, environment="formation_v0", scenario="random_geometric:agents=8")
SAC = {"algorithm": "sac", "batch_size": 64, "timesteps": 300}
ROUNDING = 3e-6  # of outputs of magnitude 1: sums in another order


@pytest.fixture(scope="module")
def fleet(tmp_path_factory):
    folder = tmp_path_factory.mktemp("fleet")
    train(FLEET, folder)
    return folder


def random_network(rng, own=5, slot=10, width=8, heads=2, outputs=2):
    def layer(inputs, size):
        shapes = (size, inputs), (size,)
        return tuple((rng.normal(size=shape) / np.sqrt(inputs)).astype(np.float32) for shape in shapes)

    scores = rng.normal(size=(heads, width)).astype(np.float32)
    return Attention(layer(own + slot, width), scores, (layer(own + width, 16), layer(16, outputs)))


def random_features(rng, rows, slots, own=5, slot=10):
    """Features (rows, ...), of which some slots aren't valid."""
    each = rng.normal(size=(rows, slots, slot)).astype(np.float32)
    each[..., 0] = rng.random((rows, slots)) < 0.7
    return rng.normal(size=(rows, own)).astype(np.float32), each


def joined(own, slots):
    return np.concatenate([own, slots.reshape(len(own), -1)], axis=1)


def outputs(network, own, slots):
    return network(joined(own, slots), None)[0]


@given(seed=st.integers(0, 2**32 - 1), slots=st.integers(1, 20), padding=st.integers(0, 20))
@settings(max_examples=100, deadline=None)
def test_order_and_number_of_slots_do_not_matter(seed, slots, padding):
    """Permuted, and with invalid slots among them, to float32's rounding."""
    rng = np.random.default_rng(seed)
    network, (own, each) = random_network(rng), random_features(rng, 4, slots)
    expected = outputs(network, own, each)
    more = np.concatenate([each, rng.normal(size=(4, padding, 10)).astype(np.float32)], axis=1)
    more[:, slots:, 0] = 0.0
    permuted = more[:, rng.permutation(slots + padding)]
    np.testing.assert_allclose(outputs(network, own, permuted), expected, rtol=0, atol=ROUNDING)


@pytest.mark.parametrize("content", [1e30, np.nan, np.inf])
def test_what_an_invalid_slot_holds_has_no_influence(content):
    """Bit for bit, in NumPy and in torch, and without any valid slot as well."""
    rng = np.random.default_rng(0)
    network, (own, each) = random_network(rng), random_features(rng, 50, 4)
    each[:10, :, 0] = 0.0
    spoilt = each.copy()
    spoilt[..., 1:][each[..., 0] == 0.0] = content
    torch.manual_seed(0)  # with other weights a row's units may all be inactive
    extractor = SlotAttention(Box(-1.0, 1.0, (45,)), 5, 10, width=8, heads=2)
    for found in (
        lambda slots: outputs(network, own, slots),
        lambda slots: extractor(torch.as_tensor(joined(own, slots))).detach().numpy(),
    ):
        assert np.isfinite(found(each)).all()
        assert np.array_equal(found(each), found(spoilt))
        moved = np.any(found(each) != found(each + np.float32([0.0] + [0.5] * 9)), axis=1)
        assert np.array_equal(moved, each[..., 0].any(axis=1))
    assert np.all(extractor(torch.as_tensor(joined(own, each))).detach().numpy()[:10, 5:] == 0.0)


@pytest.mark.parametrize("environment", ["consensus_v0", "leader_following_v0"])
def test_features_are_those_of_each_slot(environment):
    """Equal to those that another policy gets, in another order; for agents of several types scaled alike."""
    from agents.learning import ObservationScaler

    env = batched(environment, "mixed_fleet", num_envs=2, bounds=True)
    before, _ = env.reset(0)
    after, *_ = env.step(np.ones((2, len(env.agents), max(describe(env).action_sizes.values()))))
    scaler, plain = SlotScaler.of(describe(env), rates=True), ObservationScaler.of(describe(env), rates=True)
    found, expected = scaler(after, before), plain(after, before)
    layout = max(env.layouts, key=lambda layout: len(layout.slots))
    names = [*layout.names, *(f"rate of {layout.names[column]}" for column in plain.moving)]
    width = len(scaler.slot)
    for number in range(len(layout.slots)):
        own = [q for q, name in enumerate(names) if f"slot{number}." in name]
        ours = found[..., len(scaler.own) + number * width :][..., :width]
        scale = np.concatenate([scaler.one.scale, np.ones(len(plain.moving))])[scaler.slot]
        theirs = np.concatenate([plain.scale, np.ones(len(plain.moving))])[own]
        np.testing.assert_allclose(ours, expected[..., own] * (scale / theirs), rtol=1e-6, atol=0)
    assert found.shape[-1] == len(scaler.own) + sum(name.endswith(".valid") for name in layout.names) * width


@pytest.mark.parametrize("changes", [{}, SAC, {"residual": "formation"}], ids=["ppo", "sac", "residual"])
def test_the_saved_policy_acts_like_the_model(changes, tmp_path):
    """NumPy's forward pass against torch; actor and critic share nothing."""
    torch.set_num_threads(1)  # as `train` does
    run = _Run(dataclasses.replace(FLEET, **changes), None, None, None)
    run.learn()
    policy = run.algorithm.policy
    run._exported().save(tmp_path / "policy.npz")
    loaded = LearnedPolicy.load(tmp_path / "policy.npz")
    env = run.batched
    observations, _ = env.reset(0)
    rows = observations.reshape(-1, observations.shape[-1])
    features = loaded.scaler(rows, None)
    means, _ = loaded.networks[""](features, None)
    expected = policy.predict(features, deterministic=True)[0]
    if "algorithm" in changes:
        means = np.tanh(means)
        extractors = policy.actor.features_extractor, policy.critic.features_extractor
    else:
        means = np.clip(means, run.env.action_space.low, run.env.action_space.high)
        extractors = policy.pi_features_extractor, policy.vf_features_extractor
    assert np.abs(means).max() > 0.01
    np.testing.assert_allclose(means, expected, rtol=0, atol=1e-6)
    kinds = [{id(each) for each in extractor.parameters()} for extractor in extractors]
    assert all(isinstance(each, SlotAttention) for each in extractors)
    assert not kinds[0] & kinds[1]
    optimised = {id(each) for group in policy.optimizer.param_groups for each in group["params"]} if not changes else ()
    assert not optimised or kinds[0] | kinds[1] <= optimised


@pytest.mark.parametrize("agents", [8, 16, 64])
def test_it_plays_fleets_of_other_sizes(fleet, agents):
    """Whole episodes; and what an agent of the fleet of the training would do, with all further slots empty."""
    policy = LearnedPolicy.load(fleet)
    trained, env = (batched("formation_v0", f"random_geometric:agents={count}", num_envs=2) for count in (8, agents))
    assert np.isfinite(play(env, policy, [0, 1]).returns).all()
    observations, _ = trained.reset(0)
    actions = []
    for fleet_of in (trained, env):
        policy.reset(describe(fleet_of), [0, 1])
        wider = np.zeros((*observations.shape[:2], len(fleet_of.layouts[0])), np.float32)
        wider[..., : observations.shape[-1]] = observations
        actions.append(np.stack(list(policy.act(by_agent(trained, wider)).values())))
    np.testing.assert_allclose(*actions, rtol=0, atol=ROUNDING)
    assert agents == 8 or len(env.layouts[0]) > len(trained.layouts[0])


@pytest.mark.parametrize(
    ("environment", "scenario", "arguments", "said"),
    [
        ("consensus_v0", "random_geometric:agents=8", {}, "trained for formation_v0, not for consensus_v0"),
        ("formation_v0", "paper", {}, "column 0 is 'own.x' there and 'own.x1' here"),
        ("formation_v0", None, {"bounds": True}, "with 11 observation columns; this environment has 13"),
        ("formation_v0", None, {"control_period": 0.2}, "control period of 0.05 s; this environment has 0.2 s"),
        ("formation_v0", None, {"network": "wifi"}, "'slot0.age' here; .*without a network"),
    ],
)
def test_what_does_not_fit_is_refused(fleet, environment, scenario, arguments, said):
    env = batched(environment, scenario or FLEET.scenario, num_envs=1, **arguments)
    with pytest.raises(PolicyFileError, match=said):
        LearnedPolicy.load(fleet).reset(describe(env), [0])


@pytest.mark.parametrize("changes", [{}, {"residual": "formation"}], ids=["alone", "residual"])
def test_resumed_it_goes_on_as_if_nothing_had_happened(changes, tmp_path):
    chosen = dataclasses.replace(FLEET, **changes, timesteps=3000, evaluations=2)
    resumed_as_uninterrupted(chosen, tmp_path)
    with pytest.raises(ValueError, match="policy = 'attention' there and 'mlp' here"):
        train(dataclasses.replace(chosen, policy="mlp"), tmp_path / "cut", resume=True)


def test_it_begins_with_networks_of_another_fleet_size(fleet, tmp_path):
    """From a folder with its critic, from a file without; not with those of another kind."""
    last = LearnedPolicy.load(fleet / "last.npz").networks[""].arrays()
    larger = dataclasses.replace(FLEET, scenario="random_geometric:agents=12", seed=3)
    for source in (fleet, fleet / "last.npz"):
        begun = _Run(dataclasses.replace(larger, initial=str(source)), None, None, None)
        found = begun.policy.networks[""].arrays()
        assert all(np.array_equal(last[name], found[name]) for name in last)
    with pytest.raises(ValueError, match="trained with policy = 'attention', and this run has policy = 'mlp'"):
        _Run(dataclasses.replace(FLEET, policy="mlp", initial=str(fleet)), None, None, None)


def test_it_trains_in_a_safety_filter():
    """Without the bounds that only the filter reads."""
    config = TrainingConfig.suited(
        "navigation_v0",
        policy="attention",
        shield="certified",
        num_envs=4,
        timesteps=600,
        hidden=(8,),
        evaluations=1,
        arguments={"max_cycles": 10, "network": "lossy:loss=0.3"},
    )
    assert not config.nearest
    policy = train(config).policy
    assert not any("bound" in name for name in policy.columns)


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"per_type": True}, "policy 'attention' doesn't go with per_type"),
        ({"nearest": True}, "policy 'attention' doesn't go with nearest"),
        ({"policy": "transformer"}, "policy must be one of mlp, attention, recurrent; got 'transformer'"),
    ],
)
def test_settings_that_do_not_fit(changes, said):
    with pytest.raises(ValueError, match=said):
        dataclasses.replace(TINY, **changes)


def test_users_train_with_it_on_plain_observations():
    env = make_sb3_vec("consensus_v0", num_envs=2)
    arguments = SlotAttention.widths(env.batched.layouts[0])
    assert arguments == {"own": 3, "slot": 8}
    extractor = {"features_extractor_class": SlotAttention, "features_extractor_kwargs": {**arguments, "width": 16}}
    model = PPO("MlpPolicy", env, n_steps=4, batch_size=32, policy_kwargs=extractor, device="cpu").learn(64)
    assert model.policy.features_extractor.features_dim == 19
    with pytest.raises(ValueError, match="have 59 columns, which aren't 4 and slots of 8 columns"):
        SlotAttention(env.observation_space, 4, 8)
    with pytest.raises(ValueError, match="width must be a multiple of heads; got 10 and 4"):
        SlotAttention(env.observation_space, **arguments, width=10)


def damages():
    def meta(**changes):
        def damage(arrays):
            arrays["meta"] = np.array(json.dumps({**json.loads(str(arrays["meta"])), **changes}))

        return damage

    def array(name, change):
        def damage(arrays):
            arrays[name] = change(arrays[name])

        return damage

    return [
        (meta(network="mlp"), "/0/weight has shape"),
        (meta(columns=["a", "b", "c", "d", "e", "f", "g", "h", "i", "j", "k"]), "slots are misplaced"),
        (array("/scores", lambda found: found[0]), "/scores has shape"),
        (array("/scores", lambda found: found[:0]), "/scores has shape"),
        (array("/scores", lambda found: found[:3]), "/scores has shape"),
        (array("/scores", lambda found: found * np.float32(np.nan)), "/scores isn't finite"),
        (array("/scores", lambda found: found.astype(float)), "/scores has dtype float64"),
        (array("/encoder/weight", lambda found: found[:, 1:]), "/encoder/weight has shape"),
        (array("/encoder/bias", lambda found: found[1:]), "/encoder/bias has shape"),
        (array("/0/weight", lambda found: found[:, 1:]), r"it has \[5, 4\] own features"),
        (array("/0/weight", lambda found: found[0]), "/0/weight has shape"),
        (array("valid", lambda found: found * 0 + 11), "slots are misplaced"),
        (lambda arrays: arrays.pop("/scores"), "it has no '/scores'"),
    ]


@pytest.mark.parametrize(("damage", "said"), damages(), ids=range(len(damages())))
def test_damaged_files_are_refused(fleet, tmp_path, damage, said):
    arrays = read_arrays(fleet / "last.npz", 2**24)
    damage(arrays)
    write_arrays(tmp_path / "damaged.npz", arrays, compress=True)
    with pytest.raises(PolicyFileError, match=rf"damaged.npz isn't a policy that khop train wrote \(.*{said}"):
        LearnedPolicy.load(tmp_path / "damaged.npz")
