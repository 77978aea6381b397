"""What a simulated network does to real messages: losses and delays, made at the receiver.

Each message's fate follows from the network's key, its round and its link by the hash that the simulator uses
(network/randomness.py), so that the same messages are lost, and late by as many rounds, as there.
"""

from __future__ import annotations

from collections import deque

from khop_env.deploy.envelope import WINDOW, Opener
from khop_env.deploy.transport import Datagram
from khop_env.network import Network, PlainLink
from khop_env.observers import Message, ObserverDesign

QUEUE = 1024  # datagrams; of more that wait at once the oldest are dropped


class Receiver:
    """The messages that reach one agent, round by round.

    Args:
        design: the observers of the whole fleet.
        agent: index of the agent.
        network: what happens to messages.
        key: 64-bit key of the network's randomness.
        opener: of envelopes.

    Attributes:
        received: messages that came and were what they should be, lost ones included.
        lost: those that the network lost.
        newest: by sender, the round of the newest message that was handed out; -1 before the first.
    """

    def __init__(self, design: ObserverDesign, agent: int, network: Network, key: int, opener: Opener) -> None:
        self._senders = sorted(design.links.senders[agent])
        links = {sender: PlainLink(network, key, design.links.index[sender, agent]) for sender in self._senders}
        self._links, self.opener = links, opener
        self._arrivals: dict[int, dict[int, int | None]] = {sender: {} for sender in self._senders}
        self._held: dict[int, dict[int, Message]] = {sender: {} for sender in self._senders}
        self._come = dict.fromkeys(self._senders, -1)
        self._kept = WINDOW + network.most_rounds_late
        self.newest = dict.fromkeys(self._senders, -1)
        self.received = self.lost = 0

    def take(self, datagrams: list[Datagram], now: int) -> None:
        """Open what came in round `now`, and hold it until it arrives."""
        queue = deque(datagrams, maxlen=QUEUE)
        if len(datagrams) > QUEUE:
            self.opener.refused["queue full"] += len(datagrams) - QUEUE
        for number, message in self.opener.open(queue, now):
            self.received += 1
            self._come[message.sender] = max(self._come[message.sender], number)
            if self._arrival(message.sender, number) is None:
                self.lost += 1
            else:
                self._held[message.sender][number] = message

    def complete(self, now: int) -> bool:
        """Return True if everybody's message of round `now` has come, lost or not."""
        return all(number >= now for number in self._come.values())

    def missing(self, now: int) -> list[int]:
        """Agents whose message of round `now` hasn't come."""
        return [sender for sender, number in self._come.items() if number < now]

    def late(self, now: int) -> list[Message]:
        """Messages of earlier rounds that arrive by round `now`, of each sender the newest, before this round's."""
        return [message for sender in self._senders for message in self._newest(sender, now, now - 1)]

    def on_time(self, now: int) -> list[Message]:
        """The rest of the messages that have arrived by round `now`, of each sender the newest."""
        return [message for sender in self._senders for message in self._newest(sender, now, now)]

    def _newest(self, sender: int, now: int, last: int) -> list[Message]:
        """The newest message that was sent until round `last` and arrives by `now`, if it is new."""
        held, arrivals = self._held[sender], self._arrivals[sender]
        chosen = -1
        for number in held:
            arrival = arrivals.get(number)
            if number <= last and arrival is not None and arrival <= now:
                chosen = max(chosen, number)
        if chosen < 0:
            return []
        message = held[chosen]
        self._held[sender] = {number: each for number, each in held.items() if number > chosen}
        if chosen <= self.newest[sender]:
            return []
        self.newest[sender] = chosen
        return [message]

    def _arrival(self, sender: int, number: int) -> int | None:
        """The round in which the message of round `number` arrives, None for one that is lost."""
        link, arrivals = self._links[sender], self._arrivals[sender]
        while link.round < number:
            arrival = link.send()
            arrivals[link.round] = arrival
            arrivals.pop(link.round - self._kept, None)
        return arrivals.get(number)
