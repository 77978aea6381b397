"""Messages in bytes: nothing is lost but digits, sizes are as said, and what is wrong is refused."""

import dataclasses
import os
import struct
import subprocess
import sys
import zlib
from typing import get_args

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from khop_env.observers import Exponential, Known, Message, ObserverDesign
from khop_env.observers.fingerprint import fingerprint
from khop_env.observers.wire import EstimatorName, NumberFormat, rounding
from khop_env.physics import Fleet, SingleIntegrator, SurfaceVessel
from khop_env.registry import scenario
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


def sealed(data: bytes) -> bytes:
    """With its checksum, as a sender that is wrong itself would have packed it."""
    return data + struct.pack("<I", zlib.crc32(data))


def test_what_cannot_be_read_is_refused() -> None:
    design = row()
    data = drawn(design, 0, "ppso", 0).pack()
    for damaged, message in (
        (data[:7], "a message has 20 bytes at least; got 7"),
        (data[:-1], rf"the message of {len(data) - 1} bytes is damaged or cut off: wrong checksum; drop it"),
        (data + b"0", "damaged or cut off"),
        (b"\2" + data[1:], "the message has version 2, this is version 1; update the older robot"),
        (sealed(data[:-12]), rf"a message of 'integrator_0' has {len(data)} bytes in float64; got {len(data) - 8}"),
        (sealed(data[:6] + b"\7" + data[7:-4]), "damaged: its sender is 7"),
        (sealed(data[:1] + b"\x7f" + data[2:-4]), "damaged: .* its format 127"),
        (
            sealed(data[:16] + struct.pack("<d", np.nan) + data[24:-4]),
            "state of 'integrator_0' must be 2 finite numbers",
        ),
        (sealed(data[:8] + struct.pack("<d", np.inf) + data[16:-4]), "time is inf; expected seconds"),
    ):
        with pytest.raises(ValueError, match=message):
            Message.unpack(damaged, design)
    for other in (row(4), row(3, relay=False), row(3, k=3)):
        with pytest.raises(ValueError, match=r"the message is of another fleet \(.*parameters, links, k, relay or"):
            Message.unpack(data, other)


@given(seed=SEEDS)
def test_a_flipped_bit_is_refused(seed: int) -> None:
    design, rng = row(), np.random.default_rng(seed)
    data = bytearray(drawn(design, 1, "ppso", seed).pack(rng.choice(get_args(NumberFormat))))
    place = int(rng.integers(len(data)))
    data[place] ^= 1 << int(rng.integers(8))
    with pytest.raises(ValueError, match="version" if place == 0 else "wrong checksum"):
        Message.unpack(bytes(data), design)


@settings(max_examples=200)
@given(seed=SEEDS)
def test_any_bytes_are_a_message_or_a_value_error(seed: int) -> None:
    design, rng = row(), np.random.default_rng(seed)
    data = bytearray(drawn(design, 1, "ppso", seed).pack(rng.choice(get_args(NumberFormat))))
    data[rng.integers(len(data))] ^= 1 << int(rng.integers(8))
    try:
        message = Message.unpack(sealed(bytes(data[:-4])), design)
    except ValueError:
        return
    assert np.isfinite(np.concatenate(arrays(message))).all()


def of_fleet(*models) -> ObserverDesign:
    return ObserverDesign(
        Fleet(models), nx.path_graph(len(models)), 2, Exponential(9, 1, 1), Exponential(9, 1, 1), design_rule="sharp"
    )


def test_fingerprints_tell_parameters_apart() -> None:
    base = fingerprint(of_fleet(*[SingleIntegrator(2, input_limit=6)] * 3))
    assert base == fingerprint(of_fleet(*[SingleIntegrator(2, input_limit=6.0)] * 3))
    for other in (SingleIntegrator(2, input_limit=0.1), SingleIntegrator(2, input_limit=(6.0, 5.0))):
        assert fingerprint(of_fleet(*[SingleIntegrator(2, input_limit=6)] * 2, other)) != base
    vessels = [SurfaceVessel(quadratic_drag=(drag, 36.3, 0.75)) for drag in (1.33, 1.4)]
    assert len({fingerprint(of_fleet(vessel, vessel)) for vessel in vessels}) == 2


def test_fingerprints_are_the_same_in_every_process() -> None:
    """Strings hash differently there, and objects lie elsewhere in memory."""
    program = (
        "from khop_env.observers.wire import fingerprint; from khop_env.registry import scenario; "
        "print(fingerprint(scenario('mixed_fleet').design))"
    )
    found = [
        subprocess.run([sys.executable, "-c", program], env=os.environ | {"PYTHONHASHSEED": seed}, capture_output=True)
        for seed in "12"
    ]
    assert [int(each.stdout) for each in found] == [fingerprint(scenario("mixed_fleet").design)] * 2


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
