"""Copies whose episode ends, in the Gymnasium vector environment: against Gymnasium's own, and its wrappers."""

import copy
import pickle

import gymnasium
import numpy as np
import pytest
from gymnasium.vector import AutoresetMode, SyncVectorEnv
from gymnasium.wrappers.vector import (
    DtypeObservation,
    FlattenObservation,
    NormalizeObservation,
    NormalizeReward,
    RecordEpisodeStatistics,
    RescaleObservation,
)

from khop_env import make_vec
from khop_env.env.vector import _WRAPPERS_MISCOUNT
from tests.env.playing import built, info_keys, same

COPIES = 3


def vector(environment="consensus_v0", name="paper", copies=COPIES, autoreset_mode="same_step", **arguments):
    return make_vec(environment, copies, autoreset_mode=autoreset_mode, scenario=built(name), **arguments)


def actions_for(env, cycles, scale=1.3):
    return np.random.default_rng(0).uniform(-scale, scale, (cycles, *env.action_space.shape)).astype(np.float32)


MODES = ("same_step", "next_step", "disabled")
in_each_mode = pytest.mark.parametrize("mode", MODES)


def mask_of(env, rows):
    """The mask with which the copies whose rows are over are reset."""
    return {"reset_mask": rows} if env.metadata["autoreset_mode"] is AutoresetMode.DISABLED and rows.any() else None


@in_each_mode
def test_the_same_as_gymnasium_s_own(mode):
    """Against SyncVectorEnv over the centralised view, whose observation is all agents' side by side.

    With a success radius copies end at different times, some by termination and some by truncation.
    """
    arguments = {"max_cycles": 6, "success_radius": 2.3}
    env = vector("formation_v0", copies=COPIES, autoreset_mode=mode, **arguments)
    single = lambda: gymnasium.make("khop/Formation-v0", scenario=built("paper"), **arguments)  # noqa: E731
    theirs = SyncVectorEnv([single] * COPIES, autoreset_mode=AutoresetMode[mode.upper()])
    agents = len(env.batched.agents)

    def require_same(rows, infos, observations, its):
        assert rows.reshape(COPIES, -1).tobytes() == observations.tobytes()
        for key in info_keys("formation_v0"):
            np.testing.assert_array_equal(infos[f"_{key}"], np.repeat(its[f"_{key}"], agents))
        error = infos["task_error"].reshape(COPIES, -1).mean(axis=1)
        np.testing.assert_array_equal(error, its["task_error"])

    require_same(*env.reset(seed=11), *theirs.reset(seed=11))
    ends = set()
    for actions in actions_for(env, 25):
        rows, rewards, *flags, infos = env.step(actions)
        observations, its_rewards, *its_flags, its = theirs.step(actions.reshape(COPIES, -1))
        require_same(rows, infos, observations, its)
        np.testing.assert_array_equal(rewards.reshape(COPIES, -1).mean(axis=1), its_rewards)
        for flag, its_flag in zip(flags, its_flags, strict=True):
            np.testing.assert_array_equal(flag, np.repeat(its_flag, agents))
        over = its_flags[0] | its_flags[1]
        ends |= {tuple(over.tolist())}
        assert ("final_obs" in infos) == ("final_obs" in its) == (mode == "same_step" and over.any())
        if "final_obs" in infos:
            np.testing.assert_array_equal(infos["_final_obs"], np.repeat(over, agents))
            for b in np.flatnonzero(over):
                last = np.concatenate(infos["final_obs"][b * agents : (b + 1) * agents])
                assert last.tobytes() == its["final_obs"][b].tobytes()
        if mode == "disabled" and over.any():
            again = env.reset(options={"reset_mask": np.repeat(over, agents)})
            require_same(*again, *theirs.reset(options={"reset_mask": over}))
    assert len(ends) > 3  # nobody, several, and all


@in_each_mode
def test_the_mode_is_where_libraries_look(mode):
    """TorchRL reads the attribute, Gymnasium's wrappers the metadata; a member of the enumeration may be given, too."""
    expected = AutoresetMode[mode.upper()]
    for given in (mode, expected, expected.value):
        env = vector(autoreset_mode=given)
        assert env.autoreset_mode is expected
        assert env.metadata["autoreset_mode"] is expected


@in_each_mode
def test_gymnasium_s_statistics_count_whole_episodes(mode):
    """Lengths, and returns as summed by hand, over several episodes."""
    if mode == "same_step" and _WRAPPERS_MISCOUNT:
        pytest.skip("before Gymnasium 1.4 it counts a step less")
    env = RecordEpisodeStatistics(vector(autoreset_mode=mode, max_cycles=5))
    env.reset(seed=0)
    total, seen = np.zeros(env.num_envs), []
    for actions in actions_for(env, 18):
        _, rewards, terminated, truncated, infos = env.step(actions)
        total += rewards
        over = terminated | truncated
        if over.any():
            assert over.all()
            assert infos["episode"]["l"].tolist() == [5] * env.num_envs
            np.testing.assert_allclose(infos["episode"]["r"], total, rtol=1e-12)
            seen.append(total)
            total = np.zeros(env.num_envs)
            if mode == "disabled":
                env.reset(options={"reset_mask": over})
    assert len(seen) == 3
    assert not np.array_equal(seen[0], seen[1])


@pytest.mark.filterwarnings("ignore:overflow encountered in cast")  # Gymnasium's, in DtypeObservation
@pytest.mark.parametrize("mode", ["next_step", "disabled"])
@pytest.mark.parametrize("wrapper", ["normalize", "flatten", "rescale", "dtype", "reward"])
def test_gymnasium_s_wrappers_take_it(wrapper, mode):
    """Those that refuse same-step autoreset, over the ends of episodes."""
    if wrapper == "normalize" and mode == "disabled":
        pytest.skip("Gymnasium's NormalizeObservation takes next-step autoreset only")
    plain = vector(autoreset_mode=mode, max_cycles=3)
    space = plain.single_observation_space
    wrapped = {
        "normalize": NormalizeObservation,
        "flatten": FlattenObservation,
        "rescale": lambda env: RescaleObservation(env, np.float32(-1.0), np.float32(1.0)),
        "dtype": lambda env: DtypeObservation(env, np.float64),
        "reward": NormalizeReward,
    }[wrapper](vector(autoreset_mode=mode, max_cycles=3))
    expected = {
        "flatten": lambda rows: rows,
        "rescale": lambda rows: 2.0 * (rows - space.low) / (space.high - space.low) - 1.0,
        "dtype": lambda rows: rows.astype(float),
        "reward": lambda rows: rows,
    }.get(wrapper)
    pairs = [(wrapped.reset(seed=0)[0], plain.reset(seed=0)[0])]
    for actions in actions_for(plain, 8):
        results = wrapped.step(actions), plain.step(actions)
        pairs.append((results[0][0], results[1][0]))
        options = mask_of(plain, results[1][2] | results[1][3])
        if options is not None:
            pairs.append((wrapped.reset(options=dict(options))[0], plain.reset(options=dict(options))[0]))
    for rows, its in pairs:
        if expected is None:
            assert np.isfinite(rows).all()
            assert np.abs(rows).max() < 20.0
        else:
            np.testing.assert_allclose(rows, expected(its), rtol=1e-5, atol=1e-5)


def test_an_ended_copy_waits_for_the_next_step():
    """Its actions are ignored, not finite ones included, its rewards are 0, and the others' bits aren't touched."""
    env, other = (vector(autoreset_mode="next_step", success_radius=0.05, max_cycles=50) for _ in range(2))
    n = env.batched.fleet.n
    x0 = env.batched.simulator.initial.center + np.random.default_rng(0).uniform(-1.0, 1.0, (COPIES, n))
    for one in (env, other):
        x0[1] = 0.3 if one is env else x0[0]
        one.reset(seed=0, options={"initial_state": x0})
    still = np.zeros(env.action_space.shape, np.float32)
    last, _, terminated, _, infos = env.step(still)
    other.step(still)
    assert terminated.tolist() == [False] * 8 + [True] * 8 + [False] * 8
    assert "final_obs" not in infos
    actions = actions_for(env, 2)
    actions[0, 8:16] = np.nan
    rows, rewards, terminated, truncated, infos = env.step(actions[0])
    expected, its_rewards, *_ = other.step(np.nan_to_num(actions[0]))
    assert not terminated.any()
    assert not truncated.any()
    assert rewards[8:16].tolist() == [0.0] * 8
    np.testing.assert_array_equal(env.batched.simulator.t, [0.1, 0.0, 0.1])
    assert not np.array_equal(rows[8:16], last[8:16])
    for part in (slice(8), slice(16, 24)):
        assert rows[part].tobytes() == expected[part].tobytes()
        assert rewards[part].tobytes() == its_rewards[part].tobytes()
    assert all(infos[f"_{key}"].all() for key in info_keys("consensus_v0"))
    env.step(actions[1])
    np.testing.assert_allclose(env.batched.simulator.t, [0.15, 0.05, 0.15])


@pytest.mark.parametrize("copied", [copy.deepcopy, lambda env: pickle.loads(pickle.dumps(env))], ids=["copy", "pickle"])
def test_a_copy_made_between_an_end_and_its_reset_goes_on(copied):
    env = vector("leader_following_v0", "mixed_fleet", autoreset_mode="next_step", max_cycles=3)
    env.reset(seed=1)
    actions = actions_for(env, 9)
    for one in actions[:3]:
        env.step(one)
    assert env.batched.over.all()
    twin = copied(env)
    assert same([env.step(one) for one in actions[3:]], [twin.step(one) for one in actions[3:]])


@in_each_mode
def test_a_mask_resets_its_copies_only(mode):
    """In every mode, with the seeds and initial states of these copies; the caller's options stay as they are."""
    env, clean = (vector(autoreset_mode=mode, max_cycles=9) for _ in range(2))
    for one in (env, clean):
        one.reset(seed=1)
    actions = actions_for(env, 4)
    assert same(env.step(actions[0]), clean.step(actions[0]))
    mask = np.repeat([True, False, True], 8)
    for seed in (7, [7, 8, 9]):
        options = {"reset_mask": mask}
        rows, infos = env.reset(seed=seed, options=options)
        assert options == {"reset_mask": mask}
        fresh = vector().reset(seed=7)
        for part in (slice(8), slice(16, 24)):
            assert rows[part].tobytes() == fresh[0][part].tobytes()
            assert infos["task_error"][part].tobytes() == fresh[1]["task_error"][part].tobytes()
        np.testing.assert_array_equal(infos["_task_error"], mask)
    x0 = np.arange(3.0 * env.batched.fleet.n).reshape(3, -1) / 100.0
    env.reset(options={"reset_mask": mask, "initial_state": x0})
    np.testing.assert_array_equal(env.batched.simulator.x[[0, 2]], x0[[0, 2]])
    for one in actions[1:]:
        assert env.step(one)[0][8:16].tobytes() == clean.step(one)[0][8:16].tobytes()


@pytest.mark.parametrize(
    ("mask", "message"),
    [
        ([True] * 24, "must be an array of 24 bool, one per row; got list"),
        (np.ones(3, bool), r"must be an array of 24 bool, one per row; got bool of shape \(3,\)"),
        (np.ones(24), r"must be an array of 24 bool, one per row; got float64 of shape \(24,\)"),
        (np.zeros(24, bool), "has no True: there is nothing to reset"),
        (
            np.arange(24) < 9,
            "rows 8 to 15 are the agents of environment 1, which are reset together: mask all or none; got",
        ),
    ],
)
def test_masks_that_do_not_fit_are_refused_and_change_nothing(mask, message):
    env, clean = vector(), vector()
    assert same(env.reset(seed=1), clean.reset(seed=1))
    with pytest.raises(ValueError, match=f"option reset_mask:? {message}"):
        env.reset(options={"reset_mask": mask})
    assert same(env.reset(), clean.reset())


def test_without_autoreset_an_ended_copy_has_to_be_reset():
    env = vector(autoreset_mode="disabled", max_cycles=2)
    env.reset(seed=0)
    actions = actions_for(env, 3)
    env.step(actions[0])
    rows, _, _, truncated, _ = env.step(actions[1])
    assert truncated.all()
    with pytest.raises(
        ValueError, match=r"no episode is running in 3 of 3 environments, the first 0: call reset\(\) first"
    ):
        env.step(actions[2])
    assert same(env.batched.observations().reshape(24, -1), rows)


def test_old_wrappers_that_would_miscount_are_named(monkeypatch):
    """Before Gymnasium 1.4, where nobody chose a mode."""
    monkeypatch.setattr("khop_env.env.vector._WRAPPERS_MISCOUNT", True)
    with pytest.warns(UserWarning, match="miss a step per episode .* give autoreset_mode='next_step' to use them"):
        env = make_vec("consensus_v0", scenario=built("paper"))
    assert env.autoreset_mode is AutoresetMode.SAME_STEP
    vector(autoreset_mode="same_step")
