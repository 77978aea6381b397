"""One link of a network in plain Python: for a process of its own, and the reference for the compiled rounds."""

from __future__ import annotations

from khop_env.network.network import Network
from khop_env.network.randomness import DELAY, EPISODE_ROUND, LOSS, NOISE, plain_uniform


class PlainLink:
    """A directed link, round by round; bit for bit what `Channel` does with it.

    Args:
        network: what happens to messages.
        key: 64-bit key of the environment.
        number: of the link, in the order of `physics.Links`.

    Attributes:
        network: of this episode, without ranges.
        round: the last round, -1 before the first.
        newest: round in which the newest message that has arrived was sent, -1 for none yet.
    """

    def __init__(self, network: Network, key: int, number: int) -> None:
        self.network, self.key, self.number = network.drawn(key), key, number
        self._loss, self._latency = self.network.bounds("loss")[0], self.network.bounds("latency")[0]
        self._jitter = self.network.bounds("jitter")[0]
        self._recovery = None if network.burst is None else 1.0 / self.network.bounds("burst")[0]
        self._bad = plain_uniform(key, EPISODE_ROUND, number, LOSS) < self._loss
        self._flying: list[tuple[int, int]] = []  # (round of arrival, round of sending)
        self.round = self.newest = -1

    def advance(self, up: bool = True) -> int:
        """Run a round, in which a link that isn't `up` loses the message; returns `newest`."""
        arrival = self.send(up)
        if arrival is not None:
            self._flying.append((arrival, self.round))
        arrived = [sent for arrival, sent in self._flying if arrival <= self.round]
        self._flying = [(arrival, sent) for arrival, sent in self._flying if arrival > self.round]
        self.newest = max([self.newest, *arrived])
        return self.newest

    def send(self, up: bool = True) -> int | None:
        """Run a round as `advance` does, for callers that hold messages: the round of arrival; None if it is lost."""
        self.round += 1
        self._bad = plain_uniform(self.key, self.round, self.number, LOSS) < self._probability_of_loss()
        return self.round + self._rounds_late() if up and not self._bad else None

    def _probability_of_loss(self) -> float:
        if self._recovery is None:
            return self._loss
        return 1.0 - self._recovery if self._bad else self._recovery * self._loss / (1.0 - self._loss)

    def _rounds_late(self) -> int:
        u = plain_uniform(self.key, self.round, self.number, DELAY)
        delay = self._latency - self._jitter + 2.0 * self._jitter * u
        return min(self.network.most_rounds_late, self.network.rounds_late(delay))


def plain_noise(network: Network, key: int, number: int, row: int) -> float:
    """Measurement error of component `row` of all states, sent in round `number` of the environment with this `key`."""
    return network.noise * (2.0 * plain_uniform(key, number, row, NOISE) - 1.0)
