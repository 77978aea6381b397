"""The arguments `network` and `estimator` of environments, and of scenarios."""

import pytest

import khop_env
from khop_env import consensus_v0
from khop_env.network import Network
from khop_env.observers import Networked, Relay
from tests.env.playing import built, parallel, play, same, state


@pytest.mark.parametrize(
    ("arguments", "message"),
    [
        ({"network": "wify"}, "no network 'wify'; did you mean 'wifi'?"),
        ({"network": 3}, "a network is a name like 'wifi', a Network, a mapping or None; got 3"),
        ({"network": {"los": 0.2}}, "no key 'los'; did you mean 'loss'"),
        ({"network": "wifi", "estimator": "rely"}, "no estimator 'rely'; did you mean 'relay'?"),
        ({"network": "wifi", "estimator": 3}, r"an estimator is a name \(.*\) or an Estimator; got 3"),
        (
            {"network": "wifi", "order": 2},
            "order=2 is of simulators without a network; under one steps are of order 1",
        ),
        ({"estimator": "relay"}, "estimator: 'relay' makes estimates from messages, and there is no network"),
    ],
)
@pytest.mark.parametrize("make", [khop_env.make, khop_env.make_vec, khop_env.make_sb3_vec, khop_env.make_joint])
def test_wrong_arguments_are_refused(make, arguments, message):
    with pytest.raises(ValueError, match=message):
        make("consensus_v0", **arguments)


def test_an_environment_s_own_network_replaces_the_scenario_s():
    """Everywhere; and `Scenario.build` uses the scenario's."""
    scenario = built("paper").replace(network="lossy", estimator="relay")
    assert isinstance(scenario.network, Network)
    for made in (consensus_v0.batched_env(scenario).simulator, scenario.build()):
        assert isinstance(made.observers, Networked)
        assert (made.observers.network, made.observers.estimator.name) == (Network.of("lossy"), "relay")
    env = consensus_v0.batched_env(scenario, network={"period": 0.1})
    assert env.simulator.observers.network == env.settings.network == Network(period=0.1)
    assert env.settings.estimator == env.simulator.observers.estimator.name == "relay"
    env = consensus_v0.batched_env(scenario, estimator="ppso")
    assert (env.settings.network, env.simulator.observers.estimator.name) == (Network.of("lossy"), "ppso")
    assert consensus_v0.batched_env(scenario.replace(network=None)).simulator.observers.name == "proximal"
    env = consensus_v0.batched_env(scenario, network="none")
    assert (env.settings.network, env.simulator.observers.name) == (None, "proximal")
    with pytest.raises(ValueError, match="scenario 'paper': no network 'wify'"):
        scenario.replace(network="wify")
    with pytest.raises(ValueError, match="scenario 'paper': no estimator 'rely'"):
        scenario.replace(estimator="rely")


class Own(Relay):
    """An estimator of a user's own."""

    name = "own"


@pytest.mark.parametrize(
    ("theirs", "mine", "message"),
    [
        ({"network": "wifi"}, {}, r"the networks differ: Network\(.*\) there, none here"),
        ({"network": "wifi"}, {"network": "lossy"}, r"the networks differ: Network\(.*latency=0.01.*latency=0.03"),
        (
            {"network": "wifi"},
            {"network": "wifi", "estimator": "relay"},
            "the estimators differ: ppso there, relay here",
        ),
        (
            {"network": "wifi", "estimator": Own()},
            {"network": "wifi", "estimator": "relay"},
            "differ: own there, relay",
        ),
    ],
)
def test_states_of_another_network_are_refused(theirs, mine, message):
    other, env, clean = (parallel("consensus_v0", **arguments) for arguments in (theirs, mine, mine))
    other.reset(seed=0)
    assert same(env.reset(seed=1), clean.reset(seed=1))
    with pytest.raises(ValueError, match=message):
        env.set_state(other.get_state())
    assert same(state(env), state(clean))
    assert same(play(env, 2), play(clean, 2))
