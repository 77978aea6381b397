"""Around a message in a datagram: which run it is of, and a tag that only this run's processes can make.

    bytes   what
    1       version
    4       run
    ...     the message (observers/wire.py)
    8       HMAC-SHA256 of all that comes before, with the run's key, cut to 8 bytes

A datagram that isn't what it should be is refused, and counted by its kind. Nothing is unpacked before the tag is
right.
"""

from __future__ import annotations

import hmac
import math
import struct
from collections import Counter
from collections.abc import Iterable
from typing import Literal, get_args

from khop_env.observers import Message, ObserverDesign
from khop_env.observers.fingerprint import fingerprint
from khop_env.observers.wire import header_of

Kind = Literal[
    "stranger",
    "cut",
    "too long",
    "wrong version",
    "old run",
    "wrong tag",
    "not of this fleet",
    "replayed",
    "of the future",
    "not finite",
    "refused by the node",
    "queue full",
]
"""Why a datagram is dropped: of an address or an agent that isn't heard, shorter or longer than that agent's messages,
of another run, and so on; "not finite" are also stamps and distances that can't be, "refused by the node" what
`ObserverNode.receive` refuses, e.g. another estimator, and "queue full" the oldest of too many."""
KINDS: tuple[Kind, ...] = get_args(Kind)

VERSION = 1
OVERHEAD = 13  # bytes
WINDOW = 64  # rounds behind a sender's newest in which a message is still taken, once
_HEADER = struct.Struct("<B4s")
_TAG = 8


class RefusedError(ValueError):
    """A datagram isn't taken.

    Attributes:
        kind: why.
    """

    def __init__(self, kind: Kind) -> None:
        super().__init__(kind)
        self.kind: Kind = kind


def seal(data: bytes, run: bytes, key: bytes) -> bytes:
    """A packed message in its envelope.

    Args:
        data: the message.
        run: 4 bytes, the same for all processes of a run and different in another one.
        key: secret of the run.
    """
    sealed = _HEADER.pack(VERSION, run) + data
    return sealed + hmac.digest(key, sealed, "sha256")[:_TAG]


class Opener:
    """Opens envelopes for one agent, and remembers what came, so that nothing is taken twice.

    Args:
        design: the observers of the whole fleet.
        senders: indices of the agents that are heard, and for each the number of bytes of its messages.
        run: 4 bytes.
        key: secret of the run.
        period: of rounds, in s.
        ahead: rounds that another clock may be ahead.

    Attributes:
        refused: how many datagrams, by kind.
    """

    def __init__(
        self, design: ObserverDesign, senders: dict[int, int], run: bytes, key: bytes, period: float, ahead: int
    ) -> None:
        self._design, self._sizes, self._run, self._key = design, senders, run, key
        self._period, self._ahead = period, ahead
        self._newest, self._seen = dict.fromkeys(senders, -1), dict.fromkeys(senders, 0)
        self.refused: Counter[str] = Counter()

    def start(self, number: int) -> None:
        """Begin with round `number`: what was sent long before isn't taken."""
        self._newest = {sender: max(newest, number - 1) for sender, newest in self._newest.items()}

    def open(self, datagrams: Iterable[tuple[bytes, int | None]], now: int) -> list[tuple[int, Message]]:
        """The messages of datagrams that are as they should be, with the round in which each was sent.

        Args:
            datagrams: each with the index of the agent whose address it came from, None for an unknown one.
            now: the round that this agent is in.
        """
        found = []
        for data, sender in datagrams:
            try:
                found.append(self._opened(data, sender, now))
            except RefusedError as refused:
                self.refused[refused.kind] += 1
        return found

    def _opened(self, data: bytes, sender: int | None, now: int) -> tuple[int, Message]:
        if sender is None or sender not in self._sizes:
            raise RefusedError("stranger")
        if len(data) < OVERHEAD:
            raise RefusedError("cut")
        version, run = _HEADER.unpack_from(data)
        if version != VERSION:
            raise RefusedError("wrong version")
        if run != self._run:
            raise RefusedError("old run")
        if len(data) != self._sizes[sender] + OVERHEAD:
            raise RefusedError("cut" if len(data) < self._sizes[sender] + OVERHEAD else "too long")
        if not hmac.compare_digest(hmac.digest(self._key, data[:-_TAG], "sha256")[:_TAG], data[-_TAG:]):
            raise RefusedError("wrong tag")
        payload = data[_HEADER.size : -_TAG]
        theirs, named = header_of(payload)
        if theirs != fingerprint(self._design):
            raise RefusedError("not of this fleet")
        if named != sender:
            raise RefusedError("stranger")
        try:
            message = Message.unpack(payload, self._design)
        except ValueError:
            raise RefusedError("not finite") from None
        if message.time < 0.0:
            raise RefusedError("not finite")
        number = math.floor(message.time / self._period + 1e-6)
        if number > now + self._ahead:
            raise RefusedError("of the future")
        self._remember(sender, number)
        return number, message

    def _remember(self, sender: int, number: int) -> None:
        """Refuse a round that has come before, or is too old to know."""
        newest = self._newest[sender]
        if number > newest:
            self._seen[sender] = (self._seen[sender] << (number - newest) | 1) & (1 << WINDOW) - 1
            self._newest[sender] = number
            return
        bit = 1 << newest - number
        if newest - number >= WINDOW or self._seen[sender] & bit:
            raise RefusedError("replayed")
        self._seen[sender] |= bit
