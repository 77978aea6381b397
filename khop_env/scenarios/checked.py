"""Reading a TOML table key by key, so that every mistake is named: the file, the key, what was got and expected."""

from __future__ import annotations

import difflib
import types
from collections.abc import Iterable, Mapping
from pathlib import Path
from typing import Any, NoReturn, Union, get_args, get_origin

from khop_env.physics import did_you_mean

REQUIRED: Any = object()
"""The default of a key that has to be given."""


class ScenarioFileError(ValueError):
    """A scenario file that can't be read; the message says where, what was got and what was expected."""


class CheckedTable:
    """A table whose keys are taken one at a time; what is left at the end is refused.

    Args:
        file: where it comes from, for error messages.
        key: its dotted name, "" for the whole file.
        values: its content.
    """

    def __init__(self, file: Path, key: str, values: Mapping[str, Any]) -> None:
        self.file, self.key, self._values = file, key, dict(values)
        self._asked: list[str] = []

    def dotted(self, key: str) -> str:
        """The full name of one of its keys."""
        return f"{self.key}.{key}" if self.key else key

    def refuse(self, key: str, why: str) -> NoReturn:
        """Raise a `ScenarioFileError` about one of its keys, or with key "" about the table itself."""
        name = self.dotted(key) if key else self.key
        raise ScenarioFileError(f"{self.file}: {name}: {why}" if name else f"{self.file}: {why}")

    def take(self, key: str, expected: Any, default: Any = REQUIRED) -> Any:
        """The value of `key`, lists turned into tuples where tuples are expected.

        Args:
            key: within this table.
            expected: a type as annotations write it: int, float (integers will do), bool, str, tuple[float, ...] and
                so on, a union, or Any.
            default: used where the key isn't there.

        Raises:
            ScenarioFileError: if it is missing without a default, or of another type or shape.
        """
        self._asked.append(key)
        if key not in self._values:
            if default is REQUIRED:
                near = difflib.get_close_matches(key, self._values, n=1)
                hint = f"; is {near[0]!r} meant for it?" if near else ""
                self.refuse(key, f"missing; expected {describe(expected)}{hint}")
            return default
        value = self._values.pop(key)
        if not fits(value, expected):
            self.refuse(key, f"got {value!r}, expected {describe(expected)}")
        return _frozen(value) if expected is not dict else value

    def table(self, key: str, default: Any = REQUIRED) -> CheckedTable:
        """The table under `key`."""
        return CheckedTable(self.file, self.dotted(key), self.take(key, dict, default))

    def tables(self, key: str, default: Any = REQUIRED) -> list[CheckedTable]:
        """The array of tables under `key`."""
        self._asked.append(key)
        values = self._values.pop(key, default)
        if values is REQUIRED:
            self.refuse(key, f"missing; expected at least one [[{self.dotted(key)}]] table")
        if (
            not isinstance(values, list)
            or (default is REQUIRED and not values)
            or not all(isinstance(value, dict) for value in values)
        ):
            self.refuse(key, f"got {values!r}, expected tables, each under a line [[{self.dotted(key)}]]")
        return [CheckedTable(self.file, f"{self.dotted(key)}[{i}]", value) for i, value in enumerate(values)]

    def choice(self, key: str, known: Iterable[str]) -> str:
        """The value of `key`, one of the names in `known`."""
        known = list(known)
        name = str(self.take(key, str))
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            self.refuse(key, f"got {name!r}, expected one of {', '.join(map(repr, known))}{hint}")
        return name

    def rest(self) -> dict[str, Any]:
        """All keys not taken yet, lists as tuples; they count as taken."""
        values = {key: _frozen(value) for key, value in self._values.items()}
        self._values.clear()
        return values

    def names(self) -> list[str]:
        """The keys not taken yet."""
        return list(self._values)

    def finish(self) -> None:
        """Refuse what nobody asked for.

        Raises:
            ScenarioFileError: naming the first unknown key and the nearest known one.
        """
        for key, value in self._values.items():
            self.refuse(key, f"unknown key (with the value {value!r}); {did_you_mean(key, self._asked)}")


def fits(value: Any, expected: Any) -> bool:
    """Whether a TOML value is of the annotated type; True isn't a number, 1 is a float, lists are tuples."""
    if expected is Any:
        return True
    origin, inside = get_origin(expected), get_args(expected)
    if origin in (Union, types.UnionType):
        return any(fits(value, one) for one in inside)
    if origin is tuple:
        if not isinstance(value, list | tuple):
            return False
        if inside[-1] is Ellipsis:
            return all(fits(one, inside[0]) for one in value)
        return len(value) == len(inside) and all(fits(one, kind) for one, kind in zip(value, inside, strict=True))
    if expected in (int, float) and isinstance(value, bool):
        return False
    return isinstance(value, int | float if expected is float else expected)


def describe(expected: Any) -> str:
    """The annotated type in words, for error messages."""
    words = {int: "an integer", float: "a number", bool: "true or false", str: "a string", dict: "a table"}
    origin, inside = get_origin(expected), get_args(expected)
    if origin in (Union, types.UnionType):
        return " or ".join(describe(one) for one in inside if one is not type(None))
    if origin is tuple:
        count = "" if inside[-1] is Ellipsis else f"{len(inside)} "
        plural = {int: "integers", float: "numbers", str: "strings", Any: "lists"}.get(
            inside[0], f"[{describe(inside[0])}]"
        )
        return f"a list of {count}{plural}"
    return words.get(expected, "a number or a list")


def _frozen(value: Any) -> Any:
    return tuple(_frozen(one) for one in value) if isinstance(value, list) else value
