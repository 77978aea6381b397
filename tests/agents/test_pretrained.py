"""Shipped policies: by name, chosen by environment, scenario and network, never by order; their index and cards."""

import re
import shlex
import warnings

import pytest
from typer.testing import CliRunner

from agents import compare, describe, make_policy, play
from agents.learning import PRETRAINED, LearnedPolicy, PolicyFileError, PretrainedPolicy, load_pretrained, shipped
from agents.learning import pretrained as module
from agents.running import environment_for, policy_and_environment
from khop_env import make_batched, scenario
from khop_env.cli import app
from khop_env.registry import environments, find_task

SHIPPED = shipped()
LOSSY = "lossy:loss=0.3,burst=5"


def chosen(environment, name, **arguments) -> str:
    """The name of the policy that "ppo:pretrained" means."""
    env = make_batched(environment, name, **arguments)
    about = PretrainedPolicy().chosen(describe(env)).about
    (same,) = (each for each in SHIPPED if load_pretrained(each).about == about)
    return same


class TestIndex:
    def test_it_lists_the_files(self):
        assert {path.stem for path in PRETRAINED.glob("*.npz")} == set(SHIPPED)

    @pytest.mark.parametrize("policy", SHIPPED.values(), ids=lambda policy: policy.name)
    def test_it_says_what_the_files_say(self, policy):
        about = load_pretrained(policy.name).about
        assert policy.path.stat().st_size < 1_000_000
        assert (about["environment"], about["scenario"]) == (policy.environment, policy.scenario)
        assert about["observe"] == "estimate"
        trained = about.get("arguments", {})
        assert (trained.get("network"), trained.get("estimator")) == (policy.network, policy.estimator)
        task, place = policy.environment.rpartition("_v")[0], policy.scenario.partition(":")[0]
        assert policy.name.startswith(f"{task}_{place}")
        assert policy.fails.strip().endswith(".")

    @pytest.mark.parametrize("policy", SHIPPED.values(), ids=lambda policy: policy.name)
    def test_its_last_command_has_the_settings_of_the_file(self, policy, monkeypatch):
        """If defaults have changed since: python -m benchmarks.pretrained --take NAME=agents/.../NAME.npz."""
        started = []

        def train(config, *_, **__):
            started.append(config)
            raise KeyboardInterrupt

        monkeypatch.setattr("agents.learning.training.train", train)
        CliRunner().invoke(app, shlex.split(policy.train[-1])[1:])
        about, settings = load_pretrained(policy.name).about, started[0].as_dict()
        settings["scenario"] = settings["scenario"] or find_task(policy.environment).default_scenario
        assert {name: value for name, value in about.items() if name in settings} == {
            name: value for name, value in settings.items() if name in about
        }

    @pytest.mark.parametrize("environment", environments())
    def test_each_environment_has_one_for_its_default(self, environment):
        assert chosen(environment, find_task(environment).default_scenario) in SHIPPED

    def test_one_is_for_a_lossy_network(self):
        assert LOSSY in [policy.network for policy in SHIPPED.values()]


class TestCards:
    @pytest.mark.parametrize("name", SHIPPED)
    def test_a_card_belongs_to_its_file(self, name):
        """After a file was exchanged: python -m benchmarks.pretrained."""
        cards = (PRETRAINED / "README.md").read_text(encoding="utf-8")
        card = re.search(rf"(?ms)^## `{name}`\n(.*?)(?=^## |\Z)", cards)[1]
        assert f"SHA-256 `{module.digest(name)}`" in card
        assert "\n".join(SHIPPED[name].train) in card
        assert SHIPPED[name].fails.strip() in card
        assert re.search(r"^\| as trained \| \S+ ± \S+ \|", card, re.MULTILINE)

    def test_there_is_no_card_more(self):
        cards = (PRETRAINED / "README.md").read_text(encoding="utf-8")
        assert re.findall(r"(?m)^## `(\w+)`$", cards) == list(SHIPPED)


class TestNames:
    def test_a_name_is_that_file(self):
        for name, policy in SHIPPED.items():
            loaded = make_policy(f"ppo:pretrained/{name}")
            assert isinstance(loaded, LearnedPolicy)
            assert loaded.about == LearnedPolicy.load(policy.path).about

    @pytest.mark.parametrize(
        ("spec", "said"),
        [
            (
                "ppo:pretrained/consensus",
                r"no pretrained policy 'consensus'; did you mean .*available: consensus_paper",
            ),
            ("ppo:pretrained/", r"no pretrained policy ''; .*leader_following_convoy_lossy \(leader_following_v0 on "),
            ("ppo:pretrained/../pretrained/consensus_paper", "no pretrained policy '../pretrained/consensus_paper'"),
            ("sac:pretrained", "only ppo:pretrained chooses"),
            ("sac:pretrained/consensus_paper", "was trained by ppo"),
        ],
    )
    def test_refusals(self, spec, said):
        with pytest.raises(ValueError, match=said):
            make_policy(spec)

    def test_one_that_does_not_fit_is_refused(self):
        env = make_batched("consensus_v0", "convoy")
        with pytest.raises(ValueError, match="it was trained for leader_following_v0, not for consensus_v0"):
            play(env, make_policy("ppo:pretrained/leader_following_convoy"), [0])


class TestChoice:
    def test_by_network(self):
        assert chosen("leader_following_v0", "convoy") == "leader_following_convoy"
        assert chosen("leader_following_v0", "convoy", network=LOSSY) == "leader_following_convoy_lossy"
        assert chosen("navigation_v0", "crossing") == "navigation_crossing"  # the scenario's own network

    def test_over_another_network_with_a_warning(self):
        said = (
            r"ppo:pretrained is leader_following_convoy_lossy, .* 30 % lost in bursts of 5.*, and is played over one "
        )
        for arguments in ({"network": "wifi"}, {"network": LOSSY, "estimator": "relay"}):
            with pytest.warns(UserWarning, match=said):
                assert chosen("leader_following_v0", "convoy", **arguments) == "leader_following_convoy_lossy"
        named = make_policy("ppo:pretrained/leader_following_convoy_lossy")
        with warnings.catch_warnings():
            warnings.simplefilter("error")
            named.reset(describe(make_batched("leader_following_v0", network="wifi")), [0])

    def test_without_one_it_says_what_there_is(self):
        for environment, name, arguments, said in (
            (
                "consensus_v0",
                "convoy",
                {},
                r"for consensus_v0 on convoy; available: consensus_paper .*To train one: khop",
            ),
            (
                "consensus_v0",
                "paper",
                {"network": "wifi"},
                r"over a network: ppo:pretrained/consensus_paper .* --network",
            ),
        ):
            with pytest.raises(PolicyFileError, match=said):
                chosen(environment, name, **arguments)

    def test_of_several_one_has_to_be_named(self, tmp_path, monkeypatch):
        """The order in the index makes no difference."""
        text = '["{}"]\nenvironment = "leader_following_v0"\nscenario = "convoy"\ntrain = []\ntrained = 2026-01-01\n'
        text += 'fails = ""\nnetwork = "{}"\n'
        over = {"b": "wifi", "a": LOSSY, "c": "espnow"}
        for order in (list(over), list(reversed(over))):
            for name in order:
                (tmp_path / f"{name}.npz").write_bytes((PRETRAINED / "leader_following_convoy_lossy.npz").read_bytes())
            (tmp_path / "index.toml").write_text("".join(text.format(name, over[name]) for name in order))
            with monkeypatch.context() as patched:
                patched.setattr(module, "PRETRAINED", tmp_path)
                assert list(shipped()) == ["a", "b", "c"]
                for name, network in over.items():
                    env = describe(make_batched("leader_following_v0", network=network))
                    found = module._choice("leader_following_v0", "convoy", (env.network, env.estimator))
                    assert found.name == name
                env = describe(make_batched("leader_following_v0", network="ideal"))
                several = "there are 3 .*: choose ppo:pretrained/a or ppo:pretrained/b or ppo:pretrained/c"
                with pytest.raises(PolicyFileError, match=several):
                    PretrainedPolicy().reset(env, [0])

    def test_it_is_made_before_the_environment(self):
        """Bounds and arguments of the training are those of the chosen policy, in a filter, too."""
        policy, env = policy_and_environment(
            "filter:announce=true:ppo:pretrained", scenario("crossing"), "estimate", 1.0, environment="navigation_v0"
        )
        assert policy.policy.about["scenario"] == "crossing"
        assert env.batched.task.goal_radius == policy.policy.about["arguments"]["goal_radius"]
        policy, env = policy_and_environment(
            "ppo:pretrained/leader_following_convoy_lossy", scenario("convoy"), "estimate", 1.0
        )
        assert describe(env).network.burst == 5
        policy, _ = policy_and_environment(
            "ppo:pretrained", scenario("convoy"), "estimate", 1.0, arguments={"network": LOSSY}
        )
        assert policy.about["arguments"]["network"] == LOSSY

    def test_the_environment_where_none_is_named(self):
        assert environment_for("ppo:pretrained", scenario("paper")) == "consensus_v0"  # as for scripts
        assert environment_for("ppo:pretrained", scenario("convoy")) == "leader_following_v0"
        assert environment_for("ppo:pretrained/formation_paper", scenario("paper")) == "formation_v0"
        with pytest.raises(PolicyFileError, match=r"no pretrained policy for corridor; available"):
            environment_for("filter:ppo:pretrained", scenario("corridor"))

    def test_comparisons_choose_for_each_network(self):
        with pytest.warns(UserWarning, match="is played over one with a message every 50 ms, none lost"):
            found = compare("leader_following_v0", ["ppo:pretrained"], networks=["ideal", LOSSY], seeds=range(2))
        named = compare(
            "leader_following_v0",
            ["ppo:pretrained/leader_following_convoy_lossy"],
            networks=["ideal", LOSSY],
            seeds=range(2),
        )
        for ours, theirs in zip(found.rows, named.rows, strict=True):
            assert ours.episodes.returns.tolist() == theirs.episodes.returns.tolist()
