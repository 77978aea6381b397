"""Networks as users write them, and what is refused."""

import pickle

import networkx as nx
import numpy as np
import pytest

from khop_env.network import PROFILES, Channel, Network
from khop_env.physics import Links


def test_profiles_are_those_of_the_design() -> None:
    latency_jitter_loss = {
        "ideal": (0, 0, 0),
        "urllc": (1, 0, 1e-6),
        "factory": (5, 0.1, 1e-4),
        "wifi": (10, 1, 1e-2),
        "lossy": (30, 5, 1e-2),
        "saturation": (100, 10, 0.1),
        "espnow": (40, 0, 0.08),
        "crazyradio": (26, 0, 0.3),
    }
    assert list(PROFILES) == list(latency_jitter_loss)
    for name, each in PROFILES.items():
        assert (1e3 * each.latency, 1e3 * each.jitter, each.loss) == pytest.approx(latency_jitter_loss[name])


def test_a_network_by_name_text_mapping_or_itself() -> None:
    assert Network.of(None) is None
    assert Network.of("wifi") == PROFILES["wifi"]
    wanted = Network(period=0.05, loss=0.3, burst=5.0, latency=0.03, jitter=0.005)
    assert Network.of("lossy:period=0.05, loss=0.3,burst=5") == wanted
    assert Network.of({"profile": "lossy", "loss": 0.3, "burst": 5}) == wanted
    assert Network.of({"loss": [0.1, 0.3]}) == Network(loss=(0.1, 0.3))
    assert Network.of("ideal:loss=0.1..0.3,latency=0.01..0.02") == Network(loss=(0.1, 0.3), latency=(0.01, 0.02))
    assert Network.of("lossy:burst=none").burst is None
    assert Network.of(wanted) is wanted
    assert pickle.loads(pickle.dumps(wanted)) == wanted
    assert hash(Network(loss=[0.1, 0.3])) == hash(Network(loss=(0.1, np.float64(0.3))))


def test_described_in_a_line() -> None:
    assert PROFILES["ideal"].described() == "a message every 50 ms, none lost"
    assert (
        Network.of("lossy:loss=0.1..0.3,burst=5,noise=0.1").described()
        == "a message every 50 ms, 10 to 30 % lost in bursts of 5, 30 +- 5 ms late, noise up to 0.1"
    )


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("wify", "no network 'wify'; did you mean 'wifi'"),
        ("wifi:los=0.1", "no key 'los'; did you mean 'loss'"),
        ("wifi:", "'' is no key=value"),
        ("wifi:loss", "'loss' is no key=value"),
        ("wifi:loss=0.1,loss=0.2", "a key that was there already"),
        ("wifi:loss=a", "must be a number, or a range like 0.1..0.3; got 'a'"),
        ("wifi:loss=0..1..2", "must be a number, or a range"),
        ("wifi:loss=none", "Network.loss must be a number; got None"),
        ("wifi:loss=30", "30 % are 0.3"),
        ("wifi:loss=nan", "from 0 to 1"),
        ("wifi:loss=0.3..0.1", "low <= high"),
        ("wifi:period=0", "period must be positive"),
        ("wifi:period=inf", "period must be positive"),
        ("wifi:burst=0.5", "at least 1"),
        ("wifi:loss=0.9,burst=5", "take 9 or more"),
        ("wifi:loss=1,burst=5", "take None"),
        ("wifi:jitter=0.02", "at least the jitter of 0.02 s"),
        ("wifi:latency=0..0.02", "at least the jitter"),
        ("wifi:jitter=-1", "jitter must be finite and not negative"),
        ("wifi:noise=inf", "noise must be finite"),
        ("wifi:latency=inf", "latency must be finite"),
        ("wifi:latency=1,period=1e-4", "more than 4096 periods"),
    ],
)
def test_bad_networks_are_refused(text: str, message: str) -> None:
    with pytest.raises(ValueError, match=message):
        Network.of(text)


@pytest.mark.parametrize("network", [3, ["wifi"], {"profile": ["wifi"]}, {"loss": True}, {"period": "1"}])
def test_other_types_are_refused(network: object) -> None:
    with pytest.raises(ValueError, match=r"a network is|no network|must be a number"):
        Network.of(network)  # type: ignore[arg-type]


def test_arrays_of_a_wrong_shape_are_refused() -> None:
    channel = Channel(Network(), Links.of(nx.path_graph(3)), num_envs=2, width=5)
    memory = channel.allocate()
    for values, up, due, message in (
        (np.zeros((4, 2)), None, None, r"values .* \(4, 2\); expected \(5, 2\)"),
        (np.zeros((5, 2)), np.ones(4), None, r"up .* \(4,\); expected \(4, 2\)"),
        (np.zeros((5, 2)), None, np.ones(3), r"due .* \(3,\); expected \(2,\)"),
    ):
        with pytest.raises(ValueError, match=message):
            channel.exchange(memory, values, up, due)
    assert (memory["round"] == -1).all()


def test_whole_rounds_late_are_rounded_up() -> None:
    assert [Network(period=0.1).rounds_late(delay) for delay in (0.0, 1e-6, 0.1, 0.3, 0.7, 1.1, 0.11)] == [
        *(0, 1, 1, 3, 7, 11, 2)
    ]
