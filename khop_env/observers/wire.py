"""Messages between robots, and how they are written into bytes: a header, then numbers in a fixed order.

    bytes   what
    1       version
    1       number format (0 float64, 1 float32, 2 float16), plus 16 with the estimates of the paper's observers
    4       fingerprint of the fleet: models with their parameters, links, k, relay, input observers
    2       sender
    8       time, float64
    then    the sender's state; of each agent within k hops: 1 byte for hops, 0 if nothing is known, the age as float32
            (rounded up; the stamp itself where numbers are float64), its state
    then    (+16) the sender's g; its estimates of states, of inputs; the last g of those that it hears, or NaN
    4       CRC-32 of all that comes before

A message of one agent always has one size. All is little-endian.
"""

from __future__ import annotations

import functools
import math
import struct
import zlib
from collections.abc import Iterable, Mapping
from dataclasses import dataclass, field, fields
from typing import Literal, NamedTuple, get_args

import numpy as np

from khop_env.observers.design import ObserverDesign
from khop_env.observers.fingerprint import fingerprint
from khop_env.observers.layout import FloatArray
from khop_env.physics import or_did_you_mean

EstimatorName = Literal["ppso", "relay"]
"""The paper's observers by rounds of messages, or states that are relayed and predicted."""

NumberFormat = Literal["float64", "float32", "float16"]
"""How numbers are sent."""

VERSION = 1
_HEADER = struct.Struct("<BBIHd")
_CHECKSUM = struct.Struct("<I")
_LETTER = {"float64": "d", "float32": "f", "float16": "e"}
_PPSO = 16


class Known(NamedTuple):
    """The part of a message about another agent.

    Attributes:
        stamp: when that agent measured its state, in s by its clock.
        hops: number of links that this has come over, at most 255.
        state: (n_i,) the state that is predicted for the time of the message.
    """

    stamp: float
    hops: int
    state: FloatArray


@dataclass(frozen=True, eq=False)
class Message:
    """The broadcast of an agent in a round. Agents are indices here; arrays have the length n_i of their agent's state.

    Attributes:
        design: the observers of the whole fleet.
        sender: who sends.
        time: when, in s by its clock.
        state: its own x, as measured.
        known: of other agents that it knows of.
        estimator: of its node.
        input_effect: its own g(u); None unless input observers want it.
        estimates: its estimates of states; empty for the estimator "relay".
        input_estimates: likewise of inputs' effects g.
        heard: the last g that came from each agent that it hears, where others rely on that (relay assumption).
        dtype: format of the numbers; what `unpack` returns has been rounded to it.

    Raises:
        ValueError: for agents or shapes that don't fit the design, or numbers that aren't finite.
    """

    design: ObserverDesign = field(repr=False)
    sender: int
    time: float
    state: FloatArray
    known: Mapping[int, Known]
    estimator: EstimatorName = "relay"
    input_effect: FloatArray | None = None
    estimates: Mapping[int, FloatArray] = field(default_factory=dict)
    input_estimates: Mapping[int, FloatArray] = field(default_factory=dict)
    heard: Mapping[int, FloatArray] = field(default_factory=dict)
    dtype: NumberFormat = "float64"

    def __post_init__(self) -> None:
        form, ids = _form(self.design, self.sender, self.estimator, self.dtype), self.design.fleet.ids
        who = f"message of {ids[self.sender]!r}"
        if not np.isfinite(self.time):
            raise ValueError(f"{who}: time is {self.time!r}; expected seconds")
        _check(self.design, who, "state", {self.sender: self.state})
        if (self.input_effect is not None) != form.input_effect:
            raise ValueError(f"{who}: input_effect is {'missing' if form.input_effect else 'not wanted'}")
        _check(self.design, who, "input_effect", {self.sender: self.input_effect} if form.input_effect else {})
        for name, values, wanted, all_of_them in (
            ("known", {i: known.state for i, known in self.known.items()}, form.known, False),
            ("estimates", self.estimates, form.estimates, True),
            ("input_estimates", self.input_estimates, form.input_estimates, True),
            ("heard", self.heard, form.heard, False),
        ):
            if not set(values) <= set(wanted) or (all_of_them and len(values) != len(wanted)):
                raise ValueError(f"{who}: {name} are of the agents {sorted(values)}; expected {list(wanted)}")
            _check(self.design, who, name, values)
        for i, known in self.known.items():
            if not (np.isfinite(known.stamp) and known.stamp <= self.time and 1 <= known.hops <= 255):
                raise ValueError(
                    f"{who}: about {ids[i]!r} stamp {known.stamp!r} and hops {known.hops!r}; expected a stamp up to "
                    f"the time of the message, {self.time!r}, and 1 to 255 hops"
                )

    def pack(self, dtype: NumberFormat | None = None) -> bytes:
        """The message in bytes.

        Args:
            dtype: format of the numbers; the message's own by default.

        Raises:
            ValueError: for a number that is too large for it.
        """
        dtype = self.dtype if dtype is None else dtype
        form = _form(self.design, self.sender, self.estimator, dtype)
        values: list[float] = [VERSION, form.flags, fingerprint(self.design), self.sender, self.time]
        values += np.asarray(self.state).tolist()  # struct reads Python's floats three times as fast as NumPy's
        for i, n in form.known.items():
            known = self.known.get(i)
            if known is None:
                known = Known(self.time, 0, np.zeros(n))
            stamp = known.stamp
            if dtype != "float64":
                age = np.float32(self.time - stamp)
                # rounded up once more, since the difference was rounded; an age that is too large is safe
                stamp = float(np.nextafter(age, np.float32(np.inf)))
            values += [known.hops, stamp, *np.asarray(known.state).tolist()]
        if form.input_effect and self.input_effect is not None:
            values += np.asarray(self.input_effect).tolist()
        for estimates, order in ((self.estimates, form.estimates), (self.input_estimates, form.input_estimates)):
            for i in order:
                values += np.asarray(estimates[i]).tolist()
        for i, n in form.heard.items():
            values += np.asarray(self.heard[i]).tolist() if i in self.heard else [math.nan] * n
        try:
            data = form.layout.pack(*values)
        except OverflowError:
            largest = max((abs(value) for value in values[5:] if np.isfinite(value)), default=0.0)
            raise ValueError(
                f"message of {self.design.fleet.ids[self.sender]!r}: its largest number is {largest:.6g}, and {dtype} "
                f"ends at {np.finfo(dtype).max:.6g}; send float32 or float64"
            ) from None
        return data + _CHECKSUM.pack(zlib.crc32(data))

    @staticmethod
    def unpack(data: bytes, design: ObserverDesign) -> Message:
        """The message from its bytes.

        Args:
            data: what `pack` returned.
            design: the observers of the fleet, as the sender has them.

        Raises:
            ValueError: for bytes that are cut off, of another version, of another fleet, or damaged.
        """
        least = _HEADER.size + _CHECKSUM.size
        if len(data) < least:
            raise ValueError(f"a message has {least} bytes at least; got {len(data)}")
        version, flags, theirs, sender, _ = _HEADER.unpack_from(data)
        if version != VERSION:
            raise ValueError(f"the message has version {version}, this is version {VERSION}; update the older robot")
        data, checksum = data[: -_CHECKSUM.size], data[-_CHECKSUM.size :]
        if _CHECKSUM.unpack(checksum)[0] != zlib.crc32(data):
            raise ValueError(
                f"the message of {len(data) + _CHECKSUM.size} bytes is damaged or cut off: wrong checksum; drop it"
            )
        if theirs != fingerprint(design):
            raise ValueError(
                f"the message is of another fleet ({theirs:08x}) than {design} ({fingerprint(design):08x}): "
                "models or their parameters, links, k, relay or input observers differ"
            )
        if sender >= len(design.fleet) or flags & ~_PPSO >= len(_LETTER):
            raise ValueError(f"the message is damaged: its sender is {sender}, its format {flags}")
        dtype = get_args(NumberFormat)[flags & ~_PPSO]
        form = _form(design, sender, "ppso" if flags & _PPSO else "relay", dtype)
        if len(data) != form.layout.size:
            raise ValueError(
                f"a message of {design.fleet.ids[sender]!r} has {form.size} bytes in {dtype}; got "
                f"{len(data) + _CHECKSUM.size}"
            )
        _, _, _, _, time, *rest = form.layout.unpack(data)
        numbers, place = np.array(rest, np.float64), 0

        def take(order: Mapping[int, int]) -> dict[int, FloatArray]:
            nonlocal place
            found = {}
            for i, n in order.items():
                found[i] = numbers[place : place + n]
                place += n
            return found

        own = {sender: design.fleet.models[sender].n}
        state, known = take(own)[sender], {}
        for i, n in form.known.items():
            hops, stamp = rest[place], rest[place + 1]
            if hops:
                values = numbers[place + 2 : place + 2 + n]
                known[i] = Known(stamp if dtype == "float64" else time - stamp, hops, values)
            place += 2 + n
        effect = take(own)[sender] if form.input_effect else None
        estimates, input_estimates = take(form.estimates), take(form.input_estimates)
        certain = place  # what comes before is never NaN
        heard = {i: values for i, values in take(form.heard).items() if not np.isnan(values).all()}
        found = design, sender, time, state, known, form.estimator, effect, estimates, input_estimates, heard, dtype
        right = all(map(math.isfinite, [time, *rest[:certain], *np.concatenate([_NOTHING, *heard.values()]).tolist()]))
        if not right or any(each.stamp > time for each in known.values()):
            return Message(*found)  # which says what is wrong
        message = object.__new__(Message)  # shapes and agents are right by construction: not checked once more
        message.__dict__.update(zip(_FIELDS, found, strict=True))
        return message

    @staticmethod
    def size(
        design: ObserverDesign, agent: str | int, estimator: EstimatorName = "ppso", dtype: NumberFormat = "float32"
    ) -> int:
        """Number of bytes of a message.

        Args:
            design: the observers of the fleet.
            agent: the sender, by id or index.
            estimator: of its node.
            dtype: format of the numbers.
        """
        return _form(design, design.fleet.agent(agent), estimator, dtype).size


_FIELDS = tuple(each.name for each in fields(Message))
_NOTHING = np.zeros(0)


def header_of(data: bytes) -> tuple[int, int]:
    """The fingerprint of the fleet and the index of the sender, as a packed message of any fleet says.

    Args:
        data: what `Message.pack` returned.
    """
    _, _, theirs, sender, _ = _HEADER.unpack_from(data)
    return theirs, sender


def rounding(dtype: NumberFormat, largest: FloatArray | float) -> FloatArray:
    """Largest error of rounding numbers up to `largest` in size to `dtype`; of the shape of `largest`."""
    if dtype == "float64":
        return np.zeros(np.shape(largest))
    info = np.finfo(dtype)
    # half a unit in the last place, of a number that isn't too small for all its bits or of one that is
    return 0.5 * (float(info.eps) * np.asarray(largest, np.float64) + float(info.smallest_subnormal))


@dataclass(frozen=True, eq=False)
class _Form:
    """The numbers of an agent's messages in order: agents, and how many numbers are about each."""

    estimator: EstimatorName
    flags: int
    input_effect: bool
    known: Mapping[int, int]
    estimates: Mapping[int, int]
    input_estimates: Mapping[int, int]
    heard: Mapping[int, int]
    layout: struct.Struct

    @property
    def size(self) -> int:
        """Bytes of a message, its checksum included."""
        return self.layout.size + _CHECKSUM.size


@functools.lru_cache(maxsize=1024)
def _form(design: ObserverDesign, sender: int, estimator: EstimatorName, dtype: NumberFormat) -> _Form:
    check_choice("estimator", estimator, get_args(EstimatorName))
    check_choice("dtype", dtype, get_args(NumberFormat))
    sender, ppso = design.fleet.agent(sender), estimator == "ppso"

    def sizes(agents: Iterable[int]) -> dict[int, int]:
        return {i: design.fleet.models[i].n for i in sorted(agents)}

    def pairs(of: Iterable[tuple[int, int]]) -> dict[int, int]:
        return sizes(i for observer, i in of if observer == sender)

    known = pairs(design.knowledge.slot)
    estimates = pairs(design.states.layout.slot) if ppso else {}
    input_estimates = pairs(design.inputs.layout.slot) if ppso else {}
    wanted = set(design.inputs.layout.target.tolist()) if ppso else set()
    heard = sizes(wanted & design.links.senders[sender]) if design.relay else {}
    n, letter = design.fleet.models[sender].n, _LETTER[dtype]
    age = "d" if dtype == "float64" else "f"
    own = n * (1 + (sender in wanted))
    rest = own - n + sum(sum(part.values()) for part in (estimates, input_estimates, heard))
    about_others = "".join(f"B{age}{count}{letter}" for count in known.values())
    layout = struct.Struct(f"{_HEADER.format}{n}{letter}{about_others}{rest}{letter}")
    flags = list(_LETTER).index(dtype) + _PPSO * ppso
    return _Form(estimator, flags, sender in wanted, known, estimates, input_estimates, heard, layout)


def check_choice(name: str, value: object, choices: tuple[str, ...]) -> None:
    """Refuse a `value` of the argument `name` that isn't one of the `choices`.

    Raises:
        ValueError: with the nearest choice.
    """
    if value not in choices:
        raise ValueError(f"{name} must be one of {', '.join(choices)}; got {value!r}{or_did_you_mean(value, choices)}")


def _check(design: ObserverDesign, who: str, what: str, values: Mapping[int, FloatArray | None]) -> None:
    for i, value in values.items():
        found, n = np.asarray(value, np.float64), design.fleet.models[i].n
        if found.shape != (n,) or not all(map(math.isfinite, found.tolist())):  # quicker than NumPy's for few numbers
            raise ValueError(
                f"{who}: {what} of {design.fleet.ids[i]!r} must be {n} finite numbers; got {found.tolist()}"
            )
