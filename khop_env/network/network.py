"""A communication network as six numbers or ranges: how often agents send, and what becomes of their messages."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from typing import Any

from khop_env.network.randomness import EPISODE, EPISODE_ROUND, plain_uniform
from khop_env.network.reading import Span, number, number_or_range, parsed
from khop_env.physics import did_you_mean

MOST_ROUNDS_LATE = 4096

DRAWN = ("loss", "latency", "burst", "jitter")
"""What may be a range: an episode's random numbers in this order."""

NO_NETWORK = "none"
"""Name of exchange in continuous time, where None stands for "as the scenario has it"."""


@dataclass(frozen=True)
class Network:
    """Every `period` seconds each agent broadcasts a message; every directed link loses it or delivers it late.

    Losses follow the Gilbert-Elliott model: a link in its good state delivers, in its bad state loses; from one message
    to the next good turns bad with probability loss / (burst (1 - loss)), and bad turns good with 1 / burst.

    `loss`, `burst`, `latency` and `jitter` may be ranges (low, high). From each of them every episode draws one value,
    uniformly, for all its links. Every combination of values has to be a network.

    Source: E. N. Gilbert, Capacity of a burst-noise channel, Bell System Technical Journal 39, 1960.

    Attributes:
        period: between two messages of an agent, in s.
        loss: mean share of lost messages, from 0 to 1.
        burst: mean number of messages lost in a row; None for independent losses, which is 1 / (1 - loss).
        latency: mean time from sending to delivery, in s.
        jitter: largest deviation from `latency`, in s; delays are uniform within it, and messages may overtake.
        noise: largest measurement error of each state that is sent, in the state's unit; uniform.

    Raises:
        ValueError: for a number out of range, bursts too short for so many losses, or messages that are late by more
            than 4096 periods.
    """

    period: float = 0.05
    loss: Span = 0.0
    burst: Span | None = None
    latency: Span = 0.0
    jitter: Span = 0.0
    noise: float = 0.0

    def __post_init__(self) -> None:
        for name in ("period", "noise"):
            object.__setattr__(self, name, number(getattr(self, name), f"Network.{name}"))
        for name in DRAWN:
            if name != "burst" or self.burst is not None:
                object.__setattr__(self, name, number_or_range(getattr(self, name), f"Network.{name}"))
        if not 0.0 < self.period < math.inf:
            raise ValueError(f"Network.period must be positive and finite, in s; got {self.period!r}")
        low, high = self.bounds("loss")
        if not 0.0 <= low <= high <= 1.0:
            raise ValueError(f"Network.loss must be from 0 to 1 (30 % are 0.3); got {self.loss!r}")
        if self.burst is not None:
            short, long = self.bounds("burst")
            if not 1.0 <= short <= long < math.inf:
                raise ValueError(f"Network.burst must be a mean number of messages, at least 1; got {self.burst!r}")
            if high > short / (1.0 + short) * (1.0 + 1e-9):
                shortest = f"{math.ceil(1e3 * high / (1.0 - high) - 1e-6) / 1e3:g} or more" if high < 1.0 else "None"
                drawn = {"loss", "burst"} & set(self.ranges)
                every = " (every value of a range has to fit all others)" if drawn else ""
                raise ValueError(
                    f"Network.burst = {short:g} is too short for a loss of {high:g}, even with one message "
                    f"delivered between bursts: take {shortest}{every}"
                )
        (low, high), (least, most) = self.bounds("latency"), self.bounds("jitter")
        for name, ends in (("jitter", (least, most)), ("noise", (self.noise,))):
            if not all(0.0 <= each < math.inf for each in ends):
                raise ValueError(f"Network.{name} must be finite and not negative; got {getattr(self, name)!r}")
        if not most <= low <= high < math.inf:
            raise ValueError(
                f"Network.latency must be finite and at least the jitter of {most:g} s, or messages would come "
                f"before they are sent; got {self.latency!r}"
            )
        if self.rounds_late(high + most) > MOST_ROUNDS_LATE:
            raise ValueError(
                f"Network.latency and jitter delay messages by up to {high + most:g} s, which are more than "
                f"{MOST_ROUNDS_LATE} periods of {self.period:g} s; take a longer period"
            )

    @staticmethod
    def of(network: str | Mapping[str, object] | Network | None) -> Network | None:
        """A network as users write it.

            Network.of("wifi")
            Network.of("lossy:period=0.1,loss=0.1..0.3,burst=5")    # a profile with other numbers; a range
            Network.of("random:loss=0..0.7,burst=3..8")             # of this profile everything is drawn
            Network.of({"profile": "lossy", "loss": [0.1, 0.3]})    # a table of a scenario file
            Network.of("none")                                      # no messages: exchange in continuous time

        Args:
            network: a profile of `PROFILES` by name, with other values after a colon; a mapping of values, to `ideal`
                if no profile is named; a network; "none" or None for no messages.

        Raises:
            ValueError: for an unknown profile or key, or a value that isn't right.
        """
        if network is None or isinstance(network, Network):
            return network
        if network == NO_NETWORK:
            return None
        if isinstance(network, Mapping):
            values = dict(network)
            return _changed(values.pop("profile", "ideal"), values, ("profile",))
        if not isinstance(network, str):
            raise ValueError(f"a network is a name like 'wifi', a Network, a mapping or None; got {network!r}")
        name, colon, text = network.partition(":")
        values = {}
        for part in text.split(",") if colon else []:
            key, equals, value = (word.strip() for word in part.partition("="))
            if not equals or key in values:
                problem = "a key that was there already" if equals else "no key=value"
                raise ValueError(
                    f"network {network!r}: {part.strip()!r} is {problem}; write e.g. 'lossy:loss=0.3,burst=5'"
                )
            values[key] = parsed(value, f"network {network!r}: {key}")
        return _changed(name.strip(), values)

    def bounds(self, name: str) -> tuple[float, float]:
        """Lowest and highest value of `name`, "loss", "burst" (unless it is None), "latency" or "jitter"."""
        value = getattr(self, name)
        return value if isinstance(value, tuple) else (value, value)

    @property
    def ranges(self) -> dict[str, tuple[float, float]]:
        """What is drawn in each episode, by name: lowest and highest value."""
        return {name: self.bounds(name) for name in DRAWN if isinstance(getattr(self, name), tuple)}

    def drawn(self, key: int) -> Network:
        """The network of one episode: in place of each range the value that is drawn from it.

        Args:
            key: 64-bit key of the episode's randomness, as in the memory of `Channel`.
        """
        found: dict[str, Any] = {}
        for name, (low, high) in self.ranges.items():
            u = plain_uniform(key, EPISODE_ROUND, DRAWN.index(name), EPISODE)
            found[name] = min(high, low + (high - low) * u)
        return replace(self, **found) if found else self

    def rounds_late(self, delay: float) -> int:
        """Rounds from sending until a message that takes `delay` seconds can be used: rounded up, to 1e-9 of one."""
        return math.ceil(delay / self.period - 1e-9)

    @property
    def most_rounds_late(self) -> int:
        """Rounds until the latest message can be used."""
        return self.rounds_late(self.bounds("latency")[1] + self.bounds("jitter")[1])

    @property
    def fewest_rounds_late(self) -> int:
        """Rounds until the earliest message can be used."""
        return self.rounds_late(self.bounds("latency")[0] - self.bounds("jitter")[1])

    def described(self) -> str:
        """One line: "a message every 50 ms, 30 % lost in bursts of 5, 30 +- 5 ms late"."""
        low, high = (100.0 * value for value in self.bounds("loss"))
        parts = [f"a message every {1e3 * self.period:g} ms", f"{_span(low, high)} % lost" if high else "none lost"]
        if high and self.burst is not None:
            parts[-1] += f" in bursts of {_span(*self.bounds('burst'))}"
        low, high = (1e3 * value for value in self.bounds("latency"))
        if high:
            least, most = (1e3 * value for value in self.bounds("jitter"))
            parts.append(f"{_span(low, high)}{f' +- {_span(least, most)}' if most else ''} ms late")
        if self.noise:
            parts.append(f"noise up to {self.noise:g}")
        return ", ".join(parts)


def _changed(profile: object, values: Mapping[str, object], others: tuple[str, ...] = ()) -> Network:
    """A profile with other values; `others` are keys that were read before, for hints."""
    if not isinstance(profile, str) or profile not in PROFILES:
        raise ValueError(f"no network {profile!r}; {did_you_mean(profile, PROFILES)}")
    known = [field.name for field in fields(Network)]
    for key in values:
        if key not in known:
            raise ValueError(f"network {profile!r}: no key {key!r}; {did_you_mean(key, (*others, *known))}")
    return replace(PROFILES[profile], **values)  # type: ignore[arg-type]


def _span(low: float, high: float) -> str:
    return f"{low:g}" if low == high else f"{low:g} to {high:g}"


PROFILES: dict[str, Network] = {
    # A message every 50 ms and nothing else: sampling alone.
    "ideal": Network(),
    # Motion control over 5G: 3GPP TS 22.104, requirements of cyber-physical control applications.
    "urllc": Network(latency=0.001, loss=1e-6),
    # The next four are round figures of ours, from a wired plant to a wireless channel at its capacity.
    "factory": Network(latency=0.005, jitter=0.0001, loss=1e-4),
    "wifi": Network(latency=0.010, jitter=0.001, loss=1e-2),
    "lossy": Network(latency=0.030, jitter=0.005, loss=1e-2),
    "saturation": Network(latency=0.100, jitter=0.010, loss=0.1),
    # Seven robots with ESP-NOW indoors, "below 40 ms", "above 92 %": doi.org/10.18280/jesa.590507.
    "espnow": Network(latency=0.040, loss=0.08),
    # A crowded Crazyradio channel without acknowledgements; figures of ours.
    "crazyradio": Network(latency=0.026, loss=0.3),
    # For trainings: each episode draws a network, from nearly perfect to worse than most of the above.
    "random": Network(loss=(0.0, 0.5), burst=(1.0, 8.0), latency=(0.01, 0.1), jitter=(0.0, 0.005)),
}
"""Networks by name; `khop network` measures those that are the same in every episode."""
