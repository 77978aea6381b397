"""Sweeps: all combinations, finished trainings aren't repeated, and one that fails doesn't stop the others."""

import dataclasses
import tomllib

import pytest

from agents.learning import LearnedPolicy, TrainingConfig
from agents.learning.run_folder import CHECKPOINT
from agents.learning.sweep import run_sweep
from agents.learning.sweep_file import Sweep
from agents.learning.training import train
from agents.workers import Interrupted
from tests.test_cli import khop, only_json, refused

TINY = {"timesteps": 128, "num_envs": 2, "n_steps": 4, "batch_size": 8, "evaluations": 1, "hidden": [8]}
SETTINGS = {"environment": "consensus_v0", **TINY, "arguments": {"max_cycles": 20}}
SWEEP = Sweep(SETTINGS, {"learning_rate": [1e-3, 1e-1]}, seeds=(0, 1))
FILE = 'environment = "consensus_v0"\nseeds = [0, 1]\n' + "".join(f"{name} = {value}\n" for name, value in TINY.items())
TABLES = "[arguments]\nmax_cycles = 20\n[grid]\nlearning_rate = [1e-3, 1e-1]\n"
OWN = """
import os, signal
from stable_baselines3.common.callbacks import BaseCallback
class Own(BaseCallback):
    def _on_step(self):
        if self.model.seed == 1 and self.model.lr_schedule(1.0) == 1e-3:
            return self.act()
        return True
class Fails(Own):
    def act(self):
        raise RuntimeError("no luck")
class Kills(Own):
    def act(self):
        os.kill(os.getpid(), signal.SIGKILL)
class Interrupts(Own):
    def act(self):
        signal.raise_signal(signal.SIGINT)
        return True
class Ends(Own):
    def act(self):
        return False
"""


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "grid.toml").write_text(FILE + TABLES)
    return tmp_path


@pytest.fixture(scope="module")
def own(tmp_path_factory):
    """A file of callbacks; modules are loaded once in a process."""
    path = tmp_path_factory.mktemp("own") / "sweep_callbacks.py"
    path.write_text(OWN)
    return path


def returns(result):
    return {name: run.curve for name, run in result.runs.items()}


@pytest.fixture(scope="module")
def whole(tmp_path_factory):
    """A whole sweep in this process."""
    folder = tmp_path_factory.mktemp("whole")
    return run_sweep(SWEEP, folder), folder


def test_all_combinations_have_settings_and_names_of_their_own():
    grid = {"hidden": [[8], [4, 4]], "arguments": {"network": ["ideal", "lossy:loss=0.3,burst=5"]}}
    runs = Sweep({"environment": "navigation_v0", "gamma": 0.5}, grid, (3, 1)).runs()
    assert [run.name for run in runs[:4]] == [
        "hidden_8-network_ideal-seed_3",
        "hidden_8-network_lossy_loss_0.3_burst_5-seed_3",
        "hidden_4+4-network_ideal-seed_3",
        "hidden_4+4-network_lossy_loss_0.3_burst_5-seed_3",
    ]
    expected = {"hidden": (4, 4), "gamma": 0.5, "seed": 1, "arguments": {"network": "ideal"}}
    assert runs[6].config == TrainingConfig.suited("navigation_v0", **expected)  # with what suits the environment
    assert len({run.name for run in runs}) == 8
    alike = Sweep(SETTINGS, {"initial": ["a b", "a_b"], "residual": ["tanh:gain=" + "1" * 200]}).runs()
    assert len({run.name for run in alike}) == 2
    assert max(len(run.name) for run in alike) < 200


def test_a_sweep_is_its_trainings(whole):
    result, folder = whole
    assert [run.status for run in result.runs.values()] == ["finished"] * 4
    name = "learning_rate_0.1-seed_1"
    config = TrainingConfig.suited(**SETTINGS, learning_rate=0.1, seed=1)
    assert list(result.runs[name].curve) == train(config).curve
    assert LearnedPolicy.load(folder / name).about["learning_rate"] == 0.1
    best = {name: run.best.mean_return for name, run in result.runs.items()}
    rows = result.summary()
    assert sorted(row["learning_rate"] for row in rows) == [1e-3, 1e-1]
    assert rows[0]["mean_return"] > rows[1]["mean_return"]
    for row in rows:
        both = [best[f"learning_rate_{row['learning_rate']}-seed_{seed}"] for seed in (0, 1)]
        assert row["mean_return"] == pytest.approx(sum(both) / 2)
        assert row["std_return"] == pytest.approx(abs(both[0] - both[1]) / 2**0.5)
        assert (row["lowest_return"], row["highest_return"]) == (min(both), max(both))
    lines = (folder / "runs.csv").read_text().splitlines()
    assert lines[0].startswith("learning_rate,seed,status,best_return,")
    assert len(lines) == 5
    assert (folder / "summary.csv").read_text().splitlines()[1].startswith(f"{rows[0]['learning_rate']!r},2,")


def test_the_command_and_its_resumption(folder, whole):
    """What is finished isn't repeated; with more timesteps all go on, and a longer list adds what is new."""
    found = only_json(khop("train", "--sweep", "grid.toml", "--set", "gamma=0.9", "--json"))
    assert found["folder"] == "runs/sweeps/grid"
    assert found["finished"] is True
    assert [run["status"] for run in found["runs"]] == ["finished"] * 4
    out = folder / "runs" / "sweeps" / "grid"
    said = refused("train", "--sweep", "grid.toml", "--set", "gamma=0.9")
    assert "holds 4 of these trainings; continue them with --resume, or choose another folder" in said
    assert "learning_rate_0.001-seed_0 holds a run with other settings: gamma = 0.9 there and" in refused(
        "train", "--sweep", "grid.toml", "--resume"
    )
    before = {path: path.stat().st_mtime_ns for path in out.glob(f"*/{CHECKPOINT}")}
    (folder / "grid.toml").write_text(FILE.replace("[0, 1]", "[0, 1, 2]") + TABLES.replace("[1e-3, 1e-1]", "[1e-3]"))
    result = khop("train", "--sweep", "grid.toml", "--set", "gamma=0.9", "--resume")
    assert "3 of 3 learning_rate_0.001-seed_2: return " in result.stderr
    assert "1 of 3" not in result.stderr
    assert "3 of 3" in result.stdout
    assert max(map(len, result.stdout.partition("play the best")[0].splitlines())) <= 80
    assert "play the best: khop evaluate consensus_v0 --env max_cycles=20 --policies ppo:runs/sweeps/grid/" in (
        result.stdout
    )
    assert {path: path.stat().st_mtime_ns for path in before} == before
    longer = ("train", "--sweep", "grid.toml", "--set", "gamma=0.9", "--resume", "--timesteps", "192", "--json")
    found = only_json(khop(*longer))
    assert [run["last_timesteps"] for run in found["runs"]] == [192] * 3
    values = tomllib.loads((out / "learning_rate_0.001-seed_0" / "config.toml").read_text())
    assert values["timesteps"] == 192


def test_one_that_fails_does_not_stop_the_others(folder, whole, own):
    command = ("train", "--sweep", "grid.toml", "--out", "out")
    result = khop(*command, "--callback", f"{own}:Fails", "--json", status=2)
    assert "1 of 4 trainings failed; --resume tries them again:\n  learning_rate_0.001-seed_1: " in result.stderr
    assert "RuntimeError: no luck" in result.stderr
    assert "sweep_callbacks.py, line 11, in act" in result.stderr
    found = only_json(result)
    assert [run["status"] for run in found["runs"]] == ["finished", "finished", "failed", "finished"]
    assert {row["learning_rate"]: row["seeds"] for row in found["summary"]} == {1e-3: 1, 1e-1: 2}
    again = only_json(khop(*command, "--resume", "--json"))
    assert {run["folder"]: run["best_return"] for run in again["runs"]} == {
        name: run.best.mean_return for name, run in whole[0].runs.items()
    }


def test_ctrl_c_keeps_what_is_finished_and_resume_goes_on(folder, whole, own):
    out = folder / "out"
    with pytest.raises(Interrupted) as caught:
        run_sweep(SWEEP, out, callbacks=[f"{own}:Interrupts"])
    states = [run.status for run in caught.value.partial.runs.values()]
    assert states == ["finished", "finished", "interrupted", "not begun"]
    assert (out / "runs.csv").read_text().count("finished") == 2
    assert (out / "learning_rate_0.001-seed_1" / CHECKPOINT).exists()
    begun = []
    result = run_sweep(SWEEP, out, resume=True, on_run=lambda run, *_: begun.append(run.folder.name))
    assert begun == ["learning_rate_0.001-seed_1", "learning_rate_0.1-seed_1"]
    assert returns(result) == returns(whole[0])


def test_what_a_callback_ended_is_not_repeated(folder, own):
    sweep = dataclasses.replace(SWEEP, seeds=(1,))
    result = run_sweep(sweep, folder / "out", callbacks=[f"{own}:Ends"])
    assert [run.curve[-1].timesteps for run in result.runs.values()] == [64, 128]
    assert [run.status for run in result.runs.values()] == ["finished"] * 2
    again = run_sweep(sweep, folder / "out", resume=True)
    assert returns(again) == returns(result)
    longer = dataclasses.replace(sweep, settings={**SETTINGS, "timesteps": 192})
    extended = run_sweep(longer, folder / "out", resume=True)
    assert [run.curve[-1].timesteps for run in extended.runs.values()] == [192] * 2


def test_in_processes_one_of_which_is_killed(folder, whole, own):
    """Its training fails, the others give what they give in one process."""
    result = run_sweep(SWEEP, folder / "out", workers=2, callbacks=[f"{own}:Kills"])
    lost = result.runs["learning_rate_0.001-seed_1"]
    assert lost.status == "failed"
    assert "a worker process was killed by SIGKILL" in lost.error
    assert [run.status for run in result.runs.values()].count("finished") == 3
    assert returns(run_sweep(SWEEP, folder / "out", resume=True)) == returns(whole[0])


@pytest.mark.parametrize(
    ("text", "said"),
    [
        ("", "grid: name at least one setting with a list of values"),
        ("[grid]\nlearning_rat = [1]", "grid: no 'learning_rat'; did you mean 'learning_rate'?"),
        ("[grid]\ngamma = [0.9, 'high']", "grid: gamma: expected a number; got 'high' in the list"),
        ("[grid]\ngamma = [0.9, 2.0]", "grid: gamma = 2.0: gamma must be from 0 to 1; got 2.0"),
        ("[grid]\ngamma = []", "grid: gamma: the list is empty; name at least one value"),
        ("[grid]\ngamma = 0.9", "grid: gamma: expected a list of values to try, [0.9, ...]; got 0.9"),
        ("[grid]\ngamma = [1, 1.0]", "grid: gamma: 1.0 is there twice"),
        ("[grid]\nnum_envs = [4]", "grid: num_envs: it is set for all trainings, too, num_envs = 2; choose one"),
        ("[grid]\nseed = [1]", "seed: a sweep takes all its seeds in one list, seeds = [0, 1, 2]"),
        ("[grid]\nenvironment = ['formation_v0']", "grid: environment: it is set for all trainings, too"),
        ("[grid.arguments]\nrewrad = ['team']", "grid.arguments: no 'rewrad'; did you mean 'reward'?"),
        ("[grid.arguments]\nreward = ['tame']", "grid.arguments: reward: expected"),
        ("[grid.arguments]\nnetwork = ['ideal', 'wfi']", "grid: network = wfi: no network 'wfi'; did you mean 'wifi'?"),
        ("[arguments]\nrewrad = 1\n[grid]\ngamma = [1]", "grid.toml: arguments: no 'rewrad'; did you mean 'reward'?"),
        ("seeds = []\n[grid]\ngamma = [1]", "seeds: the list is empty"),
        ("seeds = [-1]\n[grid]\ngamma = [1]", "seed must be a non-negative integer; got -1"),
        ("gama = 1\n[grid]\ngamma = [1]", "grid.toml: no 'gama'; did you mean 'gamma'?"),
    ],
)
def test_mistakes_are_refused_before_anything_is_trained(text, said, folder):
    base = FILE.replace("seeds = [0, 1]\n", "" if "seeds" in text else "seeds = [0]\n")
    (folder / "grid.toml").write_text(base + text)
    assert said in refused("train", "--sweep", "grid.toml")
    assert not (folder / "runs").exists()


def test_options_that_do_not_go_with_a_sweep(folder):
    assert "--sweep and --config: choose one of them" in refused(
        "train", "--sweep", "grid.toml", "--config", "grid.toml"
    )
    assert "seed: a sweep takes all its seeds in one list" in refused("train", "--sweep", "grid.toml", "--seed", "1")
    assert "learning_rate: it is set for all trainings, too" in refused(
        "train", "--sweep", "grid.toml", "--set", "learning_rate=1"
    )
    assert "--workers and --ray are for sweeps" in refused("train", "consensus_v0", "--workers", "2")
    assert "nothing to resume: " in refused("train", "--sweep", "grid.toml", "--resume")
    assert not (folder / "runs").exists()
