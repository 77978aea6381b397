"""Callbacks of the user's own in a training: called as Stable-Baselines3 does, beside ours."""

import json
import signal

import numpy as np
import pytest
from stable_baselines3.common.callbacks import BaseCallback, StopTrainingOnMaxEpisodes
from tensorboard.backend.event_processing.event_accumulator import EventAccumulator

from agents.learning import LearnedPolicy, TrainingConfig, train
from agents.learning.archive import read_arrays
from agents.learning.callbacks import named_callbacks
from agents.learning.checkpoint import read_checkpoint
from agents.learning.run_folder import CHECKPOINT

ROLLOUT = 2 * 4 * 12  # agent-steps: copies, control periods, agents
TINY = TrainingConfig(
    "consensus_v0",
    "mixed_fleet",
    timesteps=4 * ROLLOUT,
    num_envs=2,
    n_steps=4,
    batch_size=48,
    evaluations=2,
    hidden=(8,),
)


class Calls(BaseCallback):
    """Writes down its calls, and answers or raises at one step."""

    def __init__(self, at=None, answer=True, error=None):
        super().__init__()
        self.calls, self.steps, self.returns = [], [], []
        self.at, self.answer, self.error = at, answer, error

    def _on_training_start(self):
        self.calls.append("training_start")

    def _on_rollout_start(self):
        self.calls.append("rollout_start")
        self.returns.append(self.logger.name_to_value.get("eval/mean_return"))

    def _on_step(self):
        self.calls.append("step")
        self.steps.append(self.num_timesteps)
        if self.num_timesteps == self.at and self.error:
            raise self.error
        return self.answer if self.num_timesteps == self.at else True

    def _on_rollout_end(self):
        self.calls.append("rollout_end")

    def _on_training_end(self):
        self.calls.append("training_end")
        self.returns.append(self.logger.name_to_value.get("eval/mean_return"))


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A run without callbacks."""
    folder = tmp_path_factory.mktemp("whole")
    return train(TINY, folder), folder


def same_checkpoint(folder, other):
    """Whether all is equal, bit for bit, but the time and how it ended."""
    arrays = [read_arrays(each / CHECKPOINT, 2**24) for each in (folder, other)]
    trees = [json.loads(str(each.pop("tree")))["content"] for each in arrays]
    rest = [[item for item in tree["dict"] if item[0] not in ("seconds", "ended")] for tree in trees]
    equal = all(np.array_equal(each, arrays[1][name], equal_nan=True) for name, each in arrays[0].items())
    return list(arrays[0]) == list(arrays[1]) and equal and rest[0] == rest[1]


def test_they_are_called_as_stable_baselines3_does_and_change_nothing(whole, tmp_path):
    own = Calls()
    training = train(TINY, tmp_path, callbacks=[own, StopTrainingOnMaxEpisodes(10**6)])
    assert own.calls == ["training_start", *["rollout_start", *["step"] * 4, "rollout_end"] * 4, "training_end"]
    assert own.steps == list(range(24, 4 * ROLLOUT + 1, 24))
    first, last = (point.mean_return for point in training.curve)
    assert own.returns == [None, None, first, None, last]  # readable in the rollout after it, and at the end
    assert training.curve == whole[0].curve
    assert same_checkpoint(tmp_path, whole[1])
    assert train(TINY, callbacks=Calls()).curve == training.curve  # a single one, and in memory


def test_tensorboard_has_every_evaluation_and_update_at_its_step(whole):
    training, folder = whole
    logged = EventAccumulator(str(folder / "tensorboard" / "run_1"))
    logged.Reload()
    points = {name: [(each.step, each.value) for each in logged.Scalars(name)] for name in logged.Tags()["scalars"]}
    for name in ("mean_return", "final_task_error"):
        assert points[f"eval/{name}"] == [
            (point.timesteps, pytest.approx(getattr(point, name))) for point in training.curve
        ]
    for name in ("std", "loss", "value_loss", "entropy_loss", "learning_rate"):
        assert [step for step, _ in points[f"train/{name}"]][-1] == 4 * ROLLOUT


def test_false_ends_it_in_order_and_resumed_it_goes_on_as_if_nothing_had_happened(whole, tmp_path):
    own = Calls(at=ROLLOUT + 48, answer=False)
    training = train(TINY, tmp_path, callbacks=[own])
    assert training.finished
    assert [point.timesteps for point in training.curve] == [2 * ROLLOUT]  # the end of that rollout
    assert own.steps[-1] == ROLLOUT + 48
    assert own.calls[-2:] == ["step", "training_end"]
    assert LearnedPolicy.load(tmp_path / "last.npz").about["trained"] == 2 * ROLLOUT
    assert (tmp_path / "best.npz").exists()
    assert read_checkpoint(tmp_path / CHECKPOINT)["ended"] is True
    later = Calls()
    assert train(TINY, tmp_path, resume=True, callbacks=later).curve == whole[0].curve
    assert later.steps == list(range(2 * ROLLOUT + 24, 4 * ROLLOUT + 1, 24))
    assert same_checkpoint(tmp_path, whole[1])


def test_false_ends_sac_too(tmp_path):
    config = TrainingConfig("consensus_v0", "mixed_fleet", algorithm="sac", timesteps=960, num_envs=2, hidden=(8,))
    training = train(config, tmp_path, callbacks=Calls(at=48, answer=False))
    assert training.finished
    assert [point.timesteps for point in training.curve] == [48]


@pytest.mark.parametrize("where", ["_on_step", "_on_rollout_end"])
def test_ctrl_c_ends_callbacks_too(where, monkeypatch):
    """In a rollout and in an update."""
    own = Calls()

    def interrupt(self):
        if self.num_timesteps == (24 if where == "_on_step" else ROLLOUT):  # a second one would be a KeyboardInterrupt
            signal.raise_signal(signal.SIGINT)
        return True

    monkeypatch.setattr(Calls, where, interrupt)
    training = train(TINY, callbacks=[own])
    assert not training.finished
    assert training.curve == []
    assert own.calls[-1] == "training_end"


def test_an_exception_comes_through_and_nothing_is_lost(whole, tmp_path):
    own = Calls(at=3 * ROLLOUT + 24, error=RuntimeError("mine"))
    with pytest.raises(RuntimeError, match="mine"):
        train(TINY, tmp_path, callbacks=[own])
    assert LearnedPolicy.load(tmp_path / "last.npz").about["trained"] == 3 * ROLLOUT + 24
    assert LearnedPolicy.load(tmp_path / "best.npz").about["trained"] == 2 * ROLLOUT
    saved = read_checkpoint(tmp_path / CHECKPOINT)
    assert [point["timesteps"] for point in saved["curve"]] == [2 * ROLLOUT]
    assert train(TINY, tmp_path, resume=True).curve == whole[0].curve
    assert same_checkpoint(tmp_path, whole[1])


def test_what_is_no_callback_is_refused(tmp_path, monkeypatch):
    with pytest.raises(TypeError, match=r"BaseCallback; got <class '.*Calls'>; make an object, Calls\(\)"):
        train(TINY, tmp_path / "run", callbacks=[Calls])
    with pytest.raises(TypeError, match="BaseCallback; got 3"):
        train(TINY, tmp_path / "run", callbacks=[3])
    assert not (tmp_path / "run").exists()
    monkeypatch.chdir(tmp_path)
    (tmp_path / "my_callbacks.py").write_text(
        "from stable_baselines3.common.callbacks import StopTrainingOnMaxEpisodes\nfour = 4\n"
        "def limit():\n    return StopTrainingOnMaxEpisodes(4)\nthe_limit = limit()\ndef wrong():\n    return 1 / 0\n"
    )
    made, loaded = named_callbacks(["my_callbacks.py:limit", "my_callbacks.py:the_limit"])
    assert made.max_episodes == loaded.max_episodes == 4
    with pytest.raises(ValueError, match=r"'my_callbacks.py:four': expected a .* got int"):
        named_callbacks(["my_callbacks.py:four"])
    with pytest.raises(ValueError, match=r"wrong raised ZeroDivisionError: .*line 7, in wrong"):
        named_callbacks(["my_callbacks.py:wrong"])
