"""What the benchmark has measured so far, and why something is missing."""

from __future__ import annotations

import math
import subprocess
from typing import Any


class Report:
    """Rows of the table in the order in which they are measured.

    Attributes:
        rows: each with name, value, unit, target (the bound that the project sets itself) and skipped: None, or why
            there is no value.
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
        """Add a row without a value, and why it has none."""
        self.rows.append({"name": name, "value": None, "unit": "", "target": "", "skipped": reason})


def reason(error: Exception) -> str:
    """Why something failed, in one line; of a process that is its last word."""
    if isinstance(error, subprocess.CalledProcessError):
        lines = (error.stderr or "").strip().splitlines()
        return lines[-1] if lines else f"exit status {error.returncode}"
    return " ".join(f"{type(error).__name__}: {error}".split())
