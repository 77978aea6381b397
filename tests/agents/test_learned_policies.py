"""Learned policies: their features, actions equal to those of the trained model, and refusals."""

import dataclasses
import json

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from agents import describe, make_policy, play
from agents.learning import (
    PRETRAINED,
    LearnedPolicy,
    ObservationScaler,
    PolicyFileError,
    shipped,
)
from agents.learning.environment import training_environment
from agents.learning.networks import make_model
from agents.learning.slots import SlotScaler
from agents.policy import by_agent
from khop_env.cli import app
from khop_env.env import ObservationLayout
from tests.agents.training import SMALL
from tests.env.playing import batched, same


def test_the_last_observation_is_scaled_like_the_others():
    env = training_environment(dataclasses.replace(SMALL, num_envs=4))
    env.reset()
    inner = env.venv.venv
    scaler = ObservationScaler.of(describe(inner.batched), rates=True)
    assert np.unique(inner.batched.get_state().cycles).size == 4  # staggered
    for _ in range(60):
        _, _, dones, infos = env.step(np.zeros((env.num_envs, env.action_space.shape[0]), np.float32))
        if dones.any():
            break
    row = int(np.flatnonzero(dones)[0])
    assert np.abs(infos[row]["terminal_observation"]).max() <= 10.0
    assert infos[row]["terminal_observation"].shape == (scaler.size,)


def test_the_nearest_of_the_others_comes_first():
    """Whatever slot it is in; its features of the step before go with it, and unknown ones come last."""
    env = batched("navigation_v0", "crossing", num_envs=3)
    before, _ = env.reset(0)
    observations, *_ = env.step(np.full((3, 8, 2), 0.5))
    layout = env.layouts[0]
    slots = np.array([layout.columns(f"slot{q}") for q in range(len(layout.slots))])
    nearest, plain = (ObservationScaler.of(describe(env), rates=True, nearest=each) for each in (True, False))
    features = nearest(observations, before)
    order = np.random.default_rng(0).permutation(len(slots))
    shuffled, shuffled_before = observations.copy(), before.copy()
    shuffled[..., slots.ravel()] = observations[..., slots[order].ravel()]
    shuffled_before[..., slots.ravel()] = before[..., slots[order].ravel()]
    np.testing.assert_array_equal(nearest(shuffled, shuffled_before), features)
    known = features[..., slots[:, 0]] > 0.0  # the first column of a slot says whether it is
    places = np.array([layout.columns(f"slot{q}.position") for q in range(len(slots))])
    distance = np.where(known, np.linalg.norm(features[..., places], axis=-1), 1e9)
    assert (np.diff(distance, axis=-1) >= 0.0).all()
    assert known.any()
    assert not known.all()
    unsorted = plain(observations, before)
    np.testing.assert_array_equal(np.sort(features, axis=-1), np.sort(unsorted, axis=-1))
    assert not np.array_equal(features, unsorted)


def test_agents_with_a_heading_see_others_in_their_own_frame():
    """Rotated into the own frame of agents with a heading; unchanged for integrators and carts."""
    env = batched("formation_v0", "mixed_fleet", num_envs=3)
    observations, _ = env.reset(0)
    features = ObservationScaler.of(describe(env), rates=True)(observations, observations)
    for number, layout in enumerate(env.layouts):
        seen, found = observations[:, number], features[:, number]
        cos, sin = 1.0, 0.0
        if "own.heading.cos" in layout.names:
            cos, sin = seen[:, layout.index("own.heading.cos")], seen[:, layout.index("own.heading.sin")]
        for what in ("position", "displacement"):
            columns = layout.columns(f"slot0.{what}")
            x, y = 0.5 * seen[:, columns].T
            np.testing.assert_allclose(found[:, columns[0]], cos * x + sin * y, atol=1e-6)
            np.testing.assert_allclose(found[:, columns[1]], cos * y - sin * x, atol=1e-6)
        np.testing.assert_allclose(found[:, :2], 0.5 * seen[:, :2], atol=1e-6)


@pytest.mark.parametrize("path", sorted(PRETRAINED.glob("*.npz")), ids=lambda path: path.stem)
def test_scales_are_found_by_name(path):
    """Features equal those of the shipped policies bit for bit, and don't depend on the order of columns."""
    policy = LearnedPolicy.load(path)
    over = {name: policy.about.get("arguments", {}).get(name) for name in ("network", "estimator")}
    env = batched(policy.environment, policy.about["scenario"], num_envs=2, **over)
    description = describe(env)
    if isinstance(policy.scaler, SlotScaler):  # the order is tested in test_attention.py
        assert same(SlotScaler.of(description, policy.about["rates"]).one, policy.scaler.one)
        return
    chosen = {"rates": policy.about["rates"], "nearest": policy.about.get("nearest", False)}
    scaler = ObservationScaler.of(description, **chosen)
    assert same(scaler, policy.scaler)
    order = np.random.default_rng(0).permutation(len(scaler.scale))
    mixed = {
        agent: ObservationLayout(agent, [layout.fields[q] for q in order], layout.slots)
        for agent, layout in description.layouts.items()
    }
    other = ObservationScaler.of(dataclasses.replace(description, layouts=mixed), **chosen)
    before, _ = env.reset(0)
    after, *_ = env.step(np.ones((2, len(env.agents), policy.action_size)))
    found, expected = other(after[..., order], before[..., order]), scaler(after, before)
    count, places = len(order), [scaler.moving.tolist().index(order[column]) for column in other.moving]
    np.testing.assert_array_equal(found[..., :count], expected[..., order])
    np.testing.assert_array_equal(found[..., count:], expected[..., count:][..., places])


@pytest.mark.parametrize(
    "changes", [{}, {"per_type": True}, {"algorithm": "sac", "batch_size": 64}], ids=["ppo", "per_type", "sac"]
)
def test_the_saved_policy_acts_like_the_model(changes, tmp_path):
    """NumPy's forward pass against Stable-Baselines3's deterministic prediction, for every agent type."""
    config = dataclasses.replace(SMALL, timesteps=2_000, num_envs=4, evaluations=1, **changes)
    from agents.learning.training import _Run

    run = _Run(config, None, None, None)
    policy = run.learn().policy
    last = run._exported()
    last.save(tmp_path / "policy.npz")
    loaded = LearnedPolicy.load(tmp_path / "policy.npz")
    env = batched("consensus_v0", "mixed_fleet", num_envs=5)
    observations, _ = env.reset(0)
    scaler = ObservationScaler.of(describe(env), rates=True)
    loaded.reset(describe(env), range(5))
    before = None
    for _ in range(3):
        features = scaler(observations.reshape(60, -1), before)
        expected, _ = run.algorithm.predict(features, deterministic=True)
        actions = loaded.act(by_agent(env, observations))
        found = np.stack([actions[agent] for agent in env.agents], axis=1)
        np.testing.assert_allclose(found.reshape(60, -1), np.clip(expected, -1.0, 1.0), atol=2e-5)
        before = observations.reshape(60, -1)
        observations, *_ = env.step(found)
    assert set(policy.networks) == ({"integrator", "cart", "unicycle", "vessel"} if config.per_type else {""})


def test_types_have_networks_of_their_own():
    """With one network per type, the loss of one type's rows leaves the others' parameters alone."""
    config = dataclasses.replace(SMALL, per_type=True, num_envs=4)
    env = training_environment(config)
    layout = env.venv.venv.batched.layouts[0]
    columns = [layout.index(f"own.type.{kind}") for kind in ("integrator", "cart", "unicycle", "vessel")]
    model = make_model(config, env, columns, None)
    observations = torch.as_tensor(env.reset())
    carts = observations[observations[:, columns[1]] > 0.5]
    model.policy.get_distribution(carts).distribution.mean.sum().backward()
    for number, network in enumerate(model.policy.mlp_extractor.actors):
        moved = any(p.grad is not None and bool(p.grad.abs().sum() > 0) for p in network.parameters())
        assert moved is (number == 1)


def test_padded_slots_do_not_matter():
    """The content of an invalid slot changes neither the features nor the action."""
    env = batched("consensus_v0", "mixed_fleet", num_envs=2)
    observations, _ = env.reset(0)
    scaler = ObservationScaler.of(describe(env), rates=True)
    rng, checked = np.random.default_rng(0), 0
    for number, layout in enumerate(env.layouts):
        spoilt = observations[:, number].copy()
        for column, name in enumerate(layout.names):
            slot, _, rest = name.partition(".")
            if slot.startswith("slot") and int(slot[4:]) >= len(layout.slots) and rest != "valid":
                spoilt[:, column] = rng.normal(size=2)
                checked += 1
        own = observations[:, number]
        np.testing.assert_array_equal(scaler(spoilt, own), scaler(own, own))
    assert checked
    heard = observations[:, 0].copy()
    heard[:, env.layouts[0].index("slot0.position.x")] += 1.0
    assert not np.array_equal(scaler(heard, None), scaler(observations[:, 0], None))


def test_features_hold_how_fast_positions_change():
    """Own and others' velocities of drifters, whose state has none; zero in an episode's first observation."""
    config = dataclasses.replace(SMALL, scenario="paper", num_envs=4)
    env = training_environment(config)
    first = env.reset()
    scaler, inner = env.venv.scaler, env.venv.venv
    layout = inner.batched.layouts[0]
    columns = len(layout)
    assert not first[:, columns:].any()
    before = env.venv.before
    positions = inner.batched.simulator.x.copy()
    features, *_ = env.step(np.ones((env.num_envs, 2), np.float32))
    own = (inner.batched.simulator.x - positions).reshape(-1, 2) / 0.05
    np.testing.assert_allclose(features[:, columns : columns + 2], 0.25 * own, atol=1e-4)
    assert np.all(scaler(env.venv.before, before) == features)
    for _ in range(200):
        features, _, dones, infos = env.step(np.zeros((env.num_envs, 2), np.float32))
        if dones.any():
            assert not features[dones, columns:].any()
            assert all(infos[row]["terminal_observation"][columns:].any() for row in np.flatnonzero(dones))
            return
    raise AssertionError("no episode ended")


def test_a_policy_that_does_not_fit_is_refused(trained, tmp_path):
    policy = trained[0].policy
    for environment, scenario, arguments, said in (
        ("formation_v0", "mixed_fleet", {}, "it was trained for consensus_v0, not for formation_v0"),
        (
            "consensus_v0",
            "paper",
            {},
            "with 3 entries per action; this environment has .2.; train a policy for paper",
        ),
        (
            "consensus_v0",
            "mixed_fleet",
            {"bounds": True},
            "trained on mixed_fleet with .* observation columns; this environment",
        ),
        ("consensus_v0", "mixed_fleet", {"uniform": False}, "needs uniform observations"),
        (
            "consensus_v0",
            "mixed_fleet",
            {"control_period": 0.1},
            "with a control period of 0.05 s; this environment has 0.1 s",
        ),
    ):
        with pytest.raises(PolicyFileError, match=said):
            policy.reset(describe(batched(environment, scenario, num_envs=1, **arguments)), [0])
    with pytest.raises(PolicyFileError, match="no policy file"):
        make_policy(f"ppo:{tmp_path / 'nothing'}")
    (tmp_path / "text.npz").write_text("no policy")
    with pytest.raises(PolicyFileError, match="isn't a policy that khop train wrote"):
        make_policy(f"ppo:{tmp_path / 'text.npz'}")
    (tmp_path / "run").mkdir()
    policy.save(tmp_path / "run" / "best.npz")
    with pytest.raises(ValueError, match="was trained by ppo"):
        make_policy(f"sac:{tmp_path / 'run'}")
    with pytest.raises(ValueError, match="expected ppo:FOLDER or ppo:pretrained"):
        make_policy("ppo")


@pytest.mark.parametrize("environment", ["consensus_v0", "formation_v0", "leader_following_v0"])
@pytest.mark.parametrize("scenario", ["paper", "convoy", "mixed_fleet", "random_geometric:agents=12"])
def test_no_policy_breaks_the_guarantee(environment, scenario):
    """Adversaries included, over all time and after the transient."""
    env = batched(environment, scenario, num_envs=8)
    for policy in ("bang_bang", "random"):
        episodes = play(env, make_policy(policy), range(8))
        assert episodes.max_normalized_disagreement.max() < 1.0
        assert episodes.late_normalized_disagreement.max() <= episodes.max_normalized_disagreement.max()
        assert episodes.max_error_to_bound.max() < 1.0


def test_a_learned_policy_is_run_filmed_and_compared(trained, tmp_path):
    """The command line accepts it wherever a scripted policy is accepted, in its training environment."""
    policy, film = f"ppo:{trained[1]}", tmp_path / "film.gif"
    run = ["run", "mixed_fleet", "--controller", policy]
    result = CliRunner().invoke(app, [*run, "--duration", "0.5", "--out", str(tmp_path), "--video", str(film)])
    assert result.exit_code == 0, (result.stderr, result.exception)
    assert "guarantee kept" in result.stdout
    assert "consensus_v0: return " in result.stdout
    assert "task error at the end" in result.stdout
    summary = json.loads((tmp_path / "summary.json").read_text())
    assert (summary["controller"], summary["steps"], summary["dt"]) == (policy, 10, 0.05)
    assert film.read_bytes().startswith(b"GIF8")
    for more, said in (
        (["--dt", "0.01"], "--dt: a policy acts in its environment, which chooses its own steps"),
        (["--integrator", "explicit"], "--integrator: a policy"),
    ):
        refused = CliRunner().invoke(app, [*run, *more])
        assert refused.exit_code == 2
        assert said in refused.stderr
    evaluate = ["evaluate", "consensus_v0", "--episodes", "3"]
    result = CliRunner().invoke(app, [*evaluate, "--scenario", "mixed_fleet", "--policies", f"{policy},zero"])
    assert result.exit_code == 0, (result.stderr, result.exception)
    assert result.stdout.count("ppo:") == 3  # its long name is folded
    refused = CliRunner().invoke(app, [*evaluate, "--policies", policy])
    assert refused.exit_code == 2
    assert "trained on mixed_fleet with 3 entries per action; this environment has [2]" in refused.stderr


def test_the_shipped_policy_for_navigation_arrives_in_the_filter():
    """Without collisions; played outside of it, it collides, and a warning says why."""
    spec = "filter:announce=true:ppo:pretrained"
    env = batched("navigation_v0", "crossing", num_envs=20, bounds=True, message_size=4)
    found = play(env, make_policy(spec), range(5000, 5020)).outcomes
    assert found["collision"].sum() == 0
    assert found["success"].mean() > 0.7
    plain = batched("navigation_v0", "crossing", num_envs=20)
    with pytest.warns(UserWarning, match="trained inside the safety filter is played outside of it"):
        found = play(plain, make_policy("ppo:pretrained"), range(5000, 5020)).outcomes
    assert found["collision"].mean() > 0.5


OTHERS = [policy for policy in shipped().values() if policy.environment != "navigation_v0"]


@pytest.mark.parametrize("policy", OTHERS, ids=lambda policy: policy.name)
def test_shipped_policies_are_good(policy):
    """Far better than zero inputs, and much better on estimates than on neighbours only."""
    found = {}
    for mode in ("estimate", "local"):
        over = {} if policy.network is None else {"network": policy.network}
        env = batched(policy.environment, policy.scenario, num_envs=20, observe=mode, **over)
        found[mode] = play(env, make_policy("ppo:pretrained"), range(20))
        zero = play(env, make_policy("zero"), range(20)).returns.mean()
    assert found["estimate"].returns.mean() > 0.2 * zero  # returns are negative
    assert found["estimate"].returns.mean() > found["local"].returns.mean()
    assert found["estimate"].max_normalized_disagreement.max() < 1.0
