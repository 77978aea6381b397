"""Named values, from the command line or from TOML files, of the types that functions and dataclasses declare."""

from __future__ import annotations

import difflib
import inspect
import json
import math
import types
from collections.abc import Iterable, Iterator, Mapping, Sequence
from typing import Any, Literal, Union, get_args, get_origin, get_type_hints

import numpy as np
from numpy.typing import ArrayLike

from khop_env.env import Settings
from khop_env.network import NO_NETWORK
from khop_env.physics import did_you_mean
from khop_env.tasks import Task

_PLAIN = {bool: "true or false", int: "an integer", float: "a number", str: "text", type(None): "none"}


class MismatchError(ValueError):
    """A value that isn't of the type that was asked for."""


def environment_arguments(
    texts: Sequence[str] | None, task: Task | type[Task], elsewhere: Mapping[str, str] | None = None
) -> dict[str, Any]:
    """The arguments of an environment from `--env NAME=VALUE` options.

    Args:
        texts: the options' values.
        task: whose arguments are known beside those of `Settings`; of an object, which has its own already, none.
        elsewhere: arguments that an option of the command sets, by the name of the option.

    Raises:
        ValueError: naming the argument, the value, and the type or the nearest name that is known.
    """
    known = environment_types(task)
    for name, option in (elsewhere or {}).items():
        if any(text.partition("=")[0].strip() == name for text in texts or ()):
            raise ValueError(f"--env {name}: this command sets it by {option}")
    found = typed_values(texts or (), "--env", known)
    if "network" in found and found["network"] is None:  # "none" is a network's name; None the scenario's own
        found["network"] = NO_NETWORK
    return found


def environment_types(task: Task | type[Task]) -> dict[str, Any]:
    """The type of every argument that an environment with this task takes."""
    if isinstance(task, Task):
        return get_type_hints(Settings)
    parameters = [each for each in inspect.signature(task).parameters.values() if each.kind != each.VAR_KEYWORD]
    hints: dict[str, Any] = {}
    for owner in (task.__init__, task):  # annotations of an __init__, or the fields of a dataclass
        try:
            hints |= get_type_hints(owner)
        except (NameError, TypeError):  # of a user's own that can't be evaluated here
            continue
    of_task = {each.name: hints.get(each.name, Any) for each in parameters}
    members = {*(get_args(ArrayLike) or [ArrayLike])}  # from NumPy 2.5 on it is the name of a union, not a union
    arrays = {name for name, kind in of_task.items() if members <= {*get_args(kind), kind}}
    return of_task | dict.fromkeys(arrays, list | None) | get_type_hints(Settings)


def typed_values(texts: Iterable[str], option: str, known: Mapping[str, Any]) -> dict[str, Any]:
    """Values of "NAME=VALUE" texts.

    Args:
        texts: as they were written.
        option: where they were, for errors.
        known: type by name.

    Raises:
        ValueError: naming option, name and value, and the type or the nearest name that is known.
    """
    found: dict[str, Any] = {}
    for text in texts:
        name, equals, value = (part.strip() for part in text.partition("="))
        if not equals:
            raise ValueError(f"{option} takes NAME=VALUE; got {text!r}")
        if name not in known:
            raise ValueError(f"{option} {text}: no argument {name!r}; {did_you_mean(name, known)}")
        if name in found:
            raise ValueError(f"{option} sets {name!r} twice")
        found[name] = _from_text(value, known[name], f"{option} {name}")
    return found


def fitting_values(values: Mapping[str, Any], where: str, known: Mapping[str, Any]) -> dict[str, Any]:
    """Values of a file, as their types have them.

    Args:
        values: by name.
        where: they stand, for errors.
        known: type by name.

    Raises:
        ValueError: naming the place, the name, the value, and the type or the nearest name that is known.
    """
    found = {}
    for name, value in values.items():
        if name not in known:
            raise ValueError(f"{where}: no {name!r}; {did_you_mean(name, known)}")
        try:
            found[name] = fitting(value, known[name])
        except MismatchError as error:
            raise ValueError(f"{where}: {name}: {error}; got {value!r}") from error
    return found


def fitting(value: Any, kind: Any) -> Any:
    """A value as its type has it: integers become floats and lists tuples where these are asked for.

    Raises:
        MismatchError: if it isn't of this type.
    """
    origin, parts = get_origin(kind), get_args(kind)
    if kind is Any:
        return value
    if origin is Literal:
        if any(value == part and type(value) is type(part) for part in parts):
            return value
    elif origin in (Union, types.UnionType):
        for part in parts:
            try:
                return fitting(value, part)
            except MismatchError:
                continue
    elif kind is float and isinstance(value, int | float) and not isinstance(value, bool) and math.isfinite(value):
        return float(value)
    elif kind in _PLAIN and kind is not float and type(value) is kind:
        return value
    elif origin is not None and issubclass(origin, Mapping) and isinstance(value, Mapping):
        return {fitting(key, parts[0]): fitting(each, parts[1]) for key, each in value.items()}
    elif kind is list and isinstance(value, list) and _is_array(value):
        return value
    elif isinstance(value, list | tuple) and origin is not None and issubclass(origin, Sequence):
        return tuple(fitting(each, parts[0]) for each in value)
    raise MismatchError(f"expected {type_in_words(kind)}")


def _is_array(value: list[Any]) -> bool:
    try:
        return np.asarray(value).dtype.kind in "iuf"
    except ValueError:  # lists of different lengths
        return False


def type_in_words(kind: Any) -> str:
    """A type as an error message names it."""
    origin, parts = get_origin(kind), get_args(kind)
    if origin is Literal:
        return " or ".join(repr(part) for part in parts)
    if origin in (Union, types.UnionType):
        return " or ".join(dict.fromkeys(type_in_words(part) for part in parts))
    if origin is not None and issubclass(origin, Mapping):
        return 'a mapping such as {"a": "b"}'
    if origin is not None and issubclass(origin, Sequence):
        return "a list such as a+b"
    if kind is list:
        return "a list such as [[0, 0], [1, 0]]"
    return _PLAIN.get(kind, getattr(kind, "__name__", str(kind)))


def _from_text(text: str, kind: Any, what: str) -> Any:
    for value in _readings(text):
        try:
            return fitting(value, kind)
        except MismatchError:
            continue
    names = [part for part in get_args(kind) if isinstance(part, str)]
    nearest = difflib.get_close_matches(text, names, n=1)
    hint = f"; did you mean {nearest[0]!r}?" if nearest else ""
    raise ValueError(f"{what}: expected {type_in_words(kind)}; got {text!r}{hint}")


def _readings(text: str) -> Iterator[Any]:
    """All that a text can mean, the narrowest first."""
    words = {"none": None, "null": None, "true": True, "false": False}
    if text.lower() in words:
        yield words[text.lower()]
    for read in (int, float, json.loads):
        try:
            yield read(text)
        except (ValueError, RecursionError):
            continue
    if "+" in text and all(part.strip() for part in text.split("+")):
        yield [next(_readings(part.strip())) for part in text.split("+")]
    yield text
    yield [next(_readings(text))]
