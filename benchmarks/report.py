"""Results of the benchmark, with reasons for missing values."""

from __future__ import annotations

import math
import subprocess
from typing import Any


class Report:
    """Rows of the table in the order in which they are measured.

    Attributes:
        rows: dicts of name, value, unit, target (the bound set by the project) and skipped (None, or the reason why
            there is no value).
    """

    def __init__(self) -> None:
        self.rows: list[dict[str, Any]] = []

    def add(self, name: str, value: float, unit: str = "x", target: str = "") -> None:
        """Add a value."""
        if not math.isfinite(value):
            self.skip(name, f"came out as {value}")
        else:
            self.rows.append({"name": name, "value": float(value), "unit": unit, "target": target, "skipped": None})

    def skip(self, name: str, reason: str) -> None:
        """Add a row without a value, with the reason."""
        self.rows.append({"name": name, "value": None, "unit": "", "target": "", "skipped": reason})


def reason(error: Exception) -> str:
    """An error in one line; for a failed process the last line of its error output."""
    if isinstance(error, subprocess.CalledProcessError):
        lines = (error.stderr or "").strip().splitlines()
        return lines[-1] if lines else f"exit status {error.returncode}"
    return " ".join(f"{type(error).__name__}: {error}".split())
