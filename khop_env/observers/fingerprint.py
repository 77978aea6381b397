"""A number by which robots notice that they don't mean the same fleet."""

from __future__ import annotations

import functools
import zlib
from collections.abc import Mapping, Set

import numpy as np

from khop_env.observers.design import ObserverDesign

_DEEPEST = 8  # levels of objects within a model's parameters, of which some may refer to each other


@functools.lru_cache(maxsize=64)
def fingerprint(design: ObserverDesign) -> int:
    """A number that two robots share if they mean the same fleet, links and observers; the same on every machine."""
    links, models = design.links, design.fleet.models
    structure = (
        [(model.type, model.states, model.inputs, _parameters(model)) for model in models],
        links.sender,
        links.receiver,
        int(design.k),
        bool(design.relay),
        [option.input_observer for option in design.options],
    )
    return zlib.crc32(repr(_plain(structure)).encode())


def _parameters(value: object) -> dict[str, object]:
    """The attributes of an object, without what it has computed on demand."""
    cls = value.__class__
    return {
        name: each
        for name, each in sorted(getattr(value, "__dict__", {}).items())
        if not isinstance(getattr(cls, name, None), functools.cached_property)
    }


def _plain(value: object, depth: int = 0) -> object:
    """A value in numbers, texts and lists only, so that its repr is the same in every process."""
    if value is None or isinstance(value, bool | str | bytes):
        return value
    if isinstance(value, int | float | np.generic | np.ndarray):
        array = np.asarray(value)
        return array.astype(np.float64).tolist() if array.dtype.kind in "biuf" else array.tolist()
    if depth > _DEEPEST:
        return value.__class__.__qualname__
    if isinstance(value, Mapping):
        return [[_plain(key, depth + 1), _plain(each, depth + 1)] for key, each in value.items()]
    if isinstance(value, list | tuple):
        return [_plain(each, depth + 1) for each in value]
    if isinstance(value, Set):
        return sorted(repr(_plain(each, depth + 1)) for each in value)
    name = getattr(value, "__qualname__", value.__class__.__qualname__)
    return [name, _plain(_parameters(value), depth + 1)] if hasattr(value, "__dict__") else name
