"""Networks of learned policies in plain NumPy: forward passes, and their arrays in policy files."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import ClassVar, Protocol

import numpy as np

from agents.learning.archive import ArchiveError
from khop_env.env.layout import Float32Array

Layers = tuple[tuple[Float32Array, Float32Array], ...]
"""(weight (out, in), bias (out,)) of each layer; ReLU between them."""

Memory = tuple[Float32Array, ...] | None
"""What a network keeps from one call to the next, (..., width) each; None at the beginning, and without memory."""


class Network(Protocol):
    """A function from features to outputs, of any number of rows.

    Attributes:
        kind: its name in files, which is that of the setting `policy`.
    """

    kind: ClassVar[str]

    @property
    def layers(self) -> Layers:
        """Those of which the last one gives the outputs."""
        ...

    def __call__(self, features: Float32Array, memory: Memory) -> tuple[Float32Array, Memory]:
        """Outputs, and the memory for the next call.

        Args:
            features: (..., F) from `ObservationScaler`; not changed.
            memory: that the previous call returned for the same rows; None at the beginning.

        Returns:
            (..., m), and the memory; None for networks without one.
        """
        ...

    def arrays(self) -> dict[str, Float32Array]:
        """All arrays, by their names in a file."""
        ...

    @classmethod
    def read(cls, arrays: Mapping[str, np.ndarray], name: str, layers: int, inputs: int, outputs: int) -> Network:
        """The network in a file.

        Args:
            arrays: all of the file, which somebody else may have written.
            name: of the network; its arrays are called "NAME/...".
            layers: number of `layers`.
            inputs: number of features.
            outputs: number of outputs.

        Raises:
            ArchiveError: if shapes, types or values don't fit.
            KeyError: if an array is missing.
        """
        ...


@dataclass(frozen=True, eq=False)
class Mlp:
    """A multilayer perceptron.

    Attributes:
        layers: at least one.
    """

    kind: ClassVar[str] = "mlp"
    layers: Layers

    def __call__(self, features: Float32Array, memory: Memory) -> tuple[Float32Array, Memory]:
        """Outputs (..., m), and no memory."""
        return applied(self.layers, features), None

    def arrays(self) -> dict[str, Float32Array]:
        """All arrays, by their names in a file."""
        return named(self.layers)

    @classmethod
    def read(cls, arrays: Mapping[str, np.ndarray], name: str, layers: int, inputs: int, outputs: int) -> Mlp:
        """The network in a file, as `Network.read`."""
        return cls(read_layers(arrays, name, layers, inputs, outputs))


@dataclass(frozen=True, eq=False)
class Attention:
    """Attention over slots, as in `agents.learning.attention.SlotAttention`, and layers after it.

    Attributes:
        encoder: (weight (width, slot + own), bias (width,)).
        scores: (heads, width) weight of the scores.
        layers: of which the first takes the own features and the averages, own + width.
    """

    encoder: tuple[Float32Array, Float32Array]
    scores: Float32Array
    layers: Layers
    kind: ClassVar[str] = "attention"

    @property
    def own(self) -> int:
        """Number of own features, which come first; those of the slots follow."""
        return int(self.layers[0][0].shape[1] - self.scores.shape[1])

    def __call__(self, features: Float32Array, memory: Memory) -> tuple[Float32Array, Memory]:
        """Outputs (..., m), and no memory."""
        weight, bias = self.encoder
        rows, width = features.shape[:-1], weight.shape[1] - self.own
        own, slots = features[..., : self.own], features[..., self.own :].reshape(*rows, -1, width)
        valid = slots[..., :1] > 0.5
        beside = np.broadcast_to(own[..., None, :], (*slots.shape[:-1], self.own))
        encoded = np.concatenate([np.where(valid, slots, np.float32(0.0)), beside], axis=-1) @ weight.T + bias
        np.maximum(encoded, 0.0, out=encoded)
        scores = np.where(valid, encoded @ self.scores.T, np.float32(-np.inf))
        most = np.where(valid.any(axis=-2, keepdims=True), scores.max(axis=-2, keepdims=True), np.float32(0.0))
        weights = np.exp(scores - most)
        weights /= np.maximum(weights.sum(axis=-2, keepdims=True), 1.0)  # below 1 without valid slots: all are 0
        shares = encoded.reshape(*scores.shape, -1) * weights[..., None]
        return applied(self.layers, np.concatenate([own, shares.sum(axis=-3).reshape(*rows, -1)], axis=-1)), None

    def arrays(self) -> dict[str, Float32Array]:
        """All arrays, by their names in a file."""
        weight, bias = self.encoder
        return {"encoder/weight": weight, "encoder/bias": bias, "scores": self.scores, **named(self.layers)}

    @classmethod
    def read(cls, arrays: Mapping[str, np.ndarray], name: str, layers: int, inputs: int, outputs: int) -> Attention:
        """The network in a file, as `Network.read`; `inputs` are the own features and those of one slot."""
        heads, width = (*arrays[f"{name}/scores"].shape, 0, 0)[:2]
        scores = numbers(arrays, f"{name}/scores", (heads, width))
        require(heads > 0 and width > 0 and width % heads == 0, f"{name}/scores has shape {scores.shape}")
        encoder = numbers(arrays, f"{name}/encoder/weight", (width, inputs))
        first = arrays[f"{name}/0/weight"].shape
        own = first[1] - width if len(first) == 2 else 0
        require(0 < own < inputs, f"{name}/0/weight has shape {first}")
        bias = numbers(arrays, f"{name}/encoder/bias", (width,))
        return cls((encoder, bias), scores, read_layers(arrays, name, layers, own + width, outputs))


@dataclass(frozen=True, eq=False)
class Recurrent:
    """Layers with an LSTM before the last one, which makes the outputs from what it remembers.

    The LSTM is PyTorch's, with one bias instead of two: S. Hochreiter and J. Schmidhuber, Long short-term memory,
    Neural Computation 9(8), 1997, with the forget gate of F. A. Gers, J. Schmidhuber and F. Cummins, 2000.

    Attributes:
        layers: one or more; ReLU after each but the last.
        lstm: weights of its inputs (4 W, in) and of its own last output (4 W, W), and bias (4 W,), each of the input
            gate, the forget gate, the candidate and the output gate.
    """

    kind: ClassVar[str] = "recurrent"
    layers: Layers
    lstm: tuple[Float32Array, Float32Array, Float32Array]

    def __call__(self, features: Float32Array, memory: Memory) -> tuple[Float32Array, Memory]:
        """Outputs (..., m), and the memory: the LSTM's output and its cell, (..., W) each."""
        inputs = features
        for weight, bias in self.layers[:-1]:
            inputs = np.maximum(inputs @ weight.T + bias, 0.0)
        nothing = np.zeros((*features.shape[:-1], len(self.lstm[2]) // 4), np.float32)
        before, cell = memory or (nothing, nothing)
        # gate by gate: BLAS shares larger products between threads, which wait for each other on a busy machine
        parts = zip(*(np.split(each, 4) for each in self.lstm), strict=True)
        gates = [inputs @ weight.T + before @ own.T + bias for weight, own, bias in parts]
        cell = _sigmoid(gates[1]) * cell + _sigmoid(gates[0]) * np.tanh(gates[2])
        output = _sigmoid(gates[3]) * np.tanh(cell)
        return applied(self.layers[-1:], output), (output, cell)

    def arrays(self) -> dict[str, Float32Array]:
        """All arrays, by their names in a file."""
        return named(self.layers) | dict(zip(_LSTM, self.lstm, strict=True))

    @classmethod
    def read(cls, arrays: Mapping[str, np.ndarray], name: str, layers: int, inputs: int, outputs: int) -> Recurrent:
        """The network in a file, as `Network.read`."""
        first = read_layers(arrays, name, layers - 1, inputs)
        width = len(np.atleast_1d(arrays[f"{name}/{layers - 1}/weight"]).T)
        shapes = (4 * width, len(first[-1][1]) if first else inputs), (4 * width, width), (4 * width,)
        lstm = [numbers(arrays, f"{name}/{part}", shape) for part, shape in zip(_LSTM, shapes, strict=True)]
        last = numbers(arrays, f"{name}/{layers - 1}/weight", (outputs, width))
        layer = last, numbers(arrays, f"{name}/{layers - 1}/bias", (outputs,))
        return cls((*first, layer), (lstm[0], lstm[1], lstm[2]))


_LSTM = ("lstm/from_inputs", "lstm/from_before", "lstm/bias")  # in a file


def _sigmoid(values: Float32Array) -> Float32Array:
    """By tanh, which can't overflow."""
    half = np.float32(0.5)
    return half * np.tanh(half * values) + half


NETWORKS: Mapping[str, type[Network]] = {each.kind: each for each in (Mlp, Attention, Recurrent)}
"""Networks by kind."""


def applied(layers: Layers, values: Float32Array) -> Float32Array:
    """Outputs (..., out) of layers for (..., in); ReLU between them, and nothing after the last."""
    for number, (weight, bias) in enumerate(layers):
        values = values @ weight.T + bias
        if number < len(layers) - 1:
            np.maximum(values, 0.0, out=values)
    return values


def named(layers: Layers) -> dict[str, Float32Array]:
    """The arrays of layers, by the names that `read_layers` looks for."""
    found = {}
    for number, (weight, bias) in enumerate(layers):
        found[f"{number}/weight"], found[f"{number}/bias"] = weight, bias
    return found


def read_layers(
    arrays: Mapping[str, np.ndarray], name: str, count: int, inputs: int, outputs: int | None = None
) -> Layers:
    """Layers from a file, with their shapes checked against each other.

    Args:
        arrays: all of the file.
        name: the layers' arrays are called "NAME/0/weight" and so on.
        count: number of layers.
        inputs: of the first layer.
        outputs: of the last layer; None for any number.

    Raises:
        ArchiveError: if they don't fit.
        KeyError: if an array is missing.
    """
    layers, width = [], inputs
    for number in range(count):
        place = f"{name}/{number}"
        size = outputs if number == count - 1 else None
        size = len(np.atleast_1d(arrays[f"{place}/bias"])) if size is None else size
        weight = numbers(arrays, f"{place}/weight", (size, width))
        layers.append((weight, numbers(arrays, f"{place}/bias", (size,))))
        width = size
    return tuple(layers)


def numbers(arrays: Mapping[str, np.ndarray], name: str, shape: tuple[int, ...]) -> Float32Array:
    """An array of finite float32.

    Raises:
        ArchiveError: if it is something else, or its shape another one.
        KeyError: if it is missing.
    """
    array = arrays[name]
    require(array.dtype == np.float32, f"{name} has dtype {array.dtype}; expected float32")
    require(array.shape == shape, f"{name} has shape {array.shape}; expected {shape}")
    require(bool(np.isfinite(array).all()), f"{name} isn't finite")
    return array


def require(condition: bool, wrong: str) -> None:
    """Refuse a file that doesn't meet a condition.

    Raises:
        ArchiveError: with `wrong` as its message.
    """
    if not condition:
        raise ArchiveError(wrong)
