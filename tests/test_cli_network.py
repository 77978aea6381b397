"""`khop network`, and --network of the other commands, as their users call them."""

import json
import sys
from pathlib import Path

import polars as pl
import pytest
from test_cli import khop, only_json, refused

pytestmark = pytest.mark.usefixtures("without_figures")

KEYS = [
    *("network", "estimator", "period", "loss", "mean_error", "max_error", "mean_bound", "bound_to_limit"),
    *("violations", "pair_steps", "messages_per_s", "bytes_per_message"),
]
SHORT = ("--episodes", "2", "--duration", "0.4")


@pytest.fixture
def folder(tmp_path, monkeypatch):
    monkeypatch.chdir(tmp_path)
    return tmp_path


class TestNetwork:
    def test_json(self):
        options = "--networks", "ideal,wifi,lossy:loss=0.3,burst=5", "--periods", "0.05,0.1"
        found = only_json(khop("network", "paper", *options, *SHORT, "--json"))
        assert list(found) == ["scenario", "rows", "continuous"]
        assert found["scenario"] == "paper"
        assert [(row["network"], row["estimator"], row["period"]) for row in found["rows"]] == [
            (network, estimator, period)
            for network in ("ideal", "wifi", "lossy:loss=0.3,burst=5")
            for estimator in ("ppso", "relay")
            for period in (0.05, 0.1)
        ]
        for row in found["rows"]:
            assert list(row) == KEYS
            assert row["violations"] == 0
            assert row["mean_error"] <= row["max_error"]
            assert row["messages_per_s"] == 1.0 / row["period"]
        assert [row["loss"] for row in found["rows"][::4]] == [0.0, 0.01, 0.3]
        assert found["continuous"]["network"] == "continuous"

    def test_the_table_says_why_not_just_pass_states_on(self):
        found = khop("network", "paper", "--networks", "wifi", *SHORT).stdout
        assert max(map(len, found.splitlines())) <= 80
        text = " ".join(found.split())
        assert "paper under tanh on estimates, 2 episodes, the same for every row" in text
        assert (
            "why not just pass states on? At the same message rate the mean error of the paper's observers (ppso) is"
            in text
        )
        assert "errors above their certified bounds, start included: 0 of" in text
        assert "continuous exchange, without messages: error" in text

    def test_without_certificates_it_says_why_and_nothing_of_bounds(self):
        own = str(Path(__file__).parents[1] / "examples" / "04_your_own_agent.py")
        found = khop("network", f"{own}:scenario", "--networks", "wifi", *SHORT).stdout
        text = " ".join(found.split())
        assert found.count("not certified ") >= 2
        assert "pendulum: not certified: Pendulum.drift_growth() gives no bound" in text
        assert "unknown" not in text
        assert "errors above their certified bounds" not in text
        assert "over limit" not in text

    def test_a_schedule_has_no_limit_and_leaves_agents_cut_off_without_a_bound(self, folder):
        text = khop("export", "paper").stdout
        outage = '\n[[schedule]]\nkind = "outage"\nstart = 0.1\nduration = 9.0\nagent = 2\n'
        (folder / "outage.toml").write_text(text + outage)
        found = khop("network", "outage.toml", "--networks", "wifi", *SHORT).stdout
        text = " ".join(found.split())
        assert "no mean bound, since some agents are cut off at times by links that are down" in text
        assert "over limit" not in text
        assert "bound m" not in text
        assert "errors above their certified bounds, start included: 0 of" in text

    def test_one_estimator_has_nothing_to_be_compared_with(self):
        found = khop("network", "paper", "--networks", "wifi", "--estimators", "relay", *SHORT)
        assert "why not" not in found.stdout

    def test_profiles_are_the_default(self):
        found = only_json(khop("network", "paper", "--estimators", "relay", *SHORT, "--json"))
        profiles = [row["network"] for row in found["rows"]]
        assert profiles[:4] == ["ideal", "urllc", "factory", "wifi"]
        assert "random" not in profiles  # its rows would be means over unlike networks

    def test_a_figure_is_measured_besides(self, folder):
        options = "--networks", "wifi", "--estimators", "relay", "--episodes", "1", "--duration", "0.1"
        found = khop("network", "paper", *options, "--figure", "new/network.png", "--json")
        assert "figure: new/network.png" in found.stderr
        assert (folder / "new" / "network.png").stat().st_size > 20_000
        result = json.loads(found.stdout)
        assert len(result["rows"]) == 1
        assert len(result["swept"]) == 12
        assert {row["loss"] for row in result["swept"][:6]} == {0.01}

    def test_an_interrupt_loses_no_row(self, monkeypatch):
        from khop_env.results import networks

        measured, whole = [], networks._measured

        def interrupted(*arguments):
            if len(measured) == 2:
                raise KeyboardInterrupt
            measured.append(whole(*arguments))
            return measured[-1]

        monkeypatch.setattr(networks, "_measured", interrupted)
        found = khop("network", "paper", "--networks", "wifi", *SHORT, "--json", status=130)
        assert len(json.loads(found.stdout)["rows"]) == 1
        assert "khop: interrupted; above are the rows that were measured until then" in found.stderr

    def test_an_error_above_its_bound_is_the_exit_status(self, monkeypatch):
        from khop_env.results import networks

        monkeypatch.setattr(networks, "violations", lambda *_: 1)
        found = khop("network", "paper", "--networks", "wifi", "--estimators", "relay", *SHORT, status=1)
        assert "wifi, relay: 40 of 3200" in found.stdout

    @pytest.mark.parametrize(
        ("options", "said"),
        [
            (("--networks", "wify"), "no network 'wify'; did you mean 'wifi'?"),
            (("--networks", "loss=0.3"), "--networks 'loss=0.3': no network before 'loss=0.3'; write NAME:loss=0.3"),
            (("--networks", "wifi,wifi"), "--networks names 'wifi' twice"),
            (("--networks", "wifi,lossy:loss=30"), "Network.loss must be from 0 to 1 (30 % are 0.3)"),
            (("--estimators", "rely"), "no estimator 'rely'; did you mean 'relay'?"),
            (("--periods", "0.1,fast"), "--periods must be numbers in s, separated by commas, like 0.01,0.05; got"),
            (("--periods", "0"), "Network.period must be positive and finite, in s; got 0.0"),
            (("--figure", "errors.txt"), "--figure errors.txt: a figure's name ends in .png, .pdf or .svg"),
        ],
    )
    def test_mistakes(self, options, said):
        assert said in refused("network", "paper", *options)


class TestRun:
    def test_a_scenario_over_a_network(self, folder):
        options = "--network", "wifi", "--duration", "0.5", "--seed", "3"
        result = khop("run", "paper", *options, "--estimator", "relay")
        out = folder / "runs" / "paper-tanh-estimate-wifi-relay-seed3"
        summary = json.loads((out / "summary.json").read_text())
        assert (summary["network"], summary["estimator"]) == (
            "a message every 50 ms, 1 % lost, 10 +- 1 ms late",
            "relay",
        )
        assert summary["configuration"]["network"]["latency"] == 0.01
        assert summary["configuration"]["estimator"] == "relay"
        assert summary["violations"] == 0
        text = " ".join(result.stdout.split())
        assert "network: a message every 50 ms, 1 % lost, 10 +- 1 ms late; states that agents know are" in text
        assert "certified bounds kept: largest |error| / certified bound" in text
        assert "guarantee" not in text
        table = pl.read_parquet(out / "estimates.parquet")
        assert (table["error"].abs() <= table["bound"]).all()
        khop("run", "paper", *options)
        assert (folder / "runs" / "paper-tanh-estimate-wifi-seed3").exists()

    def test_the_scenarios_own_network_is_the_default(self, folder):
        text = khop("export", "paper").stdout
        (folder / "own.toml").write_text(text + '\n[network]\nprofile = "espnow"\nestimator = "relay"\n')
        found = only_json(khop("run", "own.toml", "--duration", "0.2", "--json"))
        assert (found["network"], found["estimator"]) == ("a message every 50 ms, 8 % lost, 40 ms late", "relay")
        found = only_json(khop("run", "own.toml", "--duration", "0.2", "--json", "--network", "ideal"))
        assert found["network"] == "a message every 50 ms, none lost"
        played = only_json(khop("run", "consensus_v0", "--scenario", "own.toml", "--duration", "0.2", "--json"))
        assert played["estimator"] == "relay"
        assert only_json(khop("check", "own.toml", "--json"))["network"]["estimator"] == "relay"

    def test_an_environment_over_a_network(self, folder):
        found = only_json(
            khop("run", "consensus_v0", "--network", "wifi", "--estimator", "relay", "--duration", "0.5", "--json")
        )
        assert found["network"] == "a message every 50 ms, 1 % lost, 10 +- 1 ms late"
        assert found["configuration"]["settings"]["network"]["loss"] == 0.01
        assert "wifi-relay" in found["files"]["summary"]

    @pytest.mark.parametrize(
        ("arguments", "said"),
        [
            (
                ("paper", "--estimator", "relay"),
                "--estimator relay: estimates are made from messages, and there is no network",
            ),
            (("paper", "--network", "wify"), "no network 'wify'; did you mean 'wifi'?"),
            (("paper", "--network", "wifi", "--order", "2"), "--order: over a network estimates follow from rounds of"),
            (("paper", "--network", "wifi", "--integrator", "explicit"), "--integrator: over a network estimates"),
            (
                ("consensus_v0", "--network", "wifi", "--env", "network=lossy"),
                "--env network and --network: choose one of them",
            ),
            (("consensus_v0", "--estimator", "relay"), "there is no network"),
        ],
    )
    def test_mistakes(self, folder, arguments, said):
        assert said in refused("run", *arguments)
        assert not list(folder.iterdir())


def test_check_has_bounds_by_distance():
    found = khop("check", "paper", "--network", "wifi", "--estimator", "relay").stdout
    assert max(map(len, found.splitlines())) <= 80
    assert "network: a message every 50 ms, 1 % lost, 10 +- 1 ms late; estimator relay" in found
    assert "drifter: certified" in found
    assert [line.split() for line in found.splitlines() if line.startswith("x1 of drifter  1")] == [
        ["x1", "of", "drifter", "1", "75.51", "ms", "0.494", "m", "known", "exactly"]
    ]
    report = only_json(khop("check", "paper", "--network", "wifi", "--json"))
    assert [row["hops"] for row in report["network"]["bounds"]] == [1, 2, 3]
    assert "network" not in only_json(khop("check", "paper", "--json"))


def test_evaluate_over_a_network():
    options = "--policies", "tanh", "--observe", "estimate", "--episodes", "2", "--env", "max_cycles=20"
    found = {
        network: only_json(khop("evaluate", "consensus_v0", *options, *network, "--json"))["rows"][0]["mean_return"]
        for network in ((), ("--network", "wifi", "--estimator", "relay"), ("--env", "network=wifi"))
    }
    assert len(set(found.values())) == 3
    text = khop("evaluate", "consensus_v0", *options, "--network", "lossy:loss=0.3", "--estimator", "relay").stdout
    text = " ".join(text.split())
    over = "(a message every 50 ms, 30 % lost, 30 +- 5 ms late), estimator relay, 2 episodes"
    assert f"consensus_v0 on paper over a network {over}" in text
    assert "its certified bound (at most 1 by guarantee; close to 1 is normal over a network: an agent" in text
    assert "below 1 by guarantee" not in text
    assert "|xi|" not in text  # relay has no disagreements
    assert "|e|" not in text
    text = " ".join(khop("evaluate", "consensus_v0", *options, "--network", "wifi").stdout.split())
    assert "|e|: largest |xi| / rho of what agents hold" in text
    found = only_json(khop("evaluate", "consensus_v0", *options, "--network", "wifi", "--estimator", "relay", "--json"))
    assert (found["network"], found["estimator"]) == ("a message every 50 ms, 1 % lost, 10 +- 1 ms late", "relay")
    assert found["rows"][0]["max_normalized_disagreement"] is None
    assert "of all observers, below 1 by guarantee" in " ".join(
        khop("evaluate", "consensus_v0", *options).stdout.split()
    )


def test_train_over_a_network(folder):
    pytest.importorskip("stable_baselines3")
    options = "--network", "lossy:loss=0.3", "--estimator", "relay"
    result = khop("train", "consensus_v0", *options, "--timesteps", "2000", "--set", "evaluations=1", "--out", "mine")
    assert "play it: khop evaluate consensus_v0 --network lossy:loss=0.3 --estimator relay --policies ppo:mine" in (
        " ".join(result.stdout.split())
    )
    progress = result.stderr
    assert "agent-steps: return" in progress
    assert "|e|" not in progress  # of an estimator without funnels
    config = Path("mine/config.toml").read_text()
    assert "lossy" in config or "0.3" in config
    played = only_json(
        khop(
            "evaluate",
            "consensus_v0",
            *options,
            "--policies",
            "ppo:mine",
            "--observe",
            "estimate",
            "--episodes",
            "1",
            "--json",
        )
    )
    assert len(played["rows"]) == 1


OWN = """
from khop_env.observers import Relay

class Mine(Relay):
    name = "mine"

made = Mine()
number = 3

class Broken(Relay):
    def __init__(self):
        raise RuntimeError("no antenna")
"""


class TestOwnEstimator:
    @pytest.fixture(autouse=True)
    def own(self, folder, monkeypatch):
        monkeypatch.delitem(sys.modules, "own_estimator", raising=False)  # of the test before
        (folder / "own_estimator.py").write_text(OWN)

    @pytest.mark.parametrize("name", ["own_estimator.py:Mine", "own_estimator:made"])
    def test_it_stands_wherever_a_name_goes(self, name):
        over = "--network", "wifi", "--estimator", name
        for command in (("run", "paper"), ("run", "consensus_v0")):
            found = only_json(khop(*command, *over, "--duration", "0.2", "--json"))
            assert (found["estimator"], found["violations"]) == ("mine", 0)
            assert "wifi-mine" in found["files"]["summary"]
            assert found["configuration"]["estimator_content"]  # another file of this name is another run
        assert only_json(khop("check", "paper", *over, "--json"))["network"]["estimator"] == "mine"
        played = "evaluate", "consensus_v0", "--policies", "zero", "--observe", "estimate", "--episodes", "2", "--json"
        short = "--env", "max_cycles=4"
        assert only_json(khop(*played, *short, *over))["estimator"] == "mine"
        by_env = "--network", "wifi", "--env", f"estimator={name}"
        assert only_json(khop(*played, *short, *by_env))["estimator"] == "mine"

    def test_in_a_list(self):
        options = "--networks", "wifi", "--estimators", "relay,own_estimator.py:Mine"
        rows = only_json(khop("network", "paper", *options, *SHORT, "--json"))["rows"]
        assert [row["estimator"] for row in rows] == ["relay", "mine"]
        assert rows[0]["mean_error"] == rows[1]["mean_error"]

    @pytest.mark.parametrize(
        ("name", "said"),
        [
            ("own_estimator.py:Mien", "own_estimator.py has no 'Mien'; it has"),
            (
                "own_estimator.py:number",
                "own_estimator.py:number: an estimator is a name (ppso, relay) or an Estimator",
            ),
            ("own_estimator.py:Broken", "own_estimator.py:Broken raised RuntimeError: no antenna"),
            ("nowhere.py:Mine", "no file 'nowhere.py'"),
        ],
    )
    def test_mistakes(self, name, said):
        assert said in refused("run", "paper", "--network", "wifi", "--estimator", name)
        assert said in refused("network", "paper", "--estimators", name)
        assert said in refused("evaluate", "consensus_v0", "--network", "wifi", "--estimator", name)

    def test_a_configuration_of_a_training_cannot_hold_it(self):
        said = refused("train", "consensus_v0", "--network", "wifi", "--estimator", "own_estimator.py:Mine")
        assert (
            "estimator 'mine': the configuration of a training is a file, which can't hold an estimator of your" in said
        )


class TestNone:
    """Continuous exchange, on a scenario that has a network."""

    @pytest.fixture(autouse=True)
    def own(self, folder):
        text = khop("export", "paper").stdout
        (folder / "own.toml").write_text(text + '\n[network]\nprofile = "espnow"\nestimator = "relay"\n')

    def test_commands(self):
        off = "--network", "none"
        found = only_json(khop("run", "own.toml", "--duration", "0.2", "--json", *off))
        assert "network" not in found
        assert found["integrator"] == "proximal"
        found = only_json(khop("run", "consensus_v0", "--scenario", "own.toml", "--duration", "0.2", "--json", *off))
        assert "network" not in found
        assert only_json(khop("check", "own.toml", "--json", *off)).get("network") is None
        played = "evaluate", "consensus_v0", "--scenario", "own.toml", "--policies", "zero", "--observe", "estimate"
        short = "--episodes", "2", "--env", "max_cycles=4", "--json"
        assert only_json(khop(*played, *short))["estimator"] == "relay"
        for chosen in (off, ("--env", "network=none")):
            found = only_json(khop(*played, *short, *chosen))
            assert (found["network"], found["estimator"]) == (None, None)

    def test_with_an_estimator_it_is_refused(self):
        said = refused("run", "own.toml", "--network", "none", "--estimator", "relay")
        assert "there is no network; choose one, e.g. --network wifi" in said

    def test_there_is_nothing_to_draw(self):
        said = refused("network", "paper", "--networks", "none,wifi", "--figure", "network.png")
        assert "--figure varies the first network's period and loss, and 'none' has no messages" in said
