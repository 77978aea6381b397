"""Networks as users write them, and what is refused."""

import pickle

import networkx as nx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from khop_env.network import PROFILES, Channel, Network
from khop_env.physics import Links
from tests.strategies import NETWORKS


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
    assert list(PROFILES) == [*latency_jitter_loss, "random"]
    for name in latency_jitter_loss:
        each = PROFILES[name]
        assert not each.ranges
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
    drawn = Network(loss=(0.0, 0.3), burst=(1.0, 4.0), latency=(0.01, 0.1), jitter=(0.0, 0.005))
    assert Network.of("random:loss=0..0.3,burst=1..4") == drawn
    assert Network.of({"profile": "random", "loss": [0, 0.3], "burst": [1, 4]}) == drawn
    assert pickle.loads(pickle.dumps(drawn)) == drawn
    assert drawn.ranges == {"loss": (0.0, 0.3), "latency": (0.01, 0.1), "burst": (1.0, 4.0), "jitter": (0.0, 0.005)}
    assert Network.of(wanted) is wanted
    assert pickle.loads(pickle.dumps(wanted)) == wanted
    assert hash(Network(loss=[0.1, 0.3])) == hash(Network(loss=(0.1, np.float64(0.3))))


def test_described_in_a_line() -> None:
    assert PROFILES["ideal"].described() == "a message every 50 ms, none lost"
    assert (
        Network.of("lossy:loss=0.1..0.3,burst=5,noise=0.1").described()
        == "a message every 50 ms, 10 to 30 % lost in bursts of 5, 30 +- 5 ms late, noise up to 0.1"
    )
    assert (
        PROFILES["random"].described()
        == "a message every 50 ms, 0 to 50 % lost in bursts of 1 to 8, 10 to 100 +- 0 to 5 ms late"
    )


@given(network=NETWORKS, key=st.integers(0, 2**64 - 1))
def test_what_is_drawn_lies_in_its_range_and_is_a_network(network: Network, key: int) -> None:
    drawn = network.drawn(key)
    assert not drawn.ranges
    assert drawn == network.drawn(key)
    assert drawn.drawn(key) is drawn
    for name in ("loss", "latency", "jitter", *([] if network.burst is None else ["burst"])):
        low, high = network.bounds(name)
        assert low <= getattr(drawn, name) <= high, name
    assert (drawn.period, drawn.noise, drawn.burst is None) == (network.period, network.noise, network.burst is None)
    assert network.fewest_rounds_late <= drawn.fewest_rounds_late <= drawn.most_rounds_late <= network.most_rounds_late


def test_each_value_is_uniform_over_its_range_and_independent_of_the_others() -> None:
    network = PROFILES["random"]
    networks = [network.drawn(key) for key in range(4000)]
    shares = []
    for name, (low, high) in network.ranges.items():
        shares.append([(getattr(each, name) - low) / (high - low) for each in networks])
        counts = np.histogram(shares[-1], 10, (0.0, 1.0))[0]
        assert ((counts - 400) ** 2 / 400).sum() < 35  # chi-squared with 9 degrees of freedom
    assert np.abs(np.corrcoef(shares) - np.eye(4)).max() < 5.0 / np.sqrt(4000)


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
        ("wifi:burst=0.5..2", r"at least 1; got \(0.5, 2.0\)"),
        ("wifi:burst=4..3", r"Network.burst must be .* low <= high; got \(4.0, 3.0\)"),
        ("wifi:burst=1..inf", "at least 1"),
        ("wifi:burst=none..2", "burst must be a number, or a range like"),
        ("random:burst=", "burst must be a number, or a range like 0.1..0.3; got ''"),
        ("random:loss=0..", "loss must be a number, or a range like"),
        ("random:loss=0..0.6", "burst = 1 is too short for a loss of 0.6, .* take 1.5 or more .every value of a range"),
        ("random:jitter=0..0.02", "at least the jitter of 0.02 s"),
        ("random:jitter=0.002..0.001", r"Network.jitter must be .* low <= high"),
        ("random:jitter=-0.1..0", "jitter must be finite and not negative"),
        ("random:period=0.01..0.1", "Network.period must be a number"),
        ("random:noise=0..0.1", "Network.noise must be a number"),
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
