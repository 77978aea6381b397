"""Names on the command line: lists of them, and Python objects by name, `my_module:make_env`."""

from __future__ import annotations

import importlib
import importlib.util
import os
import sys
import traceback
from collections.abc import Callable
from pathlib import Path
from types import ModuleType
from typing import Any, TypeVar

from khop_env.own_agents import AGENTS

Result = TypeVar("Result")

_LISTED = 8  # names of a module in an error message


def split_specs(text: str, option: str, kind: str) -> list[str]:
    """A list of names with parameters, split at commas; a part "key=value" belongs to the name before it.

        split_specs("ideal,wifi,lossy:loss=0.3,burst=5", "--networks", "network")
        # ["ideal", "wifi", "lossy:loss=0.3,burst=5"]

    Args:
        text: as it was written.
        option: where it was, for errors.
        kind: of which kind they are, for errors.

    Raises:
        ValueError: for no name at all, an empty part, a key=value without a name before it, or a name twice.
    """
    if not text.strip(" ,"):
        raise ValueError(f"{option}: name at least one {kind}; got {text!r}")
    found: list[str] = []
    for part in text.split(","):
        name, equals, _ = part.partition("=")
        if not part.strip():
            raise ValueError(f"{option} {text!r}: there is nothing between two commas or at an end")
        if not equals or ":" in name:
            found.append(part.strip())
        elif not found:
            raise ValueError(f"{option} {text!r}: no {kind} before {part.strip()!r}; write NAME:{part.strip()}")
        else:
            found[-1] += f"{',' if ':' in found[-1] else ':'}{part.strip()}"
    for spec in found:
        if found.count(spec) > 1:
            raise ValueError(f"{option} names {spec!r} twice")
    return found


def load_object(name: str) -> Any:
    """Load an attribute of a module or a file, or the module itself.

        load_object("my_module:make_env")
        load_object("path/to/my_file.py:Configuration.make")
        load_object("mpe2.simple_spread_v3")

    Modules are searched for among installed packages and in the working directory. A file is imported as a module with
    its own name, and its folder is added to the search path, so that it can import files beside it and its objects can
    be pickled.

    Args:
        name: "module:attribute" or "file.py:attribute"; the attribute may be omitted.

    Raises:
        ValueError: if module, file or attribute doesn't exist, or importing raises; then the message has file and line,
            and the exception is its cause.
    """
    source, _, attribute = name.rpartition(":")
    if not source or attribute.endswith(".py") or "/" in attribute or os.sep in attribute:  # a colon within the path
        source, attribute = name, ""
    found: Any = _file(source) if source.endswith(".py") else _module(source)
    for part in filter(None, attribute.split(".")):
        if not hasattr(found, part):
            known = [key for key in vars(found) if not key.startswith("_")] if hasattr(found, "__dict__") else []
            listed = ", ".join(known[-_LISTED:]) + (", ..." if len(known) > _LISTED else "")
            owner = source if isinstance(found, ModuleType) else f"{source}: {getattr(found, '__name__', found)}"
            raise ValueError(f"{owner} has no {part!r}; it has {listed or 'no public names'}")
        found = getattr(found, part)
    return found


def called(name: str, function: Callable[..., Result], *arguments: Any, **keywords: Any) -> Result:
    """What a user's function or class returns, or where it went wrong.

    Args:
        name: where it was found, for the error.
        function: to call.
        arguments: of it.
        keywords: of it.

    Raises:
        ValueError: if it raises anything, with the file and the line, and the exception itself as the cause.
    """
    try:
        return function(*arguments, **keywords)
    except Exception as error:
        file = getattr(sys.modules.get(getattr(function, "__module__", "")), "__file__", None) or ""
        raise ValueError(f"{name} raised {described(error, file)}") from error


def is_object_name(name: str) -> bool:
    """True if a text has the form of `load_object`: "module:attribute", or a file that ends in .py."""
    source, _, attribute = name.rpartition(":")
    if name.endswith(".py") or source.endswith(".py"):
        return True
    parts = [*source.split("."), *attribute.split(".")]
    return bool(source) and all(part.isidentifier() for part in parts)


def described(error: BaseException, file: str = "") -> str:
    """Describe an exception and where it was raised: "ValueError: no such fleet (my_file.py, line 3, in make_env)".

    Args:
        error: the exception.
        file: end of a path; the innermost line in that file is named instead of the innermost of all.
    """
    said = error.args[0] if isinstance(error, KeyError) and " " in str(error) else error  # str() puts it in quotes
    text = f"{type(error).__name__}: {said}"
    if isinstance(error, SyntaxError) and error.filename is not None:
        return f"{type(error).__name__}: {error.msg} ({_short(error.filename)}, line {error.lineno})"
    frames = traceback.extract_tb(error.__traceback__)
    if not frames:
        return text
    frame = ([frame for frame in frames if frame.filename.endswith(file)] or frames)[-1]
    return f"{text} ({_short(frame.filename)}, line {frame.lineno}, in {frame.name})"


def _short(filename: str) -> str:
    """A path relative to the working directory or to the folder of installed packages."""
    path = Path(filename)
    for folder in (*(parent for parent in path.parents if parent.name == "site-packages"), Path.cwd()):
        if path.is_relative_to(folder):
            return str(path.relative_to(folder))
    return filename


def _module(name: str) -> ModuleType:
    """Import an installed module, or a module in the working directory."""
    if not all(part.isidentifier() for part in name.split(".")):
        raise ValueError(f"{name!r} isn't the name of a Python object; expected my_module:name or my_file.py:name")
    _search(Path.cwd())
    try:
        return importlib.import_module(name)
    except (Exception, SystemExit) as error:
        if isinstance(error, ModuleNotFoundError) and f"{name}.".startswith(f"{error.name}."):
            if name.partition(".")[0] == AGENTS:  # it says what to do
                raise ValueError(str(error)) from None
            raise ValueError(
                f"no module {error.name!r}, neither installed nor in the working directory; a file's name ends in .py"
            ) from None
        raise _raised(name, error, os.sep + name.replace(".", os.sep) + ".py") from error


def _file(text: str) -> ModuleType:
    """Import a file as a module."""
    path = Path(text).resolve()
    if not path.is_file():
        raise ValueError(f"no file {text!r} (relative to {Path.cwd()})")
    known = sys.modules.get(path.stem)
    if known is not None:
        if Path(getattr(known, "__file__", None) or "").resolve() == path:
            return known
        raise ValueError(f"{text}: a module named {path.stem!r} has been imported already; rename the file")
    spec = importlib.util.spec_from_file_location(path.stem, path)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    _search(path.parent)
    sys.modules[path.stem] = module
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        del sys.modules[path.stem]
        raise _raised(text, error, str(path)) from error
    return module


def _search(folder: Path) -> None:
    """Append a folder to the search path of imports."""
    if str(folder) not in sys.path:
        sys.path.append(str(folder))


def _raised(name: str, error: BaseException, file: str) -> ValueError:
    return ValueError(f"importing {name} raised {described(error, file)}")
