"""How this package compiles: one decorator, so that all kernels agree on caching, errors and the GIL.

Numba's own cache watches the file of a kernel, not the functions that are pasted into it from other files, and gives
up where no folder can be written. The cache here is keyed by the text of all kernels, and goes without a folder.
"""

from __future__ import annotations

import functools
import hashlib
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any, TypeVar

import numba
import numpy as np
from numba.core.caching import FunctionCache, IndexDataCacheFile, NullCache

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """Compile `function` with Numba, cached on disk, without the GIL, and with IEEE division (no ZeroDivisionError).

    Fast-math stays off: a result may not depend on how many environments share a vector register. Threads are
    Python's own, over ranges of the batch; Numba's pools survive neither forking nor two callers at once.
    """
    return _cached(numba.njit(nogil=True, error_model="numpy")(function), function)


def inlined(function: F) -> F:
    """Like `compiled`, but pasted into its compiled callers, so that their loops still vectorise."""
    return _cached(numba.njit(nogil=True, error_model="numpy", inline="always")(function), function)


def _cached(dispatcher: Any, function: F) -> F:
    try:
        dispatcher._cache = _KernelCache(function)
    except RuntimeError:  # Numba: no folder can be written
        dispatcher._cache = _NoCache()
    return dispatcher


@functools.cache
def _fingerprint() -> str:
    """The text of all files with kernels, in short."""
    root = Path(__file__).parent
    digest = hashlib.sha256()
    for path in sorted([*root.rglob("*.py"), *(root.parent / "agents").rglob("*.py")]):
        text = path.read_bytes()
        if b"@compiled" in text or b"@inlined" in text:
            digest.update(text)
    return digest.hexdigest()


@functools.cache
def _announce(kept: bool) -> None:
    where = "the result is kept for later runs" if kept else "no cache folder can be written, so every process does it"
    print(f"khop_env: compiling for this machine, about ten seconds in all ({where}) ...", file=sys.stderr, flush=True)


class _KernelFile(IndexDataCacheFile):
    """Names a data file after what is in it: two processes that save at once may lose an entry but can't swap two."""

    def save(self, key: Any, data: Any) -> None:
        overloads = self._load_index()
        overloads[key] = self._data_name(int(hashlib.sha256(repr(key).encode()).hexdigest()[:12], 16))
        self._save_data(overloads[key], data)
        self._save_index(overloads)


class _KernelCache(FunctionCache):
    def __init__(self, function: Callable[..., Any]) -> None:
        super().__init__(function)
        self._cache_file = _KernelFile(self._cache_path, self._impl.filename_base, _fingerprint())

    def load_overload(self, *args: Any) -> Any:
        found = super().load_overload(*args)
        if found is None:
            _announce(kept=True)
        return found

    def save_overload(self, *args: Any) -> None:
        try:
            super().save_overload(*args)
        except OSError:  # a full or read-only disk costs time, not the result
            self.disable()


class _NoCache(NullCache):
    def load_overload(self, *args: Any) -> None:
        _announce(kept=False)


@inlined
def place(index: int) -> Any:
    """An index that is known not to be negative, for computed indices in inner loops.

    For all the compiler knows `start + q` may be negative and count from the end, and then the loop doesn't vectorise.
    """
    return np.uint64(index)
