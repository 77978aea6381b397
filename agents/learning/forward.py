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


NETWORKS: Mapping[str, type[Network]] = {each.kind: each for each in (Mlp,)}
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
