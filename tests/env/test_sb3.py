"""The Stable-Baselines3 vector environment: its rows, the ends of its episodes, and what PPO makes of them."""

import itertools

import numpy as np
import pytest
import torch
from stable_baselines3 import PPO
from stable_baselines3.common.env_util import make_vec_env
from stable_baselines3.common.logger import configure
from stable_baselines3.common.vec_env import VecMonitor, VecNormalize

from khop_env import make_sb3_vec, make_vec
from tests.env.playing import EVERY, built, ends_within, info_keys, same

COPIES = 2


def sb3(environment="consensus_v0", name="paper", **arguments):
    return make_sb3_vec(environment, COPIES, scenario=built(name), **arguments)


def actions_for(env, cycles):
    shape = (cycles, env.num_envs, *env.action_space.shape)
    return np.random.default_rng(0).uniform(-1.0, 1.0, shape).astype(np.float32)


@pytest.mark.parametrize(("environment", "name"), EVERY)
def test_rows_are_those_of_the_gymnasium_environment(environment, name):
    """Observations, rewards and ends bit for bit (rewards as float32), in SB3's conventions."""
    radius = {"consensus_v0": 1.9, "formation_v0": 2.3, "leader_following_v0": 2.0, "navigation_v0": 2.9}[environment]
    arguments = {"max_cycles": 5, **ends_within(environment, radius * (3.0 if name == "mixed_fleet" else 1.0))}
    env, other = (
        sb3(environment, name, **arguments),
        make_vec(environment, COPIES, autoreset_mode="same_step", scenario=built(name), **arguments),
    )
    env.seed(4)
    assert env.reset().tobytes() == other.reset(seed=4)[0].tobytes()
    for actions in actions_for(env, 12):
        rows, rewards, dones, infos = env.step(actions)
        rows_2, rewards_2, terminated, truncated, infos_2 = other.step(actions)
        assert rows.tobytes() == rows_2.tobytes()
        assert same(rewards, rewards_2.astype(np.float32))
        assert same(dones, terminated | truncated)
        for row, info in enumerate(infos):
            if not dones[row]:
                assert info == {}
                continue
            of_the_end = {"terminal_observation", "terminal_state", "TimeLimit.truncated", "episode"}
            assert set(info) == of_the_end | set(info_keys(environment))
            assert info["terminal_observation"].tobytes() == infos_2["final_obs"][row].tobytes()
            assert info["TimeLimit.truncated"] is bool(truncated[row])
            for key in info_keys(environment):
                assert info[key] == infos_2["final_info"][key][row]


def test_the_horizon_is_a_truncation():
    """Every third step all rows are done, and say so; the terminal observation isn't the next episode's first."""
    env = sb3(max_cycles=3)
    env.seed(0)
    env.reset()
    for number, actions in enumerate(actions_for(env, 6), start=1):
        rows, _, dones, infos = env.step(actions)
        assert dones.all() == dones.any() == (number % 3 == 0)
        for row, info in zip(rows, infos, strict=True):
            assert info.get("TimeLimit.truncated", None) is (True if number % 3 == 0 else None)
            if number % 3 == 0:
                assert not np.array_equal(info["terminal_observation"], row)
                assert env.observation_space.contains(info["terminal_observation"])


def test_success_is_a_termination_even_at_the_horizon():
    """With a radius that nobody can miss, episodes end after one step, and no value may be added after it."""
    for max_cycles in (1, 5):
        env = sb3(max_cycles=max_cycles, success_radius=1e3)
        env.reset()
        _, _, dones, infos = env.step(actions_for(env, 1)[0])
        assert dones.all()
        assert [info["TimeLimit.truncated"] for info in infos] == [False] * env.num_envs


def tiny(env, **arguments):
    return PPO("MlpPolicy", env, n_steps=4, batch_size=16, n_epochs=1, seed=0, device="cpu", **arguments)


@pytest.mark.parametrize("success", [False, True])
def test_ppo_bootstraps_at_the_horizon_and_not_after_success(success):
    """SB3 adds gamma * V(terminal observation) to the reward in its buffer exactly where an episode was truncated."""
    env = sb3(max_cycles=2, success_radius=1e3 if success else None)
    rewards, terminal = [], []
    step_wait = env.step_wait

    def spied():
        result = step_wait()
        rewards.append(result[1].copy())
        terminal.append([info.get("terminal_observation") for info in result[3]])
        return result

    env.step_wait = spied
    model = tiny(env, gamma=0.9)
    values = model.policy.predict_values
    with torch.no_grad():  # values far from zero, so that what is added shows
        model.policy.value_net.bias += 10.0
    rollout, model.train = {}, lambda: rollout.update(rewards=model.rollout_buffer.rewards.copy())
    model.learn(4 * env.num_envs)
    for number, (given, last) in enumerate(zip(rewards, terminal, strict=True)):
        over = success or number % 2 == 1
        assert all((one is not None) == over for one in last)
        expected = given.copy()
        if over and not success:
            with torch.no_grad():
                expected += 0.9 * values(torch.as_tensor(np.stack(last))).numpy().ravel()
            assert np.all(np.abs(expected - given) > 1.0)
        np.testing.assert_allclose(rollout["rewards"][number], expected, rtol=1e-5, atol=1e-6)


def test_ppo_learns_and_a_seed_fixes_every_weight():
    """PPO(seed=0) runs on the environment as it is; twice the same weights, bit for bit; others for another seed."""

    def weights(seed):
        env = sb3("leader_following_v0", "convoy", max_cycles=3)
        model = PPO("MlpPolicy", env, n_steps=8, batch_size=40, n_epochs=2, seed=seed, device="cpu")
        start = [one.detach().numpy().copy() for one in model.policy.parameters()]
        model.learn(2 * 8 * env.num_envs)
        return start, [one.detach().numpy().copy() for one in model.policy.parameters()]

    start, learnt = weights(0)
    assert same(weights(0)[1], learnt)
    assert not same(weights(1)[1], learnt)
    assert all(np.isfinite(one).all() for one in learnt)
    assert not same(start, learnt)


def test_what_was_returned_is_never_written_again():
    """Rows, rewards, dones, infos and terminal observations of different steps share no memory."""
    env = sb3(max_cycles=2)
    env.reset()
    seen = [env.step(one) for one in actions_for(env, 4)]
    for one, other in itertools.pairwise(seen):
        assert not any(np.shares_memory(a, b) for a in one[:3] for b in other[:3])
        assert not np.shares_memory(one[0], other[0])
        assert not {id(info) for info in one[3]} & {id(info) for info in other[3]}
    rows, infos = seen[1][0], seen[1][3]
    assert not any(np.shares_memory(info["terminal_observation"], rows) for info in infos)


def test_sb3_s_own_wrappers_run_on_it():
    """VecMonitor sees whole episodes, VecNormalize normalises, and attributes are answered once per row."""
    env = VecNormalize(VecMonitor(sb3(max_cycles=3)))
    env.seed(0)
    env.reset()
    for number, actions in enumerate(actions_for(env, 6), start=1):
        _, _, dones, infos = env.step(actions)
        assert dones.all() == (number % 3 == 0)
        assert all(info["episode"]["l"] == 3 for info in infos if dones.all())
    assert env.get_attr("agents", [0, 3]) == [env.unwrapped.batched.agents] * 2
    assert len(env.env_method("observations")) == env.num_envs
    assert env.env_is_wrapped(VecMonitor) == [False] * env.num_envs


def test_statistics_of_episodes_are_those_of_monitor():
    """Against Stable-Baselines3's own Monitor around the centralised view, whose reward is the mean of the agents'."""
    arguments = {"scenario": built("paper"), "max_cycles": 6, "success_radius": 2.3}
    env = make_sb3_vec("formation_v0", COPIES, **arguments)
    theirs = make_vec_env("khop/Formation-v0", COPIES, env_kwargs=arguments)
    for one in (env, theirs):
        one.seed(11)
        one.reset()
    lengths, before = [], 0.0
    for actions in actions_for(env, 25):
        *_, dones, infos = env.step(actions)
        *_, its_dones, its = theirs.step(actions.reshape(COPIES, -1))
        assert dones.tolist() == np.repeat(its_dones, 8).tolist()
        for b, info in enumerate(its):
            found = [row.get("episode") for row in infos[8 * b : 8 * b + 8]]
            if "episode" not in info:
                assert found == [None] * 8
                continue
            expected = info["episode"]
            assert {one["l"] for one in found} == {expected["l"]}
            assert np.mean([one["r"] for one in found]) == pytest.approx(expected["r"], abs=2e-6)
            assert all(type(one["r"]) is float and type(one["l"]) is int for one in found)
            assert found[0]["t"] >= before
            before = found[0]["t"]
            lengths.append(expected["l"])
    assert len(set(lengths)) > 1  # some by success, some at the horizon
    env.reset()
    for actions in actions_for(env, 6):
        *_, infos = env.step(actions)
    assert {info["episode"]["l"] for info in infos if info} == {6}  # reset begins anew


def test_ppo_logs_the_mean_return(tmp_path):
    """Without a wrapper, on the logger that TensorBoard and the progress table read."""
    model = tiny(sb3(max_cycles=3))
    model.set_logger(configure(str(tmp_path), ["csv"]))
    model.learn(2 * 4 * model.n_envs)
    model.logger.close()
    lines = (tmp_path / "progress.csv").read_text().splitlines()
    logged = [dict(zip(lines[0].split(","), line.split(","), strict=True)) for line in lines[1:]]
    assert float(logged[-1]["rollout/ep_len_mean"]) == 3.0
    assert float(logged[-1]["rollout/ep_rew_mean"]) < 0.0


def test_ragged_observations_have_no_rows():
    with pytest.raises(ValueError, match="Stable-Baselines3 VecEnv has one space for all rows: it needs uniform=True"):
        sb3(uniform=False)


@pytest.mark.parametrize("bad", ["nan", "shape", "transposed", "text"])
def test_bad_actions_are_refused_and_change_nothing(bad):
    """A corrected call follows as if nothing had been."""
    env, clean = sb3(max_cycles=2), sb3(max_cycles=2)
    for one in (env, clean):
        one.seed(3)
        one.reset()
    wrong = actions_for(env, 1)[0]
    if bad == "nan":
        wrong[9, 1] = np.nan
    wrong = {"nan": wrong, "shape": wrong[:-1], "transposed": wrong.T, "text": wrong.astype(str)}[bad]
    message = r"'drifter_1' in environment 1 isn't finite: entry 1 is nan" if bad == "nan" else "actions must "
    for actions in actions_for(env, 3):
        with pytest.raises(ValueError, match=message):
            env.step(wrong)
        results = env.step(actions), clean.step(actions)
        for *_, infos in results:
            for info in infos:
                info.get("episode", {}).pop("t", None)  # seconds since each was made
        assert same(*results)


def test_unknown_environments_are_refused_with_the_nearest():
    with pytest.raises(ValueError, match="no environment 'consensus'; did you mean 'consensus_v0'"):
        make_sb3_vec("consensus")
