"""A training that begins with the networks of another one."""

import dataclasses

import numpy as np
import pytest

from agents.learning import LearnedPolicy
from agents.learning.environment import training_environment
from agents.learning.networks import make_model
from agents.learning.training import _Run, train
from tests.agents.training import SMALL

TINY = dataclasses.replace(SMALL, num_envs=4, timesteps=1500, evaluations=1)


@pytest.fixture(scope="module")
def run(tmp_path_factory):
    folder = tmp_path_factory.mktemp("first")
    train(TINY, folder)
    return folder


def weights(policy):
    return [array for network in policy.networks.values() for pair in network.layers for array in pair]


def same(first, second):
    return all(np.array_equal(one, other) for one, other in zip(weights(first), weights(second), strict=True))


def test_it_begins_where_the_other_run_ended(run):
    """Policy, value function and exploration from a folder; a policy's file has only the policy."""
    last = LearnedPolicy.load(run / "last.npz")
    assert not same(_Run(TINY, None, None, None).policy, last)
    first = _Run(TINY, None, None, None).algorithm.policy.state_dict()
    for source, learned in ((run, True), (run / "last.npz", False)):
        begun = _Run(dataclasses.replace(TINY, initial=str(source), seed=5), None, None, None)
        assert same(begun.policy, last)
        found = begun.algorithm.policy.state_dict()
        assert (not np.array_equal(found["log_std"], first["log_std"])) == learned
    with_bounds = dataclasses.replace(TINY, initial=str(run), arguments={"control_period": 0.1})
    assert same(_Run(with_bounds, None, None, None).policy, last)  # another control period fits


def test_a_network_for_each_type_comes_from_a_folder(tmp_path):
    """A file alone is refused."""
    config = dataclasses.replace(TINY, per_type=True)
    train(config, tmp_path)
    begun = _Run(dataclasses.replace(config, initial=str(tmp_path)), None, None, None)
    assert same(begun.policy, LearnedPolicy.load(tmp_path / "last.npz"))
    with pytest.raises(ValueError, match=r"can't begin from .*last\.npz: .*name the folder of its run"):
        _Run(dataclasses.replace(config, initial=str(tmp_path / "last.npz")), None, None, None)


def test_the_whole_of_sac_is_taken_on(tmp_path):
    """Its critics, too."""
    config = dataclasses.replace(TINY, algorithm="sac", batch_size=64, timesteps=300)
    train(config, tmp_path)
    begun = _Run(dataclasses.replace(config, initial=str(tmp_path)), None, None, None)
    assert same(begun.policy, LearnedPolicy.load(tmp_path / "last.npz"))
    fresh = make_model(config, training_environment(config), [], None).policy.state_dict()
    critic = next(name for name in fresh if name.startswith("critic.") and name.endswith("weight"))
    assert not np.array_equal(begun.algorithm.policy.state_dict()[critic], fresh[critic])


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"hidden": (32, 32)}, r"trained with hidden = \[64, 64\], and this run has hidden = \[32, 32\]"),
        ({"rates": False}, "trained with rates = True, and this run has rates = False"),
        ({"environment": "navigation_v0", "scenario": None}, "it was trained for consensus_v0, not for navigation_v0"),
        ({"bounds": True}, r"with \d+ observation columns; this environment has \d+"),
        ({"environment": "formation_v0"}, "it was trained for consensus_v0, not for formation_v0"),
        ({"algorithm": "sac"}, "trained with algorithm = 'ppo', and this run has algorithm = 'sac'"),
    ],
)
def test_what_does_not_fit_is_refused(run, tmp_path, changes, said):
    """Before anything is written."""
    config = dataclasses.replace(TINY, **changes, initial=str(run))
    with pytest.raises(ValueError, match=rf"can't begin from {run}: .*{said}"):
        train(config, tmp_path / "new")
    assert not (tmp_path / "new" / "config.toml").exists()


def test_a_run_that_is_not_there_is_refused(tmp_path):
    with pytest.raises(ValueError, match=r"can't begin from .*nowhere: no policy file"):
        _Run(dataclasses.replace(TINY, initial=str(tmp_path / "nowhere")), None, None, None)
