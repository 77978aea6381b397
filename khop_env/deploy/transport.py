"""How datagrams get from one process to another: UDP on this machine, or Eclipse Zenoh.

A transport of your own (a radio) needs the three methods of `Transport`; datagrams may get lost, come twice or in
another order. What they hold is nobody's business here (envelope.py).
"""

from __future__ import annotations

import contextlib
import errno
import json
import socket
import time
from collections import deque
from collections.abc import Mapping
from typing import Any, Protocol

from khop_env.extras import how_to_install

LOCAL = "127.0.0.1"
_LARGEST = 65_507  # bytes of a UDP datagram
_MOST = 4096  # datagrams that are read at once, so that a flood doesn't hold up a round
_CONNECTING = 10.0  # s
_BUFFER = 1 << 20  # bytes; the system may allow less

Datagram = tuple[bytes, int | None]
"""What came, and the index of the agent that it came from, None for an unknown one."""


class Transport(Protocol):
    """Sends datagrams to agents, and receives those of others."""

    def send(self, data: bytes, to: int) -> None:
        """Send a datagram to an agent, by its index; it may get lost."""
        ...

    def receive(self) -> list[Datagram]:
        """All that has come since the last call, without waiting."""
        ...

    def close(self) -> None:
        """Release what is held."""
        ...


class UdpTransport:
    """UDP; nothing but this machine is reached unless another interface is asked for.

    Args:
        port: to bind; 0 for a free one.
        host: address of the interface.

    Attributes:
        port: that is bound.

    Raises:
        OSError: if the port is in use; the message names it.
    """

    def __init__(self, port: int = 0, host: str = LOCAL) -> None:
        self._socket = socket.socket(socket.AF_INET, socket.SOCK_DGRAM)
        self._socket.setsockopt(socket.SOL_SOCKET, socket.SO_RCVBUF, _BUFFER)
        self._socket.setblocking(False)
        try:
            self._socket.bind((host, port))
        except OSError as error:
            self._socket.close()
            if error.errno != errno.EADDRINUSE:
                raise
            raise OSError(
                error.errno, f"UDP port {port} of {host} is in use by another process; end it, or take another port"
            ) from None
        self.port: int = self._socket.getsockname()[1]
        self._addresses: dict[int, tuple[str, int]] = {}
        self._agents: dict[tuple[str, int], int] = {}

    def meet(self, ports: Mapping[int, int], host: str = LOCAL) -> None:
        """Say where the other agents are.

        Args:
            ports: by the agents' indices.
            host: their address.
        """
        self._addresses = {agent: (host, port) for agent, port in ports.items()}
        self._agents = {address: agent for agent, address in self._addresses.items()}

    def send(self, data: bytes, to: int) -> None:
        """Send a datagram; one that the system doesn't take is lost."""
        with contextlib.suppress(OSError):  # a full buffer, or an answer that nobody listens there
            self._socket.sendto(data, self._addresses[to])

    def receive(self) -> list[Datagram]:
        """All that has come, up to 4096 datagrams."""
        found: list[Datagram] = []
        for _ in range(_MOST):
            try:
                data, address = self._socket.recvfrom(_LARGEST)
            except BlockingIOError:
                break
            except OSError:  # an answer to what was sent: nobody listens there
                continue
            found.append((data, self._agents.get(address)))
        return found

    def close(self) -> None:
        """Close the socket."""
        self._socket.close()


class ZenohTransport:
    """Eclipse Zenoh: agents as peers that connect to each other directly, over TCP on this machine, without discovery.

    Agent a receives what is put under khop/RUN/a/SENDER. The sender is what that key says; the tag of the envelope
    proves it.

    Args:
        agent: index of this agent.
        run: name of the run, so that two runs don't mix.
        port: to listen at; 0 for a free one.

    Attributes:
        port: to listen at.

    Raises:
        ModuleNotFoundError: without Zenoh.
        OSError: if the port is in use.
    """

    def __init__(self, agent: int, run: str, port: int = 0) -> None:
        try:
            import zenoh
        except ModuleNotFoundError:
            raise ModuleNotFoundError(f"the transport zenoh needs Eclipse Zenoh: {how_to_install('zenoh')}") from None
        self._zenoh, self._agent, self._run = zenoh, agent, run
        with socket.socket(socket.AF_INET, socket.SOCK_STREAM) as probe:
            probe.setsockopt(socket.SOL_SOCKET, socket.SO_REUSEADDR, 1)
            try:
                probe.bind((LOCAL, port))
            except OSError as error:
                raise OSError(error.errno, f"TCP port {port} of {LOCAL} is in use by another process") from None
            self.port: int = probe.getsockname()[1]
        self._come: deque[Datagram] = deque(maxlen=_MOST)
        self._session: Any = None

    def meet(self, ports: Mapping[int, int]) -> None:
        """Listen, and connect to the other agents, which listen at these ports, by their indices.

        That takes a moment, in which what is sent is lost; `wait` until it is over.
        """
        config = self._zenoh.Config()
        config.insert_json5("mode", '"peer"')
        config.insert_json5("listen/endpoints", json.dumps([f"tcp/{LOCAL}:{self.port}"]))
        others = [f"tcp/{LOCAL}:{port}" for agent, port in ports.items() if agent < self._agent]
        config.insert_json5("connect/endpoints", json.dumps(others))
        config.insert_json5("scouting/multicast/enabled", "false")
        config.insert_json5("scouting/gossip/enabled", "false")
        self._session = self._zenoh.open(config)
        self._subscriber = self._session.declare_subscriber(f"khop/{self._run}/{self._agent}/*", self._take)
        names = {agent: f"khop/{self._run}/{agent}/{self._agent}" for agent in ports if agent != self._agent}
        self._publishers = {agent: self._session.declare_publisher(name) for agent, name in names.items()}

    def wait(self) -> None:
        """Wait until all others are connected.

        Raises:
            TimeoutError: after ten seconds; the message has their numbers.
        """
        until = time.monotonic() + _CONNECTING
        while absent := [agent for agent, each in self._publishers.items() if not each.matching_status.matching]:
            if time.monotonic() > until:
                raise TimeoutError(f"agent {self._agent}: no connection to agents {absent} within {_CONNECTING:g} s")
            time.sleep(0.01)

    def _take(self, sample: Any) -> None:
        name = str(sample.key_expr).rpartition("/")[2]
        self._come.append((bytes(sample.payload), int(name) if name.isdecimal() else None))

    def send(self, data: bytes, to: int) -> None:
        """Put a datagram under the receiver's key."""
        self._publishers[to].put(data)

    def receive(self) -> list[Datagram]:
        """All that has come, the newest 4096 at most."""
        found = []
        while self._come:
            found.append(self._come.popleft())
        return found

    def close(self) -> None:
        """Close the session."""
        if self._session is not None:
            self._session.close()
