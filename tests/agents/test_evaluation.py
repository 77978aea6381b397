"""Evaluation: measurements are right and paired, and don't depend on the number of workers."""

import gymnasium
import numpy as np
import pytest
import supersuit
from pettingzoo.utils.conversions import aec_to_parallel
from scipy import stats
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

import khop_env
from agents import compare, describe, evaluate, interval95, make_policy, play, sb3_policy
from agents.comparison import CHUNK
from tests.env.playing import aec, batched, joint, parallel


def test_an_episode_measured_by_hand():
    """Every number of an episode, against a loop over the ParallelEnv."""
    env = parallel("formation_v0", "mixed_fleet", max_cycles=40)
    episodes = play(batched("formation_v0", "mixed_fleet", num_envs=4, max_cycles=40), make_policy("linear"), range(7))
    policy = make_policy("linear")
    policy.reset(describe(env), seeds=[5])
    seen, infos = env.reset(seed=5)
    errors, total, effort, worst, bound = [], 0.0, [], [], []
    errors.append(np.mean([info["task_error"] for info in infos.values()]))
    while env.agents:
        actions = policy.act(seen)
        effort.append(np.mean([np.square(actions[agent]).sum() for agent in actions]))
        seen, rewards, _, _, infos = env.step(actions)
        total += np.mean(list(rewards.values()))
        errors.append(np.mean([info["task_error"] for info in infos.values()]))
        worst.append(max(info["max_normalized_disagreement"] for info in infos.values()))
        bound.append(max(info["max_error_to_bound"] for info in infos.values()))
    assert episodes.seed[5] == 5
    np.testing.assert_allclose(episodes.task_error[:, 5], errors, rtol=1e-12)
    np.testing.assert_allclose(episodes.returns[5], total, rtol=1e-12)
    np.testing.assert_allclose(episodes.effort[5], np.mean(effort), rtol=1e-6)
    assert episodes.final_task_error[5] == errors[-1]
    assert episodes.max_normalized_disagreement[5] == max(worst)
    assert episodes.late_normalized_disagreement[5] == max(worst[10:])
    assert episodes.max_error_to_bound[5] == max(bound)
    outside = np.flatnonzero(np.array(errors) > 0.1 * errors[0])
    expected = np.inf if outside[-1] == 40 else 0.05 * (outside[-1] + 1)
    assert episodes.settling_time[5] == pytest.approx(expected)


def test_an_early_end_ends_the_sums():
    """With a success radius environments end at different times; steps after that aren't counted."""
    arguments = {"success_radius": 0.3, "max_cycles": 60}
    together = play(batched("consensus_v0", "paper", num_envs=6, **arguments), make_policy("tanh"), range(6))
    alone = [
        play(batched("consensus_v0", "paper", num_envs=1, **arguments), make_policy("tanh"), [seed])
        for seed in range(6)
    ]
    for seed, episode in enumerate(alone):
        assert together.returns[seed] == episode.returns[0]
        assert together.effort[seed] == episode.effort[0]
        np.testing.assert_array_equal(together.task_error[:, seed], episode.task_error[:, 0])
    assert len(np.unique(together.settling_time)) > 1
    assert np.all(together.task_error[-1] <= 0.3)


def test_frame_is_tidy_and_paired():
    env = batched("leader_following_v0", "convoy", num_envs=5, max_cycles=20)
    frame = evaluate(env, ["tanh", "zero"], range(5))
    assert frame.columns[:6] == ["environment", "scenario", "observe", "policy", "seed", "return"]
    assert frame.shape[0] == 10
    assert frame["scenario"].unique().to_list() == ["convoy"]
    assert frame.filter(frame["policy"] == "zero")["seed"].to_list() == list(range(5))
    again = evaluate(env, {"tanh": make_policy("tanh")}, range(5))
    assert again.equals(frame.filter(frame["policy"] == "tanh"))


def test_the_same_numbers_whoever_plays():
    """One process, two, and other orders: equal bits."""
    arguments = {"scenario": "mixed_fleet", "seeds": range(CHUNK + 3), "arguments": {"max_cycles": 10}}
    single = compare("consensus_v0", ["tanh", "random"], ("estimate", "local"), **arguments)
    two = compare("consensus_v0", ["tanh", "random"], ("estimate", "local"), workers=2, **arguments)
    other = compare("consensus_v0", ["random"], ("local",), **arguments)
    assert single.summary() == two.summary()
    assert single.frame().equals(two.frame())
    np.testing.assert_array_equal(single.rows[3].episodes.task_error, other.rows[0].episodes.task_error)
    assert [row.label for row in single.rows] == [
        f"{p} on {m}" for p in ("tanh", "random") for m in ("estimate", "local")
    ]


def test_episodes_of_all_rows_begin_alike():
    compared = compare("leader_following_v0", ["tanh", "zero"], ("estimate", "oracle"), seeds=range(4))
    starts = [row.episodes.task_error[0] for row in compared.rows]
    assert all(np.array_equal(starts[0], start) for start in starts)
    more, interval = compared.difference(compared.rows[2])
    difference = compared.rows[2].episodes.returns - compared.rows[0].episodes.returns
    assert more == difference.mean()
    assert interval == interval95(difference)


def test_estimates_pay_where_leaders_are_out_of_earshot():
    """Confidence intervals of the return on estimates and on neighbours only don't overlap."""
    rows = compare("leader_following_v0", ["leader_following"], ("estimate", "oracle", "local"), seeds=range(50)).rows
    estimate, oracle, local = (row.summary() for row in rows)
    assert estimate["mean_return"] - estimate["ci95"] > local["mean_return"] + local["ci95"]
    assert estimate["mean_return"] > 1.05 * oracle["mean_return"]
    assert estimate["final_task_error"] < 0.5 * local["final_task_error"]


@pytest.mark.parametrize("count", [2, 3, 4, 5, 10, 100])
def test_interval_is_students(count):
    values = np.random.default_rng(count).normal(size=count)
    low, high = stats.t.interval(0.95, count - 1, values.mean(), stats.sem(values))
    assert interval95(values) == pytest.approx((high - low) / 2, rel=0.01)
    assert interval95(values[:1]) is None


class Stubborn:
    def __init__(self, actions):
        self.actions = actions

    def reset(self, env, seeds):
        pass

    def act(self, observations):
        return self.actions(observations)


@pytest.mark.parametrize(
    ("actions", "said"),
    [
        (lambda seen: {}, "policy 'stubborn' in consensus_v0: no action for 'drifter_0'; got actions for no agent"),
        (
            lambda seen: {agent: np.zeros((2, 3)) for agent in seen},
            r"of 'drifter_0' must have shape \(2, 2\), one row per environment; got \(2, 3\)",
        ),
        (lambda seen: None, r"return actions by agent, {'drifter_0': array of shape \(2, 2\), \.\.\.}; got NoneType"),
        (lambda seen: [np.zeros((2, 2))] * 8, r"return actions by agent, .*; got list"),
        (lambda seen: np.zeros((2, 8, 2)), r"return actions by agent, .*; got an array of shape \(2, 8, 2\)"),
        (lambda seen: dict.fromkeys(seen), "actions of 'drifter_0' aren't numbers: None"),
        (lambda seen: {agent: [[0.0], [0.0, 1.0]] for agent in seen}, "of 'drifter_0' aren't numbers: .*0.0, 1.0"),
        (
            lambda seen: {agent: np.full((2, 2), np.nan) for agent in seen},
            "action of 'drifter_0' in environment 0 isn't finite",
        ),
    ],
)
def test_actions_that_will_not_do(actions, said):
    with pytest.raises(ValueError, match=said):
        evaluate(batched("consensus_v0", num_envs=2), {"stubborn": Stubborn(actions)}, range(2))


def test_lists_of_numbers_are_actions():
    env = batched("consensus_v0", num_envs=2, max_cycles=5)
    listed, zero = (
        evaluate(env, {"zero": policy}, range(2))
        for policy in (Stubborn(lambda seen: {agent: [[0, 0]] * 2 for agent in seen}), make_policy("zero"))
    )
    assert listed.equals(zero)


def test_wrapped_environments_are_unwrapped():
    """Returned by gymnasium.make, env(), and wrappers of PettingZoo, Gymnasium, Stable-Baselines3 and SuperSuit."""
    short, name = {"max_cycles": 5}, "consensus_v0"
    whole = evaluate(parallel(name, **short), ["tanh"], range(3))
    vector, rows = khop_env.make_vec(name, num_envs=2, **short), khop_env.make_sb3_vec(name, num_envs=2, **short)
    for env in (
        joint("khop/Consensus-v0", **short),
        gymnasium.make("khop/Consensus-v0", **short),
        gymnasium.wrappers.FlattenObservation(gymnasium.make("khop/Consensus-v0", **short)),
        aec(name, **short),
        aec_to_parallel(aec(name, **short)),
        supersuit.clip_actions_v0(parallel(name, **short)),
        supersuit.pettingzoo_env_to_vec_env_v1(parallel(name, **short)),
        gymnasium.wrappers.vector.ClipReward(vector, -1.0, 1.0),
        VecNormalize(VecMonitor(rows)),
    ):
        assert evaluate(env, ["tanh"], range(3)).equals(whole), env
        assert describe(env).agents == describe(vector).agents


@pytest.mark.parametrize("normalised", [False, True])
def test_a_model_of_stable_baselines_plays(normalised):
    """Its actions equal those of predict() on the rows that it was trained on."""
    rows = khop_env.make_sb3_vec("formation_v0", num_envs=3, scenario="mixed_fleet", max_cycles=6)
    env = VecNormalize(rows) if normalised else rows
    model = PPO("MlpPolicy", env, n_steps=4, batch_size=36, n_epochs=1, seed=0, device="cpu").learn(200)
    found = play(rows, sb3_policy(model), [3, 4, 5])
    rows.seed(3)
    seen = rows.reset()
    for _ in range(6):
        inputs = env.normalize_obs(seen) if normalised else seen
        actions, _ = model.predict(inputs, deterministic=True)
        seen, _, _, _ = rows.step(actions)
    assert not np.array_equal(found.returns[0], found.returns[1])
    np.testing.assert_array_equal(found.task_error[-1], model.env.unwrapped.infos["task_error"].mean(axis=1))
    with pytest.raises(ValueError, match=r"takes observations of shape \(\d+,\) .* those of 'drifter_0' have"):
        play(batched("consensus_v0", num_envs=1), sb3_policy(model), [0])
    with pytest.raises(TypeError, match=r"policy 'ppo' is of type PPO: agents\.sb3_policy turns a"):
        evaluate(rows, {"ppo": model}, [0])
    with pytest.raises(TypeError, match="expected a Stable-Baselines3 model with predict"):
        sb3_policy(make_policy("tanh"))


def test_mistakes():
    with pytest.raises(TypeError, match=r"policies must be a list of names or a mapping.*; got 'tanh'"):
        evaluate(batched("consensus_v0", num_envs=1), "tanh", [0])
    with pytest.raises(ValueError, match=r"policies must be a list of names, e\.g\. \['tanh'\]"):
        compare("consensus_v0", "tanh")
    with pytest.raises(TypeError, match="policy 'stubborn' is the class Stubborn: pass an instance"):
        evaluate(batched("consensus_v0", num_envs=1), {"stubborn": Stubborn}, [0])
    with pytest.raises(TypeError, match=r"policy 'tanh' is of type str: a policy has reset\(env, seeds\)"):
        evaluate(batched("consensus_v0", num_envs=1), {"tanh": "tanh"}, [0])
    with pytest.raises(ValueError, match=r"policies must be names.* got <agents.* For objects: evaluate\(env"):
        compare("consensus_v0", [make_policy("zero")])
    with pytest.raises(ValueError, match=r"seeds must be one per episode, e\.g\. range\(100\); got 3"):
        compare("consensus_v0", ["zero"], seeds=3)
    with pytest.raises(ValueError, match="no seeds given"):
        compare("consensus_v0", ["tanh"], seeds=[])
    with pytest.raises(ValueError, match="no environment 'consensus'; did you mean 'consensus_v0'"):
        compare("consensus", ["tanh"])
    with pytest.raises(ValueError, match="observe must be one of estimate, oracle, local; got 'orcale'"):
        compare("consensus_v0", ["tanh"], ("orcale",))
    with pytest.raises(ValueError, match=r"no mode twice; got .*observe=\['local', 'local'\]"):
        compare("consensus_v0", ["tanh"], ("local", "local"))
    with pytest.raises(ValueError, match=r"no mode twice; got .*observe=\[\]"):
        compare("consensus_v0", ["tanh"], ())
    with pytest.raises(ValueError, match="no policy 'than'"):
        compare("consensus_v0", ["tanh", "than"])
    with pytest.raises(TypeError, match=r"expected an environment of khop_env, e\.g\. .*; got int"):
        evaluate(3, ["tanh"], [0])
