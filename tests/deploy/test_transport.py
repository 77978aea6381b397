"""Datagrams from here to there: the same tests for every transport that is installed."""

import re
import socket
import time

import pytest

from khop_env.deploy.transport import LOCAL, UdpTransport, ZenohTransport
from tests.deploy.running import NO_ZENOH


def udp(agent: int, port: int = 0):
    return UdpTransport(port)


def zenoh(agent: int, port: int = 0):
    return ZenohTransport(agent, "0badcafe", port)


@pytest.fixture(params=[udp, pytest.param(zenoh, marks=NO_ZENOH)])
def team(request):
    made = [request.param(agent) for agent in range(3)]
    for transport in made:
        transport.meet({agent: other.port for agent, other in enumerate(made)})
    for transport in made:
        if isinstance(transport, ZenohTransport):
            transport.wait()
    yield made
    for transport in made:
        transport.close()


def received(transport, count: int = 1):
    """What has come, as soon as it is `count` datagrams."""
    found, until = [], time.monotonic() + 10.0
    while len(found) < count and time.monotonic() < until:
        found += transport.receive()
        time.sleep(0.005)
    return found


def test_datagrams_reach_whom_they_are_for_and_say_from_whom(team):
    for number in range(5):
        for sender, transport in enumerate(team):
            for to in {0, 1, 2} - {sender}:
                transport.send(b"%d%d%d" % (sender, to, number), to)
    for to, transport in enumerate(team):
        found = received(transport, 10)
        assert sorted(found) == sorted((b"%d%d%d" % (p, to, n), p) for p in {0, 1, 2} - {to} for n in range(5))


def test_receiving_does_not_wait(team):
    began = time.monotonic()
    assert team[0].receive() == []
    assert time.monotonic() - began < 1.0


def test_large_and_empty_datagrams(team):
    for data in (bytes(range(256)) * 20, b""):
        team[0].send(data, 1)
    assert [data for data, _ in received(team[1], 2)] == [bytes(range(256)) * 20, b""]


def test_a_port_in_use_is_named():
    with socket.socket(socket.AF_INET, socket.SOCK_DGRAM) as other:
        other.bind((LOCAL, 0))
        port = other.getsockname()[1]
        with pytest.raises(OSError, match=f"UDP port {port} of {re.escape(LOCAL)} is in use"):
            UdpTransport(port)


def test_nothing_but_this_machine_is_bound():
    transport = UdpTransport()
    assert transport._socket.getsockname()[0] == "127.0.0.1"
    stranger = UdpTransport()
    stranger.meet({0: transport.port})
    stranger.send(b"hello", 0)
    assert received(transport) == [(b"hello", None)]
    for each in (transport, stranger):
        each.close()
