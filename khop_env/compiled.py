"""How this package compiles: one decorator, so that every kernel agrees on caching, errors and the GIL."""

from __future__ import annotations

from collections.abc import Callable
from typing import Any, TypeVar

import numba

F = TypeVar("F", bound=Callable[..., Any])


def compiled(function: F) -> F:
    """Compile `function` with Numba, cached on disk, without the GIL, and with IEEE division (no ZeroDivisionError).

    Fast-math stays off: a result may not depend on how many environments share a vector register.
    """
    return numba.njit(cache=True, nogil=True, error_model="numpy")(function)  # type: ignore[no-any-return]


def inlined(function: F) -> F:
    """Like `compiled`, but pasted into its compiled callers, so that their loops still vectorise."""
    return numba.njit(cache=True, nogil=True, error_model="numpy", inline="always")(function)  # type: ignore[no-any-return]
