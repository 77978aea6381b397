"""Nothing is accepted that shouldn't be, and what is dropped is counted by its kind."""

import math
import struct
import zlib

import networkx as nx
import numpy as np
import pytest

from benchmarks.deploy import fuzz
from khop_env.deploy.envelope import KINDS, OVERHEAD, WINDOW, Opener, seal
from khop_env.deploy.receiver import QUEUE, Receiver
from khop_env.network import Network, PlainLink
from khop_env.observers import Message
from khop_env.physics import DriftingIntegrator
from khop_env.registry import scenario
from tests.observers.node_rounds import T, design_of

RUN, KEY = b"run1", b"k" * 32
DESIGN = design_of([DriftingIntegrator(2.0)] * 4, 3, graph=nx.cycle_graph(4))
SIZES = {p: Message.size(DESIGN, p, "relay", "float64") for p in (1, 3)}
LATE = 20


def packed(sender: int = 1, number: int = LATE, value: float = 0.5, design=DESIGN) -> bytes:
    return Message(design, sender, number * T, np.full(2, value), {}).pack()


def opener() -> Opener:
    return Opener(DESIGN, SIZES, RUN, KEY, T, ahead=2)


def kind_of(data: bytes, sender: int | None = 1, to: Opener | None = None) -> str:
    """How a datagram is counted; "" if it is taken."""
    to = opener() if to is None else to
    before = to.refused.copy()
    found = to.open([(data, sender)], LATE)
    counted = to.refused - before
    assert len(found) + counted.total() == 1
    return next(iter(counted), "")


def damaged(data: bytes, offset: int, new: bytes) -> bytes:
    return data[:offset] + new + data[offset + len(new) :]


def with_number(data: bytes, index: int, number: float) -> bytes:
    """A packed message with another number in its place, and the checksum that belongs to it."""
    body = damaged(data[:-4], index, struct.pack("<d", number))
    return body + struct.pack("<I", zlib.crc32(body))


def test_each_kind_is_refused_and_counted():
    good = seal(packed(), RUN, KEY)
    other = design_of([DriftingIntegrator(3.0)] * 4, 3, graph=nx.cycle_graph(4))
    time, state = 8, 16  # places in a packed message
    for kind, data, sender in (
        ("", good, 1),
        ("stranger", good, None),  # an address that nobody has
        ("stranger", seal(packed(2), RUN, KEY), 2),  # an agent of the fleet that isn't heard
        ("stranger", good, 3),  # another agent's address
        ("cut", b"", 1),
        ("cut", good[:OVERHEAD], 1),
        ("cut", good[:-1], 1),
        ("too long", good + b"x", 1),
        ("too long", good * 400, 1),
        ("wrong version", damaged(good, 0, b"\2"), 1),
        ("old run", seal(packed(), b"run0", KEY), 1),
        ("wrong tag", seal(packed(), RUN, b"j" * 32), 1),
        ("wrong tag", damaged(good, len(good) - 1, bytes([good[-1] ^ 1])), 1),
        ("not of this fleet", seal(packed(design=other), RUN, KEY), 1),
        ("of the future", seal(packed(number=LATE + 3), RUN, KEY), 1),
        ("not finite", seal(with_number(packed(), state, math.nan), RUN, KEY), 1),
        ("not finite", seal(with_number(packed(), state, -math.inf), RUN, KEY), 1),
        ("not finite", seal(with_number(packed(), time, math.nan), RUN, KEY), 1),
        ("not finite", seal(with_number(packed(), time, -1.0), RUN, KEY), 1),
    ):
        assert kind_of(data, sender) == kind, (kind, data[:20])
        assert kind == "" or kind in KINDS


def test_every_single_bit_of_a_datagram_counts():
    good = seal(packed(), RUN, KEY)
    to = opener()
    for bit in range(8 * len(good)):
        place = bit // 8
        assert kind_of(damaged(good, place, bytes([good[place] ^ 1 << bit % 8])), 1, to) != ""
    assert kind_of(good, 1, to) == ""


def test_replays_are_refused_and_another_order_is_not():
    to = opener()
    order = [LATE, LATE - 3, LATE - 1, LATE + 1, LATE - 2]
    for number in order:
        assert kind_of(seal(packed(number=number), RUN, KEY), 1, to) == ""
    for number in order:
        assert kind_of(seal(packed(number=number), RUN, KEY), 1, to) == "replayed"
    assert kind_of(seal(packed(3), RUN, KEY), 3, to) == ""  # each sender has rounds of its own
    late = Opener(DESIGN, SIZES, RUN, KEY, T, ahead=2)
    late.start(10 * WINDOW)
    assert [number for number, _ in late.open([(seal(packed(), RUN, KEY), 1)], 10 * WINDOW)] == []
    assert late.refused["replayed"] == 1


def test_what_is_not_of_this_run_is_never_taken():
    """Datagrams that were cut, extended, bent, replayed, of strangers or of another run, between messages of use."""
    found = fuzz(scenario("paper"), 3, 5000, seed=0)
    assert found["junk"] == [5000, 5000]
    assert found["good"][0] == found["good"][1] > 50
    assert found["wrong"] == 0
    assert set(found["refused"]) == set(KINDS) - {"not of this fleet", "refused by the node", "queue full"}


def test_a_full_queue_drops_the_oldest():
    receiver = Receiver(DESIGN, 0, Network(T), 0, opener())
    good = [(seal(packed(number=LATE), RUN, KEY), 1)]
    receiver.take(good + [(b"flood", None)] * QUEUE, LATE)
    assert (receiver.received, receiver.opener.refused["queue full"]) == (0, 1)
    receiver.take([(b"flood", None)] * QUEUE + good, LATE)
    assert (receiver.received, receiver.opener.refused["queue full"]) == (1, 2)


@pytest.mark.parametrize("network", [Network(T, loss=0.4, burst=3, latency=0.1, jitter=0.1), Network(T, loss=0.3)])
def test_messages_share_the_fate_of_the_simulated_ones(network):
    """The newest message that has arrived by each round is the reference's, also if datagrams come in another order."""
    rng = np.random.default_rng(0)
    receiver = Receiver(DESIGN, 0, network, 7, opener())
    links = {p: PlainLink(network, 7, DESIGN.links.index[p, 0]) for p in (1, 3)}
    waiting: list = []
    for number in range(120):
        waiting += [(seal(packed(p, number), RUN, KEY), p) for p in (1, 3)]
        if number % 4 == 3:
            rng.shuffle(waiting)
            receiver.take([(bytes(data), int(p)) for data, p in waiting], number)
            waiting = []
        for link in links.values():
            link.advance()
        receiver.late(number)
        receiver.on_time(number)
        if not waiting:
            assert receiver.newest == {p: link.newest for p, link in links.items()}
    assert receiver.received == 240
    assert 30 < receiver.lost < 130
