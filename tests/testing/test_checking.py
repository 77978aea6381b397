"""check_environment: correct environments pass, and each violation fails exactly one check, with its place."""

import copy
import itertools
import re
from functools import partial

import numpy as np
import pytest
from pettingzoo.utils import parallel_to_aec

import khop_env
from khop_env import consensus_v0, leader_following_v0
from khop_env.env import JointEnv, KHopEnv, KHopVectorEnv
from khop_env.env.sb3 import KHopSB3VecEnv
from khop_env.testing import CHECKS, Check, Report, check_environment, difference
from tests.walkers import FAULTS, HORIZON, Buffered, LikeMpe2, Siamese, Walkers

ONLY = Walkers()
OURS_ONLY = {"restore", "views", "leak", "gymnasium", "sb3"}


def statuses(report: Report, status: str) -> list[str]:
    return [check.name for check in report.checks if check.status == status]


def test_what_keeps_the_contract_passes():
    """All checks of a ParallelEnv pass without notes; those for our own environments say why they don't apply."""
    report = check_environment(Walkers)
    assert report.ok
    assert tuple(check.name for check in report.checks) == CHECKS
    assert set(statuses(report, "skipped")) == OURS_ONLY
    assert all(report[name].detail.count("khop_env") for name in OURS_ONLY)
    assert not any(check.detail for check in report.checks if check.status == "passed")
    report.raise_if_failed()


@pytest.mark.parametrize("fault", FAULTS, ids=lambda fault: fault.__name__)
def test_each_fault_is_caught_by_one_check_alone(fault):
    name, message = FAULTS[fault]
    report = check_environment(fault, steps=5 * HORIZON)
    assert not report.ok
    assert statuses(report, "failed") == [name], str(report)
    assert re.search(message, report[name].detail), report[name].detail
    with pytest.raises(AssertionError, match=f"FAILED   {name} "):
        report.raise_if_failed()


def test_the_faults_of_mpe2_and_of_pettingzoo_s_own_tests():
    """Motor noise from NumPy's generator; nan outside the Box, which parallel_api_test passes."""
    from pettingzoo.test import parallel_api_test

    parallel_api_test(LikeMpe2(), num_cycles=30)
    report = check_environment(LikeMpe2)
    assert {"spaces", "same_seed", "global_random"} <= set(statuses(report, "failed"))
    assert re.match(
        r"call 12, step\(\): the observation of 'walker_1' isn't finite: entry 1 is nan", report["spaces"].detail
    )
    assert report["same_seed"].detail.endswith("numbers are drawn from NumPy's or Python's global generator")
    assert {"pickle", "deepcopy"} <= set(statuses(report, "passed"))  # with the same global generator they do go on


def test_flags_that_are_no_flags():
    class Unflagged(Walkers):
        def over(self):
            return 0.0, float(self.t >= HORIZON)

    detail = check_environment(Unflagged)["episode_end"].detail
    assert detail == "call 1, step(): terminations must be True or False for 'walker_0'; got 0.0"


def test_noise_is_found_although_buffers_are_written_again():
    """Comparisons use the values at the time of return, not at the end."""

    starts = itertools.count()  # drawn noise of this size may be equal twice, in float32

    class NoisyStart(Buffered):
        def observe_all(self):
            seen = super().observe_all()
            if self.t == 1:
                seen["walker_0"] += np.float32(1.5e-7 * (next(starts) % 7))
            return seen

    report = check_environment(NoisyStart, steps=HORIZON)  # the last observation has no noise
    assert statuses(report, "failed") == ["same_seed", "memory"], str(report)
    assert report["same_seed"].detail.startswith("call 1, step(): observations['walker_0']")


def test_instances_that_share_a_generator():
    class Shared(Walkers):
        rng = None

        def generator(self, seed):
            type(self).shared = np.random.default_rng(seed)
            return None

        def reset(self, seed=None, options=None):
            type(self).shared = np.random.default_rng(seed)
            self.agents, self.t, self.x = list(self.possible_agents), 0, self.shared.uniform(-1.0, 1.0, 2)
            return self.observe_all(), {agent: {} for agent in self.agents}

        def noise(self):
            return 0.1 * self.shared.uniform(-1.0, 1.0, 2)

    report = check_environment(Shared)
    assert "pettingzoo_seeds" in statuses(report, "failed")
    assert "AssertionError: Incorrect" in report["pettingzoo_seeds"].detail


def test_an_object_is_copied_and_one_that_cannot_be_says_so():
    """An object that can be copied isn't changed; otherwise checks that need several environments are skipped."""
    env = Walkers()
    assert check_environment(env).ok
    assert env.agents == []

    class Unique(Walkers):
        def __reduce__(self):
            raise TypeError("I hold a window")

    report = check_environment(Unique())
    assert statuses(report, "failed") == ["pickle", "deepcopy"]  # which are promises
    needed = {"unseeded", "pettingzoo_seeds"}
    assert needed <= set(statuses(report, "skipped"))
    for name in needed:
        assert (
            "pass a function that returns a new one: deepcopy raised TypeError: I hold a window ("
            in report[name].detail
        )
    assert "same_seed" in statuses(report, "passed")  # which plays the object twice
    assert check_environment(Siamese())["deepcopy"].status == "failed"


def test_checks_that_are_left_out_and_episodes_that_do_not_end():
    report = check_environment(Walkers, steps=10, skip=["other_seed"])
    assert report["other_seed"].status == report["episode_end"].status == "skipped"
    assert report["other_seed"].detail == "left out, as asked"
    assert report["episode_end"].detail == "an episode takes more than 10 steps"


@pytest.mark.parametrize(
    ("env", "arguments", "message"),
    [
        (3, {}, r"expected a PettingZoo ParallelEnv, or a function that returns one; got int"),
        (lambda: None, {}, r"got NoneType"),
        (parallel_to_aec(Walkers()), {"skip": ["spaecs"]}, r"no check 'spaecs'; did you mean 'spaces'"),
        (lambda: ONLY, {}, "the function returned the same environment twice"),
        (Walkers, {"steps": 0}, "steps must be at least 1 and seed not negative; got steps=0 and seed=0"),
        (Walkers, {"seed": -1}, "got steps=300 and seed=-1"),
    ],
)
def test_what_it_refuses(env, arguments, message):
    with pytest.raises(ValueError, match=message):
        check_environment(env, **arguments)


def test_failures_are_listed_last_where_they_are_seen():
    statuses = ("passed", "failed", "skipped", "failed", "passed")
    report = Report("mine", tuple(Check(f"check{q}", "claim", status) for q, status in enumerate(statuses)))
    assert [line.split()[1] for line in str(report).splitlines()[1:]] == [f"check{q}" for q in (0, 2, 4, 1, 3)]


def test_the_table_fits_80_columns_and_names_all():
    report = check_environment(LikeMpe2)
    lines = str(report).splitlines()
    assert max(map(len, lines)) <= 80
    assert lines[0].startswith("Walkers") or "failed" in lines[0]
    for check in report.checks:
        assert any(re.match(rf"(passed  |FAILED  |skipped ) {check.name} ", line) for line in lines)


@pytest.mark.parametrize(
    "make",
    [
        lambda: consensus_v0.env("paper", max_cycles=10),
        lambda: khop_env.registry.make_joint("consensus_v0", scenario="paper", max_cycles=10),
    ],
    ids=["aec", "joint"],
)
def test_the_other_views_are_checked_as_the_environment_inside(make):
    report = check_environment(make, steps=20)
    assert statuses(report, "passed") == list(CHECKS), str(report)


class Generous(KHopEnv):
    """Rewards that differ from those of the batched form."""

    def step(self, actions):
        observations, rewards, *others = super().step(actions)
        return observations, {agent: reward + 0.5 for agent, reward in rewards.items()}, *others


def test_a_view_that_differs_is_named():
    report = check_environment(
        lambda: Generous(leader_following_v0.batched_env("paper", max_cycles=10), name="generous"), steps=20
    )
    assert statuses(report, "failed") == ["views"]
    assert report["views"].detail.startswith("step 1, single environments, then as a batch: rewards[0]: ")


@pytest.mark.parametrize(
    ("view", "method", "text"),
    [
        (KHopVectorEnv, "step", "as a vector environment: observations[0]: "),
        (KHopSB3VecEnv, "step_wait", "as an SB3 VecEnv: observations[0]: "),
        (JointEnv, "step", "with the team as one agent: observations[0]: "),
    ],
)
def test_each_view_is_held_against_single_environments(view, method, text, monkeypatch):
    original = getattr(view, method)

    def step(self, *arguments):
        rows, *others = original(self, *arguments)
        return rows + np.float32(1e-3), *others

    monkeypatch.setattr(view, method, step)
    report = check_environment(partial(consensus_v0.parallel_env, "paper", max_cycles=10), steps=20)
    assert "views" in statuses(report, "failed")
    assert report["views"].detail.startswith(f"step 1, single environments, then {text}")


def test_gymnasium_s_check_is_made(monkeypatch):
    def reset(self, *, seed=None, options=None):  # doesn't seed Gymnasium's own generator
        observations, _ = self.env.reset(seed, None)
        return np.concatenate(list(observations.values())), {}

    monkeypatch.setattr(JointEnv, "reset", reset)
    report = check_environment(partial(consensus_v0.parallel_env, "paper", max_cycles=10), steps=20)
    assert statuses(report, "failed") == ["gymnasium"], str(report)
    assert "AssertionError" in report["gymnasium"].detail


def test_sb3_s_check_is_made(monkeypatch):
    original = JointEnv.step

    def step(self, action):
        observation, reward, *others = original(self, action)
        return observation, np.asarray(reward), *others

    monkeypatch.setattr(JointEnv, "step", step)
    report = check_environment(partial(consensus_v0.parallel_env, "paper", max_cycles=10), steps=20)
    assert "sb3" in statuses(report, "failed")
    assert "The reward returned by `step()` must be a float" in report["sb3"].detail


def test_without_sb3_its_check_says_how_to_install_it(monkeypatch):
    import importlib.util

    find = importlib.util.find_spec
    monkeypatch.setattr(
        importlib.util, "find_spec", lambda name, *rest: None if name == "stable_baselines3" else find(name, *rest)
    )
    report = check_environment(partial(consensus_v0.parallel_env, "paper", max_cycles=10), steps=20)
    assert report.ok
    assert report["sb3"].status == "skipped"
    assert "pip install -c constraints.txt -e '.[rl]'" in report["sb3"].detail
    assert report["views"].detail == "not compared as an SB3 VecEnv: Stable-Baselines3 isn't installed"


def test_ragged_observations_have_fewer_views():
    report = check_environment(
        partial(consensus_v0.parallel_env, "mixed_fleet", uniform=False, max_cycles=10), steps=20
    )
    assert statuses(report, "passed") == list(CHECKS), str(report)
    assert report["views"].detail.startswith("ragged observations have no vector form")


@pytest.mark.parametrize(
    ("first", "second", "place"),
    [
        ({"a": [np.zeros(2), 1.0]}, {"a": [np.array([0.0, 2.0]), 1.0]}, r"^\['a'\]\[0\]\[1\]: 0.0, then 2.0$"),
        (np.zeros(2), np.array([0.0, -0.0]), r"^\[1\]: 0.0, then -0.0$"),
        (0.0, -0.0, "0.0, then -0.0"),
        (1, 1.0, "of type int, then float"),
        (np.float32(1.0), np.float64(1.0), "of type float32, then float64"),
        (np.zeros(2), np.zeros(2, np.float32), r"float64 of shape \(2,\), then float32"),
        ({"a": 1, "b": 2}, {"b": 2, "a": 1}, "keys"),
        ([1], [1, 2], "of length 1, then 2"),
        (np.random.default_rng(0), np.random.default_rng(1), "generator"),
    ],
)
def test_the_first_difference_is_placed(first, second, place):
    assert re.search(place, difference(first, second))
    assert difference(first, copy.deepcopy(first)) is None
    assert difference(second, copy.deepcopy(second)) is None


def test_nan_equals_itself():
    assert difference([np.nan, np.array([np.nan])], [float("nan"), np.array([np.nan])]) is None
