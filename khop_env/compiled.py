"""Compilation of kernels: one decorator, with common caching, errors and release of the GIL.

Numba's own cache depends on the file of a kernel, not on functions that are inlined from other files; a truncated cache
file stops every later run; and on a full disk the call fails. So Numba chooses the folder, and the classes below read
and write.
"""

from __future__ import annotations

import functools
import hashlib
import os
import pickle
import re
import sys
import uuid
from collections.abc import Callable
from contextlib import ExitStack, suppress
from pathlib import Path
from typing import Any, TypeVar

import numpy as np

from khop_env.collection import collection_paused

PLAIN = "KHOP_ENV_PLAIN"
"""Environment variable: if it is set Numba isn't loaded, which takes memory and a part of a second."""

try:
    if os.environ.get(PLAIN):
        raise ImportError
    import numba
    from numba.core import event
except ImportError:  # kernels then run as plain Python: slow, but enough for one robot's observers
    numba = None  # type: ignore[assignment]

F = TypeVar("F", bound=Callable[..., Any])

# Marks of files whose text kernels depend on; compiled code knows the fields of a named tuple by position only.
_MARKS = (b"@compiled", b"@inlined", b"@pasted", b"NamedTuple")
_DIGEST = hashlib.sha256().digest_size


def compiled(function: F) -> F:
    """Compile `function` with Numba, cached on disk, without the GIL, and with IEEE division (no ZeroDivisionError).

    Fast-math stays off: a result may not depend on how many environments share a vector register. Threads are
    Python's own, over ranges of the batch; Numba's pools survive neither forking nor two callers at once.

    Cached code is used while the text of this package's kernels and of the function's own file stays the same. Changes
    of constants or kernels that the function takes from other files aren't detected.
    """
    return _cached(function)


def inlined(function: F) -> F:
    """Like `compiled`, but inlined into its compiled callers, so that their loops still vectorise.

    LLVM does it. Numba's own inlining takes longer, since it infers the types of each copy anew.
    """
    return _cached(function, forceinline=True)


def pasted(function: F) -> F:
    """Like `inlined`, but by Numba: for a line or two that are called with many constants.

    `inlined` would compile a copy for each constant, before LLVM pastes it.
    """
    return _cached(function, inline="always")


def available(kernel: Any, *arguments: Any) -> bool:
    """Whether a kernel is compiled for arguments of these types: in this process, or by an earlier one on disk.

    False, too, where this can't be found out.
    """
    with suppress(AttributeError):  # Python functions; a Numba that has other names for these
        types = tuple(kernel.typeof_pyval(argument) for argument in arguments)
        if types in kernel.overloads:
            return True
        found = kernel._cache.stored(types, kernel.targetctx)
        if found is not None:
            kernel.targetctx.insert_user_function(found.entry_point, found.fndesc, [found.library])
            kernel.add_overload(found)
            return True
    return False


def _cached(function: F, **options: Any) -> F:
    if numba is None:
        return function
    compile_with = functools.partial(numba.njit, nogil=True, error_model="numpy", **options)
    try:
        dispatcher: Any = compile_with(cache=True)(function)
        dispatcher._cache = _Cache(function, dispatcher._cache)
    except (RuntimeError, OSError, AttributeError):  # no folder, no file, or a Numba that has other names for these
        dispatcher = compile_with()(function)
        if hasattr(dispatcher, "_cache"):
            dispatcher._cache = _Cache(function, None)
    return dispatcher


if numba is not None:

    class _WithoutCollection(event.Listener):
        """Stops the garbage collection of Python while kernels compile: a sixth of that time, and little is freed.

        Compilations are nested, and one thread at a time compiles.
        """

        def __init__(self) -> None:
            self._pauses: list[ExitStack] = []

        def on_start(self, _: object) -> None:
            self._pauses.append(ExitStack())
            self._pauses[-1].enter_context(collection_paused())

        def on_end(self, _: object) -> None:
            self._pauses.pop().close()

    event.register("numba:compile", _WithoutCollection())


@functools.cache
def _text_of_kernels() -> bytes:
    """Digest of all files of this package that kernels depend on."""
    root = Path(__file__).parent
    digest = hashlib.sha256()
    for path in sorted([*root.rglob("*.py"), *(root.parent / "agents").rglob("*.py")]):
        text = path.read_bytes()
        if any(mark in text for mark in _MARKS):
            digest.update(text)
    return digest.digest()


@functools.cache
def _text_of(path: str) -> bytes:
    return hashlib.sha256(Path(path).read_bytes()).digest()


@functools.cache
def _announce(kept: bool) -> None:
    where = (
        "some seconds; the result is kept for later runs"
        if kept
        else "some seconds, in every process, since no folder can be written"
    )
    _say(f"compiling what is used for the first time on this machine ({where}) ...")


@functools.cache
def _say(text: str) -> None:
    print(f"khop_env: {text}", file=sys.stderr, flush=True)


class _Cache:
    """Cache of compiled code for a dispatcher of Numba. No fault of the cache is an error.

    Args:
        function: the kernel.
        numba_cache: Numba's own cache of it, which describes signatures and processors; None to compile in memory.
    """

    def __init__(self, function: Callable[..., Any], numba_cache: Any) -> None:
        self._numba = numba_cache
        self.cache_path = None
        if numba_cache is not None:
            numba_cache._cache_file  # noqa: B018 -- an AttributeError where Numba calls it something else
            self.cache_path = numba_cache.cache_path
            numba_cache._cache_file = _Files(Path(numba_cache.cache_path), function)

    def stored(self, *arguments: Any) -> Any:
        """What `load_overload` loads, without an announcement where there is nothing."""
        if self._numba is not None:
            with suppress(Exception):  # for any damage of a file
                return self._numba.load_overload(*arguments)
        return None

    def load_overload(self, *arguments: Any) -> Any:
        found = self.stored(*arguments)
        if found is None:
            _announce(kept=self._numba is not None)
        return found

    def save_overload(self, *arguments: Any) -> None:
        if self._numba is None:
            return
        try:
            self._numba.save_overload(*arguments)
        except Exception as error:  # a full or read-only disk costs time, not the result
            reason = getattr(error, "strerror", None) or type(error).__name__
            _say(f"compiled code can't be kept, so that later runs compile again ({reason}: {self.cache_path})")

    def flush(self) -> None:
        if self._numba is not None:
            self._numba.flush()


class _Files:
    """Compiled code of one function, a file for each signature and processor: a digest, then the content.

    The digest is over all that the content depends on and over the content itself. A file that is cut off, damaged, or
    of another version of Numba or of the kernels isn't unpickled; damaged machine code would end the process.
    Each file is complete before it is renamed, so that two processes may save at once.
    """

    def __init__(self, folder: Path, function: Callable[..., Any]) -> None:
        source = function.__code__.co_filename
        self._folder = folder
        name = f"{Path(source).stem}.{function.__qualname__}-{sys.implementation.cache_tag}"
        self._name = re.sub(r"[^\w.-]", "", name)
        self._stamp = numba.__version__.encode() + _text_of_kernels() + _text_of(source)

    def load(self, key: Any) -> Any:
        """The data saved under `key`, or None."""
        try:
            stored = self._path(key).read_bytes()
        except OSError:
            return None
        digest, content = stored[:_DIGEST], stored[_DIGEST:]
        return pickle.loads(content) if digest == self._digest(key, content) else None

    def save(self, key: Any, data: Any) -> None:
        """Save `data` under `key`, replacing older data."""
        content = pickle.dumps(data, protocol=pickle.HIGHEST_PROTOCOL)
        path = self._path(key)
        unfinished = path.with_name(f"{path.name}.{uuid.uuid4().hex}")
        try:
            unfinished.write_bytes(self._digest(key, content) + content)
            unfinished.replace(path)
        finally:
            unfinished.unlink(missing_ok=True)

    def flush(self) -> None:
        """Delete all saved data."""
        for path in self._folder.glob(f"{self._name}-*.kernel"):
            path.unlink(missing_ok=True)

    def _path(self, key: Any) -> Path:
        return self._folder / f"{self._name}-{hashlib.sha256(repr(key).encode()).hexdigest()[:16]}.kernel"

    def _digest(self, key: Any, content: bytes) -> bytes:
        return hashlib.sha256(self._stamp + repr(key).encode() + content).digest()


@inlined
def place(index: int) -> Any:
    """An index that is known not to be negative, for computed indices in inner loops.

    Otherwise the compiler must assume that `start + q` may be negative and count from the end, and the loop doesn't
    vectorise.
    """
    return np.uint64(index)
