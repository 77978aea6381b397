"""PPO with updates compiled by JAX does what Stable-Baselines3's own does, and leaves and resumes the same."""

import dataclasses
import os
import signal
import sys

import numpy as np
import pytest
import torch

from agents.learning import LearnedPolicy, Sweep, TrainingConfig, run_sweep, train
from agents.learning.environment import training_environment
from agents.learning.networks import make_model
from tests.agents.training import SMALL

JAX = dataclasses.replace(SMALL, backend="jax")


@pytest.mark.parametrize(
    ("changes", "said"),
    [
        ({"backend": "numpy"}, "backend must be 'torch' or 'jax'; got 'numpy'"),
        ({"backend": "jax", "algorithm": "sac"}, "backend 'jax' needs algorithm='ppo'; got 'sac'"),
        ({"backend": "jax", "per_type": True}, "backend 'jax' needs per_type=False; got True: choose it or 'torch'"),
        ({"backend": "jax", "policy": "attention"}, "backend 'jax' needs policy='mlp'; got 'attention'"),
        ({"backend": "jax", "critic": "state"}, "backend 'jax' needs critic='local'; got 'state'"),
    ],
)
def test_other_combinations_are_refused(changes, said):
    with pytest.raises(ValueError, match=said):
        TrainingConfig("consensus_v0", **changes)


def test_without_jax_it_says_what_to_install(tmp_path, monkeypatch):
    """Before there is a folder; a sweep before anything is trained."""
    monkeypatch.setitem(sys.modules, "jax", None)
    sweep = Sweep({"environment": "consensus_v0", "timesteps": 100}, {"backend": ["torch", "jax"]})
    for begin in (lambda: train(JAX, tmp_path / "run"), lambda: run_sweep(sweep, tmp_path / "run")):
        with pytest.raises(ModuleNotFoundError, match=r"backend 'jax' needs JAX: .*pip install .*'\.\[jax\]'"):
            begin()
        assert not (tmp_path / "run").exists()


def updated(config, updates):
    """A model after some updates of the same rollout, with the same batches."""
    model = make_model(config, training_environment(config), [], None)
    model.learn(1)  # a rollout; its update has a learning rate of 0
    model._current_progress_remaining = 1.0
    np.random.seed(5)  # noqa: NPY002  # Stable-Baselines3 shuffles with it
    for _ in range(updates):
        model.train()
    return model


@pytest.mark.parametrize("changes", [{}, {"hidden": (32, 16, 8), "entropy": 0.0, "batch_size": 256, "n_epochs": 3}])
def test_an_update_is_that_of_stable_baselines3(changes):
    pytest.importorskip("jax")
    settings = {"learning_rate": 1e-3, "log_std": -0.5, **changes}
    ours, theirs = (updated(dataclasses.replace(config, **settings), 2) for config in (JAX, SMALL))
    assert type(ours) is not type(theirs)
    for (name, own), expected in zip(ours.policy.named_parameters(), theirs.policy.parameters(), strict=True):
        np.testing.assert_allclose(own.detach(), expected.detach(), rtol=0, atol=2e-5, err_msg=name)
        mine, other = ours.policy.optimizer.state[own], theirs.policy.optimizer.state[expected]
        assert list(mine) == list(other)
        assert (mine["step"].dtype, mine["step"]) == (other["step"].dtype, other["step"])
        for moment in ("exp_avg", "exp_avg_sq"):
            largest = float(other[moment].abs().max())
            torch.testing.assert_close(mine[moment], other[moment], rtol=1e-3, atol=1e-3 * largest)
    logged, expected = ours.logger.name_to_value, theirs.logger.name_to_value
    assert set(logged) == set(expected)
    for name, value in expected.items():
        assert logged[name] == pytest.approx(value, rel=1e-3, abs=1e-5), name


def test_interrupted_and_resumed_it_equals_a_run_in_one_go(tmp_path):
    pytest.importorskip("jax")

    def interrupt(part, found):
        if part > 0.45:
            os.kill(os.getpid(), signal.SIGINT)

    whole = train(JAX, tmp_path / "whole")
    assert not train(JAX, tmp_path / "run", on_progress=interrupt).finished
    assert train(JAX, tmp_path / "run", resume=True).finished
    for name in ("curve.csv", "config.toml"):
        assert (tmp_path / "run" / name).read_bytes() == (tmp_path / "whole" / name).read_bytes()
    first, second = (LearnedPolicy.load(tmp_path / name / "last.npz") for name in ("whole", "run"))
    for one, other in zip(first.networks[""].layers, second.networks[""].layers, strict=True):
        np.testing.assert_array_equal(one[0], other[0])
    assert whole.curve[-1].mean_return > whole.curve[0].mean_return
    with pytest.raises(ValueError, match="backend = 'jax' there and 'torch' here; resume with the same settings"):
        train(SMALL, tmp_path / "whole", resume=True)
