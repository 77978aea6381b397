"""Reading a TOML table key by key, so that every mistake is named: the file, the key, what was got and expected."""

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
"""The default of a key that has to be given."""


_SHOWN = 20  # mistakes in one message

LARGEST, SMALLEST = 1e12, 1e-30
"""Finite numbers other than 0 lie between them, in SI units: anything beyond is a slip."""


class ScenarioFileError(ValueError):
    """A scenario file that can't be read; the message says where, what was got and what was expected."""


class NotedError(ScenarioFileError):
    """A table has mistakes that are noted already: what reads it can't go on."""


class CheckedTable:
    """A table whose keys are taken one at a time; what is left at the end is refused.

    Mistakes are noted and not raised, so that one message can name all of them: `finish` stops the reading of a table
    that has any, `gathering` goes on with the next one, and `raise_mistakes` of the whole file's ends it.

    Args:
        file: where it comes from, for error messages.
        key: its dotted name, "" for the whole file.
        values: its content.
        mistakes: what is wrong with the file, key by key; the table adds to it.
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
            return  # which is noted already
        name = self.dotted(key) if key else self.key
        self.mistakes.append(f"{name}: {why}" if name else why)

    def refuse(self, key: str, why: str) -> NoReturn:
        """Note a mistake, and stop reading what depends on it."""
        self.note(key, why)
        raise NotedError

    @contextmanager
    def gathering(self) -> Iterator[None]:
        """Go on after what is read within, whatever is wrong with it."""
        try:
            yield
        except NotedError:
            self._wrong = True

    @contextmanager
    def built(self, key: str = "") -> Iterator[None]:
        """Say where in the file the values stand that a constructor refuses."""
        try:
            yield
        except ScenarioFileError:
            raise
        except (ValueError, TypeError, OverflowError) as error:
            self.refuse(key, str(error))

    def raise_mistakes(self) -> None:
        """End the reading of a file.

        Raises:
            ScenarioFileError: with everything that is wrong, a line each.
        """
        if len(self.mistakes) == 1:
            raise ScenarioFileError(f"{self.file}: {self.mistakes[0]}")
        if self.mistakes:
            more = len(self.mistakes) - _SHOWN
            lines = [*self.mistakes[:_SHOWN], *([f"... and {more} more"] if more > 0 else [])]
            raise ScenarioFileError(f"{self.file}: {len(self.mistakes)} mistakes:\n  " + "\n  ".join(lines))

    def take(self, key: str, expected: Any, default: Any = REQUIRED) -> Any:
        """The value of `key`, lists turned into tuples where tuples are expected; or the default if it is wrong.

        Args:
            key: within this table.
            expected: a type as annotations write it: int, float (integers will do), bool, str, tuple[float, ...] and
                so on, a union, or Any.
            default: used where the key isn't there.
        """
        self._asked.append(key)
        if key not in self._values:
            if default is REQUIRED:
                near = difflib.get_close_matches(key, self._values, n=1)
                hint = f"; is {near[0]!r} meant for it?" if near else ""
                for misspelt in near:
                    del self._values[misspelt]  # one slip, one mistake
                self.note(key, f"missing; expected {describe(expected)}{hint}")
            return default
        value = self._values.pop(key)
        if not fits(value, expected):
            self.note(key, f"got {shown(value)}, expected {describe(expected)}")
            return default
        if (number := out_of_range(value)) is not None:
            self.note(
                key, f"got {shown(number)}, expected a number of at most {LARGEST:g}, and no smaller than {SMALLEST:g}"
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
            self.refuse(key, f"got {shown(values)}, expected tables, each under a line [[{self.dotted(key)}]]")
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
            self.refuse(key, f"got {shown(name)}, expected one of {', '.join(map(repr, known))}{hint}")
        return name

    def rest(self) -> dict[str, Any]:
        """All keys not taken yet, lists as tuples; they count as taken."""
        return {key: self.take(key, Any) for key in list(self._values)}

    def names(self) -> list[str]:
        """The keys not taken yet."""
        return list(self._values)

    def finish(self) -> None:
        """Note what nobody asked for with the nearest known name, and stop if anything in the table is wrong."""
        for key, value in self._values.items():
            self.note(key, f"unknown key (with the value {shown(value)}); {did_you_mean(key, self._asked)}")
        self._values.clear()
        if self._wrong:
            raise NotedError


def shown(value: Any) -> str:
    """A value of the file in an error message: at most a line, whatever it is."""
    if isinstance(value, int) and not isinstance(value, bool) and abs(value) > LARGEST:
        return f"an integer of about 10^{int(value.bit_length() * math.log10(2.0))}"
    if isinstance(value, list | tuple):
        text = f"[{', '.join(shown(one) for one in value[:9])}{', ...' if len(value) > 9 else ''}]"
    else:
        text = repr(value) if not isinstance(value, dict) else f"a table of {', '.join(map(repr, list(value)[:9]))}"
    return text if len(text) <= 100 else f"{text[:97]}..."


def out_of_range(value: Any) -> int | float | None:
    """The first number in a value or list that is finite, but too large or too small for anything meant."""
    if isinstance(value, list | tuple):
        return next((found for one in value if (found := out_of_range(one)) is not None), None)
    if not isinstance(value, int | float) or isinstance(value, bool) or value == 0 or value in (math.inf, -math.inf):
        return None
    return value if abs(value) > LARGEST or abs(value) < SMALLEST else None  # nan is left to those who read it


def fits(value: Any, expected: Any) -> bool:
    """Whether a TOML value is of the annotated type; True isn't a number, 1 is a float, lists are tuples."""
    if expected is Any:
        return True
    origin, inside = get_origin(expected), get_args(expected)
    if origin in (Union, types.UnionType):
        return any(fits(value, one) for one in inside)
    if origin is Literal:
        return isinstance(value, str) and value in inside
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
    if origin is Literal:
        return " or ".join(f'"{one}"' for one in inside)
    if origin is tuple:
        count = "" if inside[-1] is Ellipsis else f"{len(inside)} "
        plural = {int: "integers", float: "numbers", str: "strings", Any: "lists"}.get(
            inside[0], f"[{describe(inside[0])}]"
        )
        return f"a list of {count}{plural}"
    return words.get(expected, "a number or a list")


def _frozen(value: Any) -> Any:
    return tuple(_frozen(one) for one in value) if isinstance(value, list) else value
