"""The [network] table of scenario files: read, written, and refused in the file's words."""

import pytest

from khop_env.network import PROFILES, Network
from khop_env.observers import Relay
from khop_env.scenarios.files import ScenarioFileError, read_scenario, write_scenario
from tests.env.playing import built
from tests.scenarios.test_files import MINIMAL, read, wrong

NETWORKS = [
    *PROFILES.values(),
    Network.of("lossy:period=0.1,loss=0.1..0.3,burst=5"),
    Network(latency=(0.0, 0.2), noise=0.01),
    Network.of("random:loss=0..0.6,burst=2..4"),
]


@pytest.mark.parametrize("network", NETWORKS, ids=repr)
@pytest.mark.parametrize("estimator", ["ppso", "relay"])
def test_written_networks_are_read_back(network, estimator, tmp_path):
    """With the numbers that a user would change, each with its unit."""
    path = tmp_path / "mine.toml"
    text = write_scenario(built("paper").replace(network=network, estimator=estimator))
    path.write_text(text, encoding="utf-8")
    scenario = read_scenario(path)
    assert (scenario.network, scenario.estimator) == (network, estimator)
    assert ("profile = " in text.partition("[network]")[2]) == (network in PROFILES.values())


def test_without_the_table_there_is_no_network(tmp_path):
    """And it isn't written."""
    assert read(MINIMAL, tmp_path).network is None
    assert "[network]" not in write_scenario(built("paper"))


@pytest.mark.parametrize(
    ("table", "expected", "estimator"),
    [
        ("", Network(), "ppso"),
        ('profile = "wifi"', Network.of("wifi"), "ppso"),
        ('profile = "wifi"\nloss = 0.3\nburst = 4', Network.of("wifi:loss=0.3,burst=4"), "ppso"),
        ('loss = [0.1, 0.3]\nestimator = "relay"', Network(loss=(0.1, 0.3)), "relay"),
    ],
)
def test_profiles_and_numbers(table, expected, estimator, tmp_path):
    scenario = read(f"{MINIMAL}\n[network]\n{table}\n", tmp_path)
    assert (scenario.network, scenario.estimator) == (expected, estimator)


@pytest.mark.parametrize(
    ("table", "messages"),
    [
        ('profil = "wifi"', ["network.profil: unknown key (with the value 'wifi')", "did you mean 'profile'?"]),
        ('estimater = "relay"', ["network.estimater: unknown key", "did you mean 'estimator'?"]),
        ("speed = 3", ["network.speed: unknown key", "estimator, profile, period"]),
        ('profile = "wify"', ["network.profile: got 'wify', expected one of 'ideal', ", "did you mean 'wifi'?"]),
        ('estimator = "rely"', ["network.estimator: got 'rely'", "did you mean 'relay'?"]),
        ("los = 0.2", ["network.los: unknown key (with the value 0.2); did you mean 'loss'?"]),
        ('loss = "many"', ["network.loss: got 'many', expected a number or a list of 2 numbers"]),
        ("loss = 1.5", ["network: loss must be from 0 to 1 (30 % are 0.3); got 1.5"]),
        ("burst = 1\nloss = 0.9", ["network: burst = 1 is too short for a loss of 0.9"]),
        ("jitter = 0.1", ["network: latency must be finite and at least the jitter of 0.1 s"]),
        ("period = true", ["network.period: got True, expected a number"]),
    ],
)
def test_mistakes_are_named(table, messages, tmp_path):
    (found,) = wrong(f"{MINIMAL}\n[network]\n{table}\n", tmp_path)
    assert found.startswith(messages[0])
    assert messages[-1] in found


def test_all_mistakes_of_the_table_are_named_at_once(tmp_path):
    found = wrong(f'{MINIMAL}\n[network]\nestimator = "x"\nprofile = "y"\nperiod = "z"\n', tmp_path)
    assert [each.partition(":")[0] for each in found] == ["network.estimator", "network.profile", "network.period"]
    with pytest.raises(ScenarioFileError, match="network: got 3, expected a table"):
        read(f"network = 3\n{MINIMAL}", tmp_path)


class Own(Relay):
    """An estimator of a user's own."""

    name = "own"


def test_estimators_that_no_file_can_name_are_refused():
    """One of a user's own, and one that would be lost because there is no table to write it to."""
    scenario = built("paper").replace(network="wifi", estimator=Own())
    with pytest.raises(ValueError, match=r"the estimator 'own' can't be written to a file: .* keep this scenario"):
        write_scenario(scenario)
    with pytest.raises(ValueError, match="the estimator 'relay' can't be written to a file without a network"):
        write_scenario(scenario.replace(network=None, estimator="relay"))
