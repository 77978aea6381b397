"""`khop train`: settings from options, --set and a file, and its JSON."""

import json
import tomllib

import pytest
from test_cli import khop, only_json, refused

from agents import play
from agents.learning import LearnedPolicy, TrainingConfig
from agents.learning.curve import EVALUATION_SEEDS
from agents.learning.training import train
from khop_env.registry import make_batched, scenario

TINY = {"timesteps": 64, "num_envs": 2, "n_steps": 4, "batch_size": 8, "evaluations": 1, "hidden": [8]}
FILE = "".join(f"{name} = {value}\n" for name, value in TINY.items())


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    (tmp_path / "tiny.toml").write_text(FILE)
    return tmp_path


def test_options_win_over_set_and_set_over_the_file(folder):
    (folder / "mine.toml").write_text(FILE + 'environment = "formation_v0"\nseed = 1\ngamma = 0.5\nclip_range = 0.3\n')
    options = ("--set", "seed=2", "--set", "gamma=0.6", "--set", "hidden=4+4", "--seed", "3", "--bounds")
    found = only_json(khop("train", "--config", "mine.toml", *options, "--json"))
    config = found["config"]
    assert (config["environment"], config["clip_range"]) == ("formation_v0", 0.3)
    assert (config["gamma"], config["hidden"]) == (0.6, [4, 4])
    assert (config["seed"], config["bounds"]) == (3, True)
    assert config["learning_rate"] == TrainingConfig("consensus_v0").learning_rate
    assert found["folder"] == "runs/train/formation_v0-estimate-bounds-ppo-3"


def test_the_file_that_a_run_writes_repeats_it(folder):
    (folder / "mine.toml").write_text(khop("export", "paper").stdout)
    options = ("--config", "tiny.toml", "--env", "control_period=0.1", "--env", "reward=team", "--env", "dt=none")
    first = only_json(khop("train", "consensus_v0", "--scenario", "mine.toml", *options, "--out", "a", "--json"))
    text = (folder / "a" / "config.toml").read_text()
    assert "# copies of the environment, each of N agents.\nnum_envs = 2\n" in text
    assert "in its unit" in text  # of the task error
    values = tomllib.loads(text)
    assert {name for name, value in first["config"].items() if value is not None} == set(values)
    assert values["scenario"] == "mine.toml"
    assert values["arguments"] == {"control_period": 0.1, "reward": "team"}
    again = only_json(khop("train", "--config", "a/config.toml", "--out", "b", "--json"))
    assert again["curve"] == first["curve"]
    assert again["config"]["arguments"]["control_period"] == 0.1


def test_json(folder):
    found = only_json(khop("train", "consensus_v0", "--config", "tiny.toml", "--out", "out", "--json"))
    assert list(found) == [
        *("config", "curve", "best_return", "task_error_unit", "finished", "seconds", "folder", "files")
    ]
    assert found["best_return"] == max(point["mean_return"] for point in found["curve"])
    assert found["finished"] is True
    assert found["files"]["best"] == "out/best.npz"
    assert all((folder / path).exists() for path in found["files"].values())


def test_what_it_prints_fits_80_columns(folder):
    result = khop("train", "consensus_v0", "--config", "tiny.toml", "--out", "out")
    assert max(map(len, (*result.stdout.splitlines(), *result.stderr.splitlines()))) <= 80
    assert "task error" in result.stderr
    assert result.stdout.splitlines()[-1] == "play it: khop evaluate consensus_v0 --policies ppo:out"


def test_arguments_reach_checks_and_runs(folder):
    """A policy that was trained at another period is refused by default, and `run` plays it at its own."""
    options = ("--config", "tiny.toml", "--env", "control_period=0.1", "--out", "out")
    assert "--env control_period=0.1 --policies ppo:out" in khop("train", "consensus_v0", *options).stdout
    assert LearnedPolicy.load(folder / "out").about["arguments"] == {"control_period": 0.1}
    said = refused("evaluate", "consensus_v0", "--policies", "ppo:out", "--episodes", "1")
    assert "it was trained with a control period of 0.1 s; this environment has 0.05 s" in said
    arguments = ("--policies", "ppo:out", "--episodes", "1", "--observe", "estimate", "--env", "control_period=0.1")
    played = only_json(khop("evaluate", "consensus_v0", *arguments, "--json"))
    for name in ("consensus_v0", "paper"):
        found = only_json(khop("run", name, "--controller", "ppo:out", "--duration", "20", "--json"))
        assert found["dt"] == 0.1
        assert found["return"] == pytest.approx(played["rows"][0]["mean_return"], rel=1e-4)
    said = refused("train", "consensus_v0", "--config", "tiny.toml", "--out", "out", "--resume")
    assert "arguments = {'control_period': 0.1} there and {} here; resume with the same" in said


def test_a_run_without_arguments_is_resumed_by_old_checkpoints(folder, monkeypatch):
    """Those that were written before there were arguments."""
    as_dict = TrainingConfig.as_dict

    def old(self):
        return {name: value for name, value in as_dict(self).items() if name != "arguments"}

    config = TrainingConfig("consensus_v0", **{**TINY, "hidden": (8,)})
    with monkeypatch.context() as patch:
        patch.setattr("agents.learning.training.write_config", lambda *_: "")
        patch.setattr(TrainingConfig, "as_dict", old)
        first = train(config, folder / "old")
    assert train(config, folder / "old", resume=True).curve == first.curve


def test_a_python_scenario(folder):
    """Its settings name it, and say that it is an object."""
    config = TrainingConfig("consensus_v0", scenario("paper").replace(name="mine"), **{**TINY, "hidden": (8,)})
    train(config, folder / "out")
    text = (folder / "out" / "config.toml").read_text()
    assert 'It was a Python object of this name: write here where it is found.)\nscenario = "mine"' in text
    assert json.loads((folder / "out" / "config.json").read_text())["scenario"] == "mine"


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        ((), "name an environment to train for, khop train ENV, or a --config file that names it"),
        (("consensus_v0", "--set", "learning_rat=1"), "no argument 'learning_rat'; did you mean 'learning_rate'?"),
        (("consensus_v0", "--set", "learning_rate=fast"), "--set learning_rate: expected a number; got 'fast'"),
        (("consensus_v0", "--set", "learning_rate=-1"), "learning_rate must be positive and finite; got -1.0"),
        (
            ("consensus_v0", "--set", "algorithm=sca"),
            "--set algorithm: expected 'ppo' or 'sac'; got 'sca'; did you mean",
        ),
        (("consensus_v0", "--set", "arguments={}"), "no argument 'arguments'; known: "),
        (("consensus_v0", "--env", "bounds=true"), "--env bounds: this command sets it by --bounds"),
        (("consensus_v0", "--config", "nowhere.toml"), "No such file or directory: 'nowhere.toml'"),
        (("consensus_v0", "--config", "broken.toml"), "broken.toml isn't a TOML file: "),
        (("consensus_v0", "--config", "unknown.toml"), "unknown.toml: no 'gama'; did you mean 'gamma'?"),
        (("consensus_v0", "--config", "wrong.toml"), "wrong.toml: gamma: expected a number; got 'high'"),
        (
            ("consensus_v0", "--config", "argument.toml"),
            "argument.toml: arguments: no 'rewrad'; did you mean 'reward'?",
        ),
    ],
)
def test_mistakes(arguments, said, folder):
    files = {"broken": "a = [", "unknown": "gama = 1", "wrong": 'gamma = "high"', "argument": "[arguments]\nrewrad = 1"}
    for name, text in files.items():
        (folder / f"{name}.toml").write_text(text)
    assert said in refused("train", *arguments)
    assert not (folder / "runs").exists()


def test_sac_has_settings_of_its_own(folder):
    found = only_json(khop("train", "consensus_v0", "--config", "tiny.toml", "--set", "algorithm=sac", "--json"))
    assert (found["config"]["learning_rate"], found["config"]["batch_size"]) == (1e-3, 8)
    assert found["folder"] == "runs/train/consensus_v0-estimate-sac-0"


def test_on_top_of_a_script(folder):
    """Its policy is played by every command; untrained it does what the script does."""
    command = ("train", "consensus_v0", "--config", "tiny.toml", "--residual", "tanh:gain=3", "--json")
    found = only_json(khop(*command, "--set", "learning_rate=1e-9"))
    assert found["folder"] == "runs/train/consensus_v0-estimate-residual-tanh_gain_3-ppo-0"
    assert 'residual = "tanh:gain=3"' in (folder / found["folder"] / "config.toml").read_text()
    assert found["curve"][0]["timesteps"] == 0
    policies = f"ppo:{found['folder']},tanh:gain=3,zero"
    played = only_json(khop("evaluate", "consensus_v0", "--policies", policies, "--episodes", "2", "--json"))
    ours, script, zero = (row["mean_return"] for row in played["rows"] if row["observe"] == "estimate")
    assert ours == pytest.approx(script, rel=1e-3)
    assert abs(zero) > 2.0 * abs(script)
    filmed = only_json(khop("run", "paper", "--controller", f"ppo:{found['folder']}", "--duration", "1", "--json"))
    assert filmed["return"] < 0.0
    assert "no scripted policy 'tahn' to learn on top of; did you mean 'tanh'?" in refused(
        "train", "consensus_v0", "--residual", "tahn"
    )
    assert "keep_right" in refused("train", "consensus_v0", "--residual", "keep_right")


def test_an_argument_that_is_a_setting_is_refused():
    with pytest.raises(ValueError, match="arguments: 'bounds' is a setting of its own, bounds=True"):
        TrainingConfig("consensus_v0", arguments={"bounds": True})
    assert hash(TrainingConfig("consensus_v0")) == hash(TrainingConfig("consensus_v0"))


CALLBACK = """
from stable_baselines3.common.callbacks import BaseCallback
class Stop(BaseCallback):
    def _on_step(self):
        print("called at", self.num_timesteps)
        return False
"""


def test_a_callback_ends_a_training(folder):
    (folder / "my_stop.py").write_text(CALLBACK)
    command = ("train", "consensus_v0", "--config", "tiny.toml", "--out", "out", "--timesteps", "128")
    found = khop(*command, "--callback", "my_stop.py:Stop").stdout
    assert "called at 16\nended by a callback at 64 of 128 agent-steps; --resume goes on" in found
    assert only_json(khop(*command, "--resume", "--json"))["curve"][-1]["timesteps"] == 128
    assert "my_stop.py has no 'Stp'; it has BaseCallback, Stop" in refused(*command, "--callback", "my_stop.py:Stp")


def test_evaluations_over_another_network(folder):
    command = ("train", "consensus_v0", "--config", "tiny.toml", "--network", "ideal")
    lossy = "lossy:loss=0.5,burst=5"
    found = only_json(khop(*command, "--evaluate-network", lossy, "--json"))
    assert found["folder"] == "runs/train/consensus_v0-estimate-evaluated-lossy_loss_0.5_burst_5-ppo-0"
    assert found["config"]["arguments"]["network"] == "ideal"
    config = (folder / found["folder"] / "config.toml").read_text()
    assert f'evaluate_network = "{lossy}"' in config
    batched, policy = make_batched("consensus_v0", num_envs=32, network=lossy), LearnedPolicy.load(found["folder"])
    assert found["best_return"] == play(batched, policy, EVALUATION_SEEDS).returns.mean()
    plain = only_json(khop(*command, "--out", "out", "--json"))
    assert plain["best_return"] != found["best_return"]
    layers = [LearnedPolicy.load(each["folder"]).networks for each in (plain, found)]  # it learns the same
    assert repr(layers[0]) == repr(layers[1])
    shown = khop(*command, "--evaluate-network", lossy, "--out", "again").stdout
    assert f"play it: khop evaluate consensus_v0 --network {lossy} --policies ppo:again" in shown.replace("\n", " ")
    assert "evaluate_network = None there and 'wifi' here" in refused(
        *command, "--evaluate-network", "wifi", "--out", "out", "--resume"
    )


@pytest.mark.parametrize(
    ("arguments", "said"),
    [
        (("--evaluate-network", "wfi"), "evaluate_network: no network 'wfi'; did you mean 'wifi'?"),
        (("--evaluate-network", "wifi"), "evaluate_network 'wifi': its observations also have "),
        (("--network", "wifi", "--evaluate-network", "none"), "evaluate_network 'none': its observations lack "),
    ],
)
def test_evaluations_that_cannot_be_played_are_refused(arguments, said, folder):
    assert said in refused("train", "consensus_v0", "--config", "tiny.toml", *arguments)
    assert not (folder / "runs").exists()
