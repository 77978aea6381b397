"""Message rounds: what is lost, how late it comes, what the newest message is, and that all of it can be repeated."""

import copy

import networkx as nx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from khop_env.network import Channel, ChannelMemory, Network, PlainLink, plain_noise
from khop_env.network.randomness import draw_keys, plain_uniform, round_key, uniform
from khop_env.physics import Links
from tests.strategies import NETWORKS, SEEDS

LINKS = Links.of(nx.path_graph(4))


def started(network: Network, seeds: list[int], links: Links = LINKS, width: int = 0) -> tuple[Channel, ChannelMemory]:
    channel = Channel(network, links, len(seeds), width)
    memory = channel.allocate()
    channel.reset(memory, np.arange(len(seeds)), [np.random.default_rng(seed) for seed in seeds])
    return channel, memory


def history(network: Network, envs: int, rounds: int) -> np.ndarray:
    """(rounds, L, B) newest message of each round."""
    channel, memory = started(network, list(range(envs)))
    found = []
    for _ in range(rounds):
        channel.exchange(memory, np.zeros((0, envs)))
        found.append(memory["newest"].copy())
    return np.array(found)


@given(network=NETWORKS, seed=SEEDS)
def test_compiled_rounds_are_the_plain_ones(network: Network, seed: int) -> None:
    rng = np.random.default_rng(seed)
    channel, memory = started(network, [seed, seed + 1])
    plain = [[PlainLink(network, int(key), link) for key in memory["key"]] for link in range(len(LINKS))]
    for _ in range(100):
        up, due = rng.random((len(LINKS), 2)) < 0.9, rng.random(2) < 0.9
        before = memory["newest"].copy()
        channel.exchange(memory, np.zeros((0, 2)), up, due)
        expected = [
            [each.advance(up[link, b]) if due[b] else each.newest for b, each in enumerate(row)]
            for link, row in enumerate(plain)
        ]
        np.testing.assert_array_equal(memory["newest"], expected)
        np.testing.assert_array_equal(memory["heard"][:, due], (memory["newest"] > before)[:, due])
        assert [each.round for each in plain[0]] == memory["round"].tolist()


@given(network=NETWORKS, seed=SEEDS)
def test_ages_grow_by_one_or_fall_to_a_delay(network: Network, seed: int) -> None:
    channel, memory = started(network, [seed])
    drawn = network.drawn(int(memory["key"][0]))
    soonest, latest = drawn.fewest_rounds_late, drawn.most_rounds_late
    assert soonest <= latest <= (drawn.latency + drawn.jitter) / network.period + 1
    before = channel.age(memory)
    for number in range(60):
        channel.exchange(memory, np.zeros((0, 1)))
        age, heard = channel.age(memory), memory["heard"]
        assert (age[~heard] == np.where(before < 0, -1, before + 1)[~heard]).all()
        assert (age[heard] <= latest).all()
        assert ((age == -1) | (age >= soonest)).all()
        assert (age <= number).all()
        assert (age[heard & (before >= 0)] <= before[heard & (before >= 0)]).all()
        before = age


def test_messages_overtake_and_the_newest_counts() -> None:
    network = Network(period=0.01, latency=0.05, jitter=0.05)
    newest = history(network, 20, 200)
    steps = np.diff(newest, axis=0)
    assert (steps >= 0).all()
    assert (steps > 1).any()  # one came before an older one, which then counts no more
    age = np.arange(200)[:, None, None] - newest
    assert age[20:].min() == 1  # a delay of exactly 0 has probability 0
    assert age[20:].max() <= 10


@pytest.mark.parametrize(
    ("loss", "burst"), [(0.1, None), (0.3, 5.0), (0.05, 4.0), (0.3, 10.0), (0.9, 20.0), (0.4, 1.0)]
)
def test_loss_and_bursts_have_their_means(loss: float, burst: float | None) -> None:
    rounds, envs = 2000, 100
    newest = history(Network(loss=loss, burst=burst), envs, rounds)
    lost = newest != np.arange(rounds)[:, None, None]
    # Lost messages are correlated over about 1 / (1 - r) rounds, r the chain's second eigenvalue.
    mean = burst or 1.0 / (1.0 - loss)
    eigenvalue = 1.0 - 1.0 / mean - loss / (mean * (1.0 - loss))
    deviation = np.sqrt(loss * (1.0 - loss) / lost.size * (1.0 + eigenvalue) / (1.0 - eigenvalue))
    assert abs(lost.mean() - loss) < 5.0 * deviation
    starts = (lost[1:] & ~lost[:-1]).sum()  # bursts that begin; each is geometric with this mean
    lengths = lost[1:].sum() - (lost[0] & lost[1]).sum()
    assert abs(lengths / starts - mean) < 5.0 * np.sqrt(mean * (mean - 1.0) / starts) + 0.01 * mean
    assert abs(lost[0].mean() - loss) < 5.0 * np.sqrt(loss * (1.0 - loss) / lost[0].size)  # stationary from the start


def test_every_episode_loses_and_delays_as_it_has_drawn() -> None:
    """The profile "random" in 60 environments: shares of losses, lengths of bursts, and delays, of each by itself."""
    network, rounds, envs = Network.of("random:loss=0.05..0.5,latency=0.05..0.15,jitter=0..0.05"), 4000, 60
    channel, memory = started(network, list(range(envs)))
    newest, bad = [], []
    for _ in range(rounds):
        channel.exchange(memory, np.zeros((0, envs)))
        newest.append(memory["newest"].copy())
        bad.append(memory["bad"].copy())
    lost, newest = np.array(bad), np.array(newest)
    age = np.arange(rounds)[:, None, None] - newest
    heard = np.diff(newest, axis=0, prepend=-1) > 0
    distances = []
    for b, key in enumerate(memory["key"]):
        drawn, own = network.drawn(int(key)), lost[..., b]
        loss, burst = drawn.loss, drawn.burst
        eigenvalue = 1.0 - 1.0 / burst - loss / (burst * (1.0 - loss))
        deviation = np.sqrt(loss * (1.0 - loss) / own.size * (1.0 + eigenvalue) / (1.0 - eigenvalue))
        starts = (own[1:] & ~own[:-1]).sum()
        lengths = (own[1:].sum() - (own[0] & own[1]).sum()) / starts
        distances.append(
            ((own.mean() - loss) / deviation, (lengths - burst) / np.sqrt(max(burst * (burst - 1.0), 1e-2) / starts))
        )
        found = age[..., b][heard[..., b]]
        assert found.max() <= drawn.most_rounds_late, b
        assert found.min() >= drawn.fewest_rounds_late, b
    assert np.abs(distances).max() < 5.0
    assert np.std(distances, axis=0) == pytest.approx([1.0, 1.0], abs=0.4)


@given(network=NETWORKS, seed=SEEDS)
def test_an_episode_over_ranges_is_that_over_what_it_drew(network: Network, seed: int) -> None:
    channel, memory = started(network, [seed], width=1)
    drawn, own = started(network.drawn(int(memory["key"][0])), [seed], width=1)
    for number in range(80):
        values = np.full((1, 1), float(number))
        channel.exchange(memory, values)
        drawn.exchange(own, values)
        for name in ("key", "round", "bad", "newest", "heard"):
            np.testing.assert_array_equal(memory[name], own[name], name)


def test_links_and_environments_lose_independently() -> None:
    newest = history(Network(loss=0.5), 50, 2000)
    lost = (newest != np.arange(2000)[:, None, None]).reshape(2000, -1).astype(float)
    correlation = np.corrcoef(lost.T) - np.eye(lost.shape[1])
    assert np.abs(correlation).max() < 6.0 / np.sqrt(2000)
    assert np.abs([np.corrcoef(lost[1:, c], lost[:-1, c])[0, 1] for c in range(lost.shape[1])]).max() < 6 / np.sqrt(
        2000
    )


def test_everything_or_nothing_arrives() -> None:
    assert (history(Network(), 3, 50) == np.arange(50)[:, None, None]).all()
    assert (history(Network(loss=1.0), 3, 50) == -1).all()
    late = history(Network(latency=0.1), 3, 50)
    assert (late == np.maximum(np.arange(50) - 2, -1)[:, None, None]).all()


def test_a_link_that_is_down_loses_what_is_sent_then_and_nothing_else() -> None:
    channel, memory = started(Network(latency=0.1), [0])
    found = []
    for number in range(10):
        up = np.full((len(LINKS), 1), number not in (3, 4, 5))
        channel.exchange(memory, np.zeros((0, 1)), up)
        found.append(int(memory["newest"][0, 0]))
    assert found == [-1, -1, 0, 1, 2, 2, 2, 2, 6, 7]  # what flew when it went down arrived


@given(network=NETWORKS, seed=SEEDS)
def test_alone_and_in_a_batch_and_restored_in_a_burst(network: Network, seed: int) -> None:
    seeds = [seed, 5, 6]
    together, memory = started(network, seeds, width=2)
    alone, own = started(network, [seed], width=2)
    saved = copy.deepcopy(memory)
    rng = np.random.default_rng(0)
    for number in range(80):
        values = rng.normal(size=(2, 3))
        together.exchange(memory, values)
        alone.exchange(own, values[:, :1])
        for name, array in own.items():
            np.testing.assert_array_equal(array, memory[name][..., :1])
        if number == 40:
            saved = copy.deepcopy(memory)
            later = [rng.normal(size=(2, 3)) for _ in range(30)]
            for values in later:
                together.exchange(memory, values)
            restored = Channel(network, LINKS, 3, 2)
            for values in later:
                restored.exchange(saved, values)
            for name, array in memory.items():
                np.testing.assert_array_equal(array, saved[name])
            return


def test_a_partial_reset_leaves_the_others_and_draws_other_bits() -> None:
    network = Network(loss=0.5, burst=4.0, latency=0.05, jitter=0.05)
    channel, memory = started(network, [1, 2, 3])
    values = np.zeros((0, 3))
    for _ in range(20):
        channel.exchange(memory, values)
    before, rng = copy.deepcopy(memory), np.random.default_rng(9)
    channel.reset(memory, np.array([1]), [rng])
    for name, array in memory.items():
        np.testing.assert_array_equal(array[..., [0, 2]], before[name][..., [0, 2]])
    fresh, own = started(network, [9])
    for _ in range(20):
        channel.exchange(memory, values)
        fresh.exchange(own, np.zeros((0, 1)))
    for name in ("key", "round", "bad", "newest"):
        np.testing.assert_array_equal(memory[name][..., 1:2], own[name])
    assert memory["key"][1] != draw_keys([rng])[0]  # the next episode of a generator has another key


def test_keys_leave_the_parents_stream() -> None:
    rng, untouched = np.random.default_rng(4), np.random.default_rng(4)
    draw_keys([rng])
    assert rng.random() == untouched.random()


@given(network=NETWORKS, seed=SEEDS)
def test_what_is_received_is_what_was_sent(network: Network, seed: int) -> None:
    senders, rng = [0, 1, 2, 3], np.random.default_rng(seed)
    channel, memory = started(network, [seed, seed + 1], width=4)  # one number per agent
    link, row = np.arange(len(LINKS)), np.array(senders)[LINKS.sender]
    held, sent = np.full((len(LINKS), 2), np.nan), []
    for _ in range(60):
        due = rng.random(2) < 0.8
        values = rng.normal(size=(4, 2))
        channel.exchange(memory, values, due=due)
        channel.receive(memory, link, row, held)
        sent.append((due, values))
        for b in range(2):
            own = [values[:, b] for due, values in sent if due[b]]
            newest = memory["newest"][:, b]
            expected = [own[k][row[c]] if k >= 0 else np.nan for c, k in enumerate(newest)]
            np.testing.assert_array_equal(held[:, b], expected)


def test_rounds_are_due_at_multiples_of_the_period() -> None:
    channel, memory = started(Network(period=0.1), [0, 1])
    counts, t = [], np.zeros(2)
    for step in range(31):
        t[:] = step * 0.05
        while (due := channel.due(memory, t)).any():
            channel.exchange(memory, np.zeros((0, 2)), due=due)
        counts.append(int(memory["round"][0]))
    assert counts == [step // 2 for step in range(31)]


def test_noise_is_bounded_fresh_each_round_and_repeatable() -> None:
    network = Network(noise=0.2)
    channel, memory = started(network, [0, 1], width=3)
    x, errors = np.ones((3, 2)), []
    for number in range(500):
        measured = channel.measured(memory, x)
        plain = [[1.0 + plain_noise(network, int(key), number, row) for key in memory["key"]] for row in range(3)]
        np.testing.assert_array_equal(measured, plain)
        errors.append(measured - x)
        channel.exchange(memory, measured)
    assert 0.19 < np.abs(errors).max() <= 0.2
    assert abs(np.mean(errors)) < 0.01
    assert np.unique(errors).size > 2900
    quiet, memory = started(Network(), [0, 1])
    assert quiet.measured(memory, x) is x


@given(st.integers(0, 2**64 - 1), st.integers(-1, 10**9), st.integers(0, 10**6), st.integers(0, 3))
def test_compiled_hash_is_the_plain_one(key: int, number: int, link: int, purpose: int) -> None:
    of_round = np.uint64(round_key(np.uint64(key), number))
    assert uniform(of_round, link, purpose) == plain_uniform(key, number, link, purpose)


def test_hash_is_the_published_splitmix64() -> None:
    """Its first outputs for the seed 0, as in many implementations' tests."""
    outputs = [int(round_key(np.uint64(0), number)) % 2**64 for number in (-1, 0, 1)]
    assert outputs == [0xE220A8397B1DCDAF, 0x6E789E6AA1B965F4, 0x06C45D188009454F]


def test_hash_is_uniform_and_no_two_purposes_share_a_number() -> None:
    values = np.array([plain_uniform(*which) for which in np.ndindex(20, 20, 20, 4)])
    assert np.unique(values).size == values.size
    counts = np.histogram(values, 100, (0, 1))[0]
    assert ((counts - 320) ** 2 / 320).sum() < 150  # chi-squared with 99 degrees of freedom
