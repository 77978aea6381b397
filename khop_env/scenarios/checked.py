"""Reading of a TOML table key by key, with file, key, value and expected value in every error message."""

from __future__ import annotations

import difflib
import math
import types
from collections.abc import Iterable, Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any, Literal, NoReturn, Union, get_args, get_origin

from khop_env.physics import did_you_mean

REQUIRED: Any = object()
"""The default of a required key."""


_LISTED = 20  # mistakes in one message

LARGEST, SMALLEST = 1e12, 1e-30
"""Magnitudes of finite numbers other than 0 lie between them, in SI units; others are typing errors."""


class ScenarioFileError(ValueError):
    """A scenario file that can't be read; the message has file and key, the value and the expected value."""


class NotedError(ScenarioFileError):
    """A table has mistakes, which are noted already; its reading stops."""


class CheckedTable:
    """A table whose keys are taken one at a time; keys that are left at the end are refused.

    Mistakes are noted and not raised, so that one message can name all of them: `finish` stops the reading of a table
    that has any, `gathering` goes on with the next one, and `raise_mistakes` of the whole file's ends it.

    Args:
        file: path of its file, for error messages.
        key: its dotted name, "" for the whole file.
        values: its content.
        mistakes: the mistakes of the whole file, to which the table adds.
    """

    def __init__(self, file: Path, key: str, values: Mapping[str, Any], mistakes: list[str] | None = None) -> None:
        self.file, self.key, self._values = file, key, dict(values)
        self.mistakes: list[str] = [] if mistakes is None else mistakes
        self._asked: list[str] = []
        self._wrong = self._absent = False

    def dotted(self, key: str) -> str:
        """The full name of one of its keys."""
        key = key if key.isprintable() else repr(key)
        return f"{self.key}.{key}" if self.key else key

    def note(self, key: str, why: str) -> None:
        """Note a mistake in one of its keys, or with key "" in the table itself."""
        self._wrong = True
        if self._absent:
            return  # noted already
        name = self.dotted(key) if key else self.key
        self.mistakes.append(f"{name}: {why}" if name else why)

    def refuse(self, key: str, why: str) -> NoReturn:
        """Note a mistake, and stop reading values that depend on it."""
        self.note(key, why)
        raise NotedError

    @contextmanager
    def gathering(self) -> Iterator[None]:
        """Go on after the block, even if it has mistakes."""
        try:
            yield
        except NotedError:
            self._wrong = True

    @contextmanager
    def built(self, key: str = "") -> Iterator[None]:
        """Note an error of a constructor with the place of its values in the file."""
        try:
            yield
        except ScenarioFileError:
            raise
        except (ValueError, TypeError, OverflowError) as error:
            self.refuse(key, str(error))

    def raise_mistakes(self) -> None:
        """End the reading of a file.

        Raises:
            ScenarioFileError: if there are mistakes; the message has one line for each.
        """
        if len(self.mistakes) == 1:
            raise ScenarioFileError(f"{self.file}: {self.mistakes[0]}")
        if self.mistakes:
            more = len(self.mistakes) - _LISTED
            lines = [*self.mistakes[:_LISTED], *([f"... and {more} more"] if more > 0 else [])]
            raise ScenarioFileError(f"{self.file}: {len(self.mistakes)} mistakes:\n  " + "\n  ".join(lines))

    def take(self, key: str, expected: Any, default: Any = REQUIRED) -> Any:
        """The value of `key`, lists turned into tuples where tuples are expected; or the default if it is wrong.

        Args:
            key: within this table.
            expected: a type as annotations write it: int, float (integers will do), bool, str, tuple[float, ...] and
                so on, a union, or Any.
            default: used if the key is absent.
        """
        self._asked.append(key)
        if key not in self._values:
            if default is REQUIRED:
                near = difflib.get_close_matches(key, self._values, n=1)
                hint = f"; is {near[0]!r} meant for it?" if near else ""
                for misspelt in near:
                    del self._values[misspelt]  # one typing error, one mistake
                self.note(key, f"missing; expected {describe(expected)}{hint}")
            return default
        value = self._values.pop(key)
        if not fits(value, expected):
            self.note(key, f"got {abbreviated(value)}, expected {describe(expected)}")
            return default
        if (number := out_of_range(value)) is not None:
            self.note(
                key,
                f"got {abbreviated(number)}, expected a number of at most {LARGEST:g}, and no smaller than "
                f"{SMALLEST:g}",
            )
            return default
        return _frozen(value) if expected is not dict else value

    def table(self, key: str, default: Any = REQUIRED) -> CheckedTable:
        """The table under `key`; an empty one if it is missing or wrong."""
        value = self.take(key, dict, default)
        table = CheckedTable(self.file, self.dotted(key), {} if value is REQUIRED else value, self.mistakes)
        table._wrong = table._absent = value is REQUIRED
        return table

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
            self.refuse(key, f"got {abbreviated(values)}, expected tables, each under a line [[{self.dotted(key)}]]")
        return [
            CheckedTable(self.file, f"{self.dotted(key)}[{i}]", value, self.mistakes) for i, value in enumerate(values)
        ]

    def choice(self, key: str, known: Iterable[str]) -> str:
        """The value of `key`, one of the names in `known`; nothing else can be read without it."""
        known = list(known)
        name = self.take(key, str)
        if name is REQUIRED:
            raise NotedError
        if name not in known:
            near = difflib.get_close_matches(name, known, n=1)
            hint = f"; did you mean {near[0]!r}?" if near else ""
            self.refuse(key, f"got {abbreviated(name)}, expected one of {', '.join(map(repr, known))}{hint}")
        return name

    def rest(self) -> dict[str, Any]:
        """All keys not taken yet, lists as tuples; they count as taken."""
        return {key: self.take(key, Any) for key in list(self._values)}

    def names(self) -> list[str]:
        """The keys not taken yet."""
        return list(self._values)

    def finish(self) -> None:
        """Note unknown keys with the closest known name, and stop if the table has any mistake."""
        for key, value in self._values.items():
            self.note(key, f"unknown key (with the value {abbreviated(value)}); {did_you_mean(key, self._asked)}")
        self._values.clear()
        if self._wrong:
            raise NotedError


def abbreviated(value: Any) -> str:
    """Text of a value of the file for an error message, at most one line."""
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) > LARGEST:
        return f"an integer of about 10^{int(value.bit_length() * math.log10(2.0))}"
    if isinstance(value, list | tuple):
        text = f"[{', '.join(abbreviated(entry) for entry in value[:9])}{', ...' if len(value) > 9 else ''}]"
    else:
        text = repr(value) if not isinstance(value, dict) else f"a table of {', '.join(map(repr, list(value)[:9]))}"
    return text if len(text) <= 100 else f"{text[:97]}..."


def out_of_range(value: Any) -> int | float | None:
    """The first finite number in a value or list that is beyond `LARGEST` or `SMALLEST` in magnitude; or None."""
    if isinstance(value, list | tuple):
        return next((found for entry in value if (found := out_of_range(entry)) is not None), None)
    if not isinstance(value, int | float) or isinstance(value, bool) or value == 0 or value in (math.inf, -math.inf):
        return None
    return value if abs(value) > LARGEST or abs(value) < SMALLEST else None  # nan is checked where the value is used


def fits(value: Any, expected: Any) -> bool:
    """True if a TOML value is of the annotated type; True isn't a number, 1 is a float, lists are tuples."""
    if expected is Any:
        return True
    origin, inside = get_origin(expected), get_args(expected)
    if origin in (Union, types.UnionType):
        return any(fits(value, member) for member in inside)
    if origin is Literal:
        return isinstance(value, str) and value in inside
    if origin is tuple:
        if not isinstance(value, list | tuple):
            return False
        if inside[-1] is Ellipsis:
            return all(fits(entry, inside[0]) for entry in value)
        return len(value) == len(inside) and all(fits(entry, kind) for entry, kind in zip(value, inside, strict=True))
    if expected in (int, float) and isinstance(value, bool):
        return False
    return isinstance(value, int | float if expected is float else expected)


def describe(expected: Any) -> str:
    """The annotated type in words, for error messages."""
    words = {int: "an integer", float: "a number", bool: "true or false", str: "a string", dict: "a table"}
    origin, inside = get_origin(expected), get_args(expected)
    if origin in (Union, types.UnionType):
        return " or ".join(describe(member) for member in inside if member is not type(None))
    if origin is Literal:
        return " or ".join(f'"{member}"' for member in inside)
    if origin is tuple:
        count = "" if inside[-1] is Ellipsis else f"{len(inside)} "
        plural = {int: "integers", float: "numbers", str: "strings", Any: "lists"}.get(
            inside[0], f"[{describe(inside[0])}]"
        )
        return f"a list of {count}{plural}"
    return words.get(expected, "a number or a list")


def _frozen(value: Any) -> Any:
    return tuple(_frozen(entry) for entry in value) if isinstance(value, list) else value
