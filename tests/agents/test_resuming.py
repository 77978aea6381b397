"""Resuming: only in the same environment, locked against other trainings, and from files that execute no code."""

import contextlib
import copy
import dataclasses
import json
import os
import pickle
import signal
import subprocess
import sys
from pathlib import Path

import numpy as np
import pytest
import torch
from typer.testing import CliRunner

from agents.learning import LearnedPolicy, TrainingConfig
from agents.learning.archive import read_arrays, write_arrays
from agents.learning.checkpoint import CheckpointError, read_checkpoint, write_checkpoint
from agents.learning.run_folder import CHECKPOINT, alone_in
from agents.learning.training import _Run, train
from khop_env.cli import app
from khop_env.registry import scenario
from khop_env.scenarios.export import write_scenario
from tests.agents.training import SMALL

TINY = dataclasses.replace(SMALL, num_envs=4, timesteps=1500, evaluations=1)


@pytest.fixture(scope="module")
def tiny(tmp_path_factory):
    folder = tmp_path_factory.mktemp("tiny")
    return train(TINY, folder), folder


@pytest.fixture
def folder(tiny, tmp_path):
    """A copy that may be modified."""
    for name in (CHECKPOINT, "best.npz", "curve.csv", "config.json"):
        (tmp_path / name).write_bytes((tiny[1] / name).read_bytes())
    return tmp_path


@pytest.mark.parametrize("changes", [{}, {"algorithm": "sac", "batch_size": 64}], ids=["ppo", "sac"])
def test_a_finished_run_is_extended(tmp_path, changes):
    config = dataclasses.replace(TINY, **changes)
    first = train(config, tmp_path)
    trained = LearnedPolicy.load(tmp_path / "last.npz").about["trained"]
    longer = dataclasses.replace(config, timesteps=3 * config.timesteps)
    second = train(longer, tmp_path, resume=True)
    assert second.finished
    assert second.curve[: len(first.curve)] == first.curve
    assert second.curve[-1].timesteps >= 3 * config.timesteps > first.curve[-1].timesteps
    assert LearnedPolicy.load(tmp_path / "last.npz").about["trained"] > trained
    assert json.loads((tmp_path / "config.json").read_text())["timesteps"] == 3 * config.timesteps
    with pytest.raises(ValueError, match="timesteps = 4500 there and 1500 here; resume with the same"):
        train(config, tmp_path, resume=True)


def test_an_edited_scenario_is_refused(tmp_path):
    """The message lists the differences; parts that an environment doesn't use may be edited."""
    path, out = tmp_path / "edited.toml", tmp_path / "run"
    text = write_scenario(scenario("mixed_fleet").replace(name="edited"))
    path.write_text(text)
    config = dataclasses.replace(TINY, scenario=str(path))
    curve = train(config, out).curve
    path.write_text(text.replace("\nduration = ", "\nduration = 1", 1))
    assert train(config, out, resume=True).curve == curve
    rate = text.index("rate = ", text.index("[delta"))
    value = text[rate:].partition("\n")[0]
    path.write_text(text[:rate] + text[rate:].replace(value, "rate = 0.0625", 1))
    said = r"holds a run in another environment: scenario\.delta\.\w+.*rate is .* there and 0\.0625 here"
    with pytest.raises(ValueError, match=said):
        train(config, out, resume=True)
    path.write_text(text)
    whole = scenario(path)
    graph = whole.communication.copy()
    graph.add_edge(*next((0, j) for j in range(1, 12) if not graph.has_edge(0, j)))
    for changes, said in (
        ({"radius": 0.5 * whole.radius}, r"scenario\.radius\[0\] is .* there and .* here; .*; and \d+ more; resume"),
        ({"communication": graph}, r"scenario\.communication is \d+ values there and \d+ values here"),
        ({"disturbance": None}, r"scenario\.disturbance is \d values there and None here"),
    ):
        with pytest.raises(ValueError, match=said):
            train(dataclasses.replace(TINY, scenario=whole.replace(**changes)), out, resume=True)
    assert train(dataclasses.replace(TINY, scenario=whole), out, resume=True).curve == curve


def test_one_training_at_a_time(tmp_path):
    """Also between two processes; the lock of a killed process is released."""
    with alone_in(tmp_path), pytest.raises(FileExistsError, match=f"another training is running in {tmp_path}: wait"):
        train(TINY, tmp_path)
    code = "import sys, time; from pathlib import Path; from agents.learning.run_folder import alone_in\n"
    code += "with alone_in(Path(sys.argv[1])): print('locked', flush=True); time.sleep(600)"
    process = subprocess.Popen([sys.executable, "-c", code, str(tmp_path)], cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "locked\n"
    result = CliRunner().invoke(app, ["train", "consensus_v0", "--timesteps", "9", "--out", str(tmp_path)])
    assert result.exit_code == 2
    assert f"khop: another training is running in {tmp_path}" in result.stderr
    assert not (tmp_path / "config.json").exists()
    process.kill()
    process.communicate()
    with alone_in(tmp_path):
        pass


def test_what_is_there_is_not_overwritten(folder):
    (folder / CHECKPOINT).unlink()
    with pytest.raises(FileExistsError, match="holds a training run"):
        train(TINY, folder)


ROOT = Path(__file__).parents[2]


class Payload:
    """Code that a pickle executes when it is loaded."""

    def __reduce__(self):
        return os.mkdir, ("pickle-was-read",)


def test_resuming_reads_no_pickle(folder, monkeypatch):
    """Neither instead of the checkpoint, nor inside it; and checkpoints contain none."""
    whole = (folder / CHECKPOINT).read_bytes()
    monkeypatch.chdir(folder)
    (folder / CHECKPOINT).write_bytes(pickle.dumps(Payload()))
    with pytest.raises(CheckpointError, match=rf"{CHECKPOINT} isn't a checkpoint that khop train wrote"):
        train(TINY, folder, resume=True)
    (folder / CHECKPOINT).write_bytes(whole)
    arrays = read_arrays(folder / CHECKPOINT, 2**24)
    write_arrays(folder / CHECKPOINT, {**arrays, "1": np.array([Payload()])}, compress=False)
    with pytest.raises(CheckpointError, match=rf"{CHECKPOINT} isn't a checkpoint .*array of object"):
        train(TINY, folder, resume=True)
    assert not (folder / "pickle-was-read").exists()
    (folder / CHECKPOINT).write_bytes(whole)
    for module, name in ((pickle, "loads"), (pickle, "load"), (pickle, "Unpickler"), (torch, "load")):
        monkeypatch.setattr(module, name, lambda *_, **__: pytest.fail("a pickle was read"))
    longer = dataclasses.replace(TINY, timesteps=2000)
    assert train(longer, folder, resume=True).finished


def leaves(tree, path=()):
    """Paths to everything in a nest of mappings and sequences."""
    inner = tree.items() if isinstance(tree, dict) else enumerate(tree) if isinstance(tree, list | tuple) else ()
    for key, value in inner:
        yield (*path, key)
        yield from leaves(value, (*path, key))


def changed(tree, path, value):
    """The tree with another value, or without one for Ellipsis, at a place."""
    if not path:
        return value
    keys = dict(tree) if isinstance(tree, dict) else dict(enumerate(tree))
    if len(path) == 1 and value is ...:
        del keys[path[0]]
    else:
        keys[path[0]] = changed(keys[path[0]], path[1:], value)
    return keys if isinstance(tree, dict) else type(tree)(keys.values())


def test_crafted_checkpoints_are_refused(tiny, tmp_path):
    """Any changed value gives a CheckpointError, or a state that training continues from."""
    run, content = _Run(TINY, None, None, None, TINY), read_checkpoint(tiny[1] / CHECKPOINT)
    content = {key: content[key] for key in ("model", "environment", "rewards", "before", "curve", "seconds")}
    places = [path for path in leaves(content) if "python" not in path]  # 625 numbers of a generator
    values = [..., None, "text", -1, 10**40, 0.5, [], {}, np.zeros(3), np.array("text"), np.full((2, 2), np.nan)]
    rng, refused = np.random.default_rng(0), 0
    for number in range(200):
        path = places[rng.integers(len(places))]
        spoilt = changed(copy.deepcopy(content), path, values[rng.integers(len(values))])
        run.folder = tmp_path / str(number)
        try:
            run._restore(spoilt)
        except CheckpointError:
            refused += 1
    assert refused > 160
    write_checkpoint(tmp_path / CHECKPOINT, {"config": {}, "curve": []})
    with pytest.raises(CheckpointError, match="it has no settings"):
        train(TINY, tmp_path, resume=True)


UPDATES = """
import sys, threading, os, signal
from agents.learning import TrainingConfig
from agents.learning.training import train
config = TrainingConfig("consensus_v0", "mixed_fleet", num_envs=2, evaluations=1, **eval(sys.argv[2]))
print(train(config, sys.argv[1], on_progress=lambda part, found: print(part, flush=True)).finished)
"""


@pytest.mark.parametrize(
    "changes", [{"n_epochs": 10**7}, {"algorithm": "sac", "batch_size": 64}], ids=["in an update", "in an episode"]
)
def test_ctrl_c_in_an_update(tmp_path, changes):
    """An update that would take days ends at once, and the policy is kept."""
    command = [sys.executable, "-W", "ignore", "-c", UPDATES, str(tmp_path), repr(changes)]
    process = subprocess.Popen(command, cwd=ROOT, stdout=subprocess.PIPE, text=True)
    assert process.stdout.readline() == "0.0\n"
    with contextlib.suppress(subprocess.TimeoutExpired):
        process.wait(1.5)  # until it is well in it
    process.send_signal(signal.SIGINT)
    try:
        output, _ = process.communicate(timeout=60)
    finally:
        process.kill()
    assert output.endswith("False\n")
    assert LearnedPolicy.load(tmp_path).about["environment"] == "consensus_v0"


def test_ctrl_c_in_an_evaluation(monkeypatch):
    """It ends between two actions, and the evaluation doesn't count."""
    acts = []

    def act(self, observations):
        acts.append(self)
        signal.raise_signal(signal.SIGINT)
        return {agent: np.zeros((*seen.shape[:-1], 3)) for agent, seen in observations.items()}

    monkeypatch.setattr(LearnedPolicy, "act", act)
    training = train(TrainingConfig("consensus_v0", "mixed_fleet", timesteps=500, num_envs=2))
    assert not training.finished
    assert training.curve == []
    assert len(acts) == 1
