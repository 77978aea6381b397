"""Messages in bytes: nothing is lost but digits, sizes are as said, and what is wrong is refused."""

import dataclasses
import struct
from typing import get_args

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from khop_env.observers import Exponential, Known, Message, ObserverDesign
from khop_env.observers.wire import EstimatorName, NumberFormat, rounding
from khop_env.physics import Fleet, SingleIntegrator
from tests.strategies import SEEDS, System, systems


def drawn(design: ObserverDesign, sender: int, estimator: EstimatorName, seed: int) -> Message:
    """A message with random numbers, about some of the agents."""
    rng, models = np.random.default_rng(seed), design.fleet.models
    ppso, time = estimator == "ppso", rng.uniform(0.0, 100.0)

    def values(agents) -> dict[int, np.ndarray]:
        return {i: rng.normal(size=models[i].n) * 10.0 ** rng.integers(-3, 3) for i in agents}

    def of(layout, some: float = 1.0) -> list[int]:
        return sorted(i for a, i in layout.slot if a == sender and rng.random() < some)

    known = {
        i: Known(time - rng.choice([0.0, 0.05, 7.3]), int(rng.integers(1, 9)), state)
        for i, state in values(of(design.knowledge, 0.7)).items()
    }
    inputs = set(design.inputs.layout.target.tolist()) if ppso else set()
    return Message(
        design,
        sender,
        time,
        values([sender])[sender],
        known,
        estimator,
        values([sender])[sender] if sender in inputs else None,
        values(of(design.states.layout)) if ppso else {},
        values(of(design.inputs.layout)) if ppso else {},
        values(sorted(inputs & design.links.senders[sender])[:1]) if design.relay else {},
    )


def arrays(message: Message) -> list[np.ndarray]:
    parts = [{i: known.state for i, known in message.known.items()}]
    parts += [message.estimates, message.input_estimates, message.heard]
    effect = [] if message.input_effect is None else [message.input_effect]
    return [message.state, *effect, *(part[i] for part in parts for i in sorted(part))]


@settings(max_examples=60)
@given(
    system=systems() | systems(directed=True),
    seed=SEEDS,
    estimator=st.sampled_from(get_args(EstimatorName)),
    dtype=st.sampled_from(get_args(NumberFormat)),
)
def test_there_and_back(system: System, seed: int, estimator: EstimatorName, dtype: NumberFormat) -> None:
    design = system.design
    sender = seed % len(design.fleet)
    message = drawn(design, sender, estimator, seed)
    data = message.pack(dtype)
    assert len(data) == Message.size(design, sender, estimator, dtype)
    assert len(data) == Message.size(design, design.fleet.ids[sender], estimator, dtype)
    back = Message.unpack(data, design)
    assert (back.sender, back.time, back.estimator, back.dtype) == (sender, message.time, estimator, dtype)
    for name in ("known", "estimates", "input_estimates", "heard"):
        assert list(getattr(back, name)) == sorted(getattr(message, name))
    assert (back.input_effect is None) == (message.input_effect is None)
    for sent, received in zip(arrays(message), arrays(back), strict=True):
        assert (np.abs(received - sent) <= rounding(dtype, np.abs(sent))).all()
    for i, known in message.known.items():
        assert back.known[i].hops == known.hops
        assert 0.0 <= known.stamp - back.known[i].stamp <= (0.0 if dtype == "float64" else 3e-7 * 7.3)
    assert dtype != "float64" or back.pack() == data


def row(agents: int = 3, k: int = 2, **options: object) -> ObserverDesign:
    models = [SingleIntegrator(2)] * agents
    return ObserverDesign(
        Fleet(models), nx.path_graph(agents), k, Exponential(9, 1, 1), Exponential(9, 1, 1), **options
    )


def test_what_cannot_be_read_is_refused() -> None:
    design = row()
    data = drawn(design, 0, "ppso", 0).pack()
    for damaged, message in (
        (data[:7], "a message has 16 bytes at least; got 7"),
        (data[:-1], r"a message of 'integrator_0' has \d+ bytes in float64; got \d+"),
        (data + b"0", r"a message of 'integrator_0' has \d+ bytes in float64; got \d+"),
        (b"\2" + data[1:], "the message has version 2, this is version 1; update the older robot"),
        (data[:6] + b"\7" + data[7:], "damaged: its sender is 7"),
        (data[:1] + b"\x7f" + data[2:], "damaged: .* its format 127"),
        (data[:16] + struct.pack("<d", np.nan) + data[24:], "state of 'integrator_0' must be 2 finite numbers"),
        (data[:8] + struct.pack("<d", np.inf) + data[16:], "time is inf; expected seconds"),
    ):
        with pytest.raises(ValueError, match=message):
            Message.unpack(damaged, design)
    for other in (row(4), row(3, relay=False), row(3, k=3)):
        with pytest.raises(ValueError, match=r"the message is of another fleet \(.*models, links, k, relay or input"):
            Message.unpack(data, other)


@settings(max_examples=200)
@given(seed=SEEDS)
def test_damaged_bytes_are_a_message_or_a_value_error(seed: int) -> None:
    design, rng = row(), np.random.default_rng(seed)
    data = bytearray(drawn(design, 1, "ppso", seed).pack(rng.choice(get_args(NumberFormat))))
    data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
    try:
        message = Message.unpack(bytes(data), design)
    except ValueError:
        return
    assert np.isfinite(np.concatenate(arrays(message))).all()


def test_numbers_that_are_too_large_are_refused() -> None:
    design = row()
    message = dataclasses.replace(drawn(design, 0, "relay", 0), state=np.array([1.0, -7e4]))
    with pytest.raises(
        ValueError, match="its largest number is 70000, and float16 ends at 65504; send float32 or float64"
    ):
        message.pack("float16")
    message = dataclasses.replace(message, state=np.array([1.0, 1e39]))
    with pytest.raises(ValueError, match=r"float32 ends at 3\.40282e"):
        message.pack("float32")
    assert Message.unpack(message.pack(), design).state[1] == 1e39
    with pytest.raises(ValueError, match="dtype must be one of float64, float32, float16; got 'float8'"):
        message.pack("float8")


def test_messages_that_do_not_fit_are_refused() -> None:
    design = row()
    message = drawn(design, 0, "ppso", 0)
    for change, words in (
        ({"state": np.zeros(3)}, "state of 'integrator_0' must be 2 finite numbers"),
        ({"input_effect": None}, "input_effect is missing"),
        ({"estimates": {}}, r"estimates are of the agents \[\]; expected \[2\]"),
        ({"known": {0: Known(0.0, 1, np.zeros(2))}}, r"known are of the agents \[0\]; expected \[1, 2\]"),
        ({"known": {1: Known(message.time + 1.0, 1, np.zeros(2))}}, "expected a stamp up to the time of the message"),
        ({"known": {1: Known(0.0, 0, np.zeros(2))}}, "1 to 255 hops"),
        ({"sender": 9}, "no agent 9"),
    ):
        with pytest.raises(ValueError, match=words):
            dataclasses.replace(message, **change)


@given(st.floats(-1e4, 1e4))
def test_the_rounding_of_each_format_is_bounded(value: float) -> None:
    for dtype in get_args(NumberFormat):
        assert abs(float(np.dtype(dtype).type(value)) - value) <= rounding(dtype, abs(value))
    assert rounding("float16", 1.0) < 5e-4
