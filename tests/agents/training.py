"""Trainings that are small enough for tests."""

import signal
from pathlib import Path

import numpy as np

from agents.learning import LearnedPolicy, Training, TrainingConfig, train

SMALL = TrainingConfig("consensus_v0", "mixed_fleet", timesteps=15_000, num_envs=16, evaluations=3, batch_size=512)


def resumed_as_uninterrupted(config: TrainingConfig, folder: Path) -> tuple[Training, LearnedPolicy]:
    """Train in folder/whole, and with an interrupt in folder/cut, which has to end with the same curve and networks.

    Returns:
        The uninterrupted training, and its last policy.
    """

    def interrupt(fraction, found):
        if fraction > 0.5:
            signal.raise_signal(signal.SIGINT)

    whole = train(config, folder / "whole")
    assert not train(config, folder / "cut", on_progress=interrupt).finished
    assert train(config, folder / "cut", resume=True).curve == whole.curve
    last, resumed = (LearnedPolicy.load(folder / name / "last.npz") for name in ("whole", "cut"))
    for kind, network in last.networks.items():
        other = resumed.networks[kind].arrays()
        assert all(np.array_equal(array, other[name]) for name, array in network.arrays().items())
    return whole, last
