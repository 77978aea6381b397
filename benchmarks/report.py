"""Results of the benchmark, with reasons for missing values."""

from __future__ import annotations

import math
import subprocess
from fnmatch import fnmatchcase
from typing import Any

EXPLANATIONS = (
    ("proximal_error", "largest error of the closed loop of `paper` over 10 s, order 2 in steps of 10 ms"),
    ("speedup_vs_explicit", "time of the compiled explicit step at 10 us, over that of this run; 64 environments"),
    ("speedup_vs_explicit_single", "the same, one environment"),
    ("explicit_to_floor*", "time of that explicit step, over a bare loop of its logarithms and divisions"),
    ("proximal*", "time of the proximal step"),
    ("explicit*", "time of the explicit step at 10 us"),
    (
        "speedup_vs_scipy",
        "SciPy's LSODA over steps of controlled size: time for one environment of `paper`, error 2e-3 m over 10 s",
    ),
    ("speedup_vs_scipy_mixed_fleet", "the same on `mixed_fleet`"),
    ("speedup_vs_scipy_fixed", "the same on `paper`, over order 2 in steps of 10 ms"),
    ("speedup_vs_scipy_batch", "the same, one environment out of a batch of 64"),
    ("ratio_to_floor", "the solve, per element and Newton iteration, over a bare loop of T and phi''"),
    ("step_*", "a step of `random_geometric` with so many agents, simulator and law"),
    ("memory_*", "memory of its simulator"),
    ("growth_*", "largest over smallest of these, from 100 to 10 000 agents"),
    ("environment_step_*", "a step of `consensus_v0` on it, observations included"),
    ("environment_memory_*", "memory of that environment, without the scenario"),
    ("wifi_step_*", "the same step over `wifi`"),
    ("wifi_memory_*", "memory of that environment, without the scenario"),
    ("*_growth_*", "largest over smallest of these, from 100 to 10 000 agents"),
    ("*_making_*", "time to make that scenario and environment, once"),
    ("peak_*", "memory of the whole process with the most agents"),
    ("environment_control_period", "of the environments in the rows below"),
    ("environment_substeps", "likewise"),
    ("single_*: *", "where the time of a step goes, one environment"),
    ("vector_*: *", "where the time of a step goes, a batch of 1024"),
    ("single_*", "one environment of `paper`, 8 agents, estimates on, a call a step, without rendering"),
    ("vector_*_jax*", "a batch of 1024 environments, estimates on, one thread"),
    ("vector_*_threads2*", "a batch of 1024 environments, estimates on, two threads on either side"),
    ("vector_*", "a batch of 1024 environments, estimates on, one thread on either side"),
    ("threads_*_plain", "gain of a second thread in a loop of square roots, measured in turns with the row below"),
    ("threads_paper", "gain of a second thread: a step of a batch of 1024, `paper`"),
    ("threads_convoy", "the same, `leader_following_v0` on `convoy`"),
    ("threads_paper_wifi", "the same, `paper` over `wifi`"),
    ("*_memory", "memory of an environment: exchange in continuous time, or over `wifi`"),
    ("network_*", "a batch of 1024 of `paper` over `wifi`; the ratio is to exchange in continuous time"),
    ("violations", "errors above their certified bounds, of random fleets and networks, adversarial inputs"),
    ("error_to_certified_bound", "the largest error over its certified bound in these"),
    ("filter_*", "an agent's move in the safety filter, one environment or a batch of 1024"),
    ("environment_with_filter", "a batch of 1024 of `navigation_v0` over `wifi` with filter and policy, one thread"),
    ("collisions_certified", "episodes with a collision in the filter with certified bounds"),
    ("collisions_estimated", "the same without bounds, on a fifth of these episodes"),
    ("min_distance_*", "smallest distance of two agents in these; bodies touch at 0.4 m"),
    ("training", "PPO, 64 environments of 8 agents, inside `learn`"),
    ("training_ratio", "the same PPO on MPE2's simple_spread through SuperSuit"),
    ("training_jax", "that training's agent-steps/s with `backend=jax`, over those with torch, in turns"),
    ("training_environment_share", "share of the environment in that training's time"),
)
"""Patterns of rows' names, the first that fits, and what is measured."""


class Report:
    """Rows of the table in the order in which they are measured.

    Attributes:
        rows: dicts of name, value, unit, target (the bound set by the project), met (whether the value keeps it; None
            without a target), explanation, and skipped (None, or the reason why there is no value).
    """

    def __init__(self) -> None:
        self.rows: list[dict[str, Any]] = []

    def add(
        self, name: str, value: float, unit: str = "x", *, least: float | None = None, most: float | None = None
    ) -> None:
        """Add a value.

        Args:
            name: of the row.
            value: what was measured.
            unit: of the value.
            least: target, at least so much.
            most: target, at most so much.
        """
        if not math.isfinite(value):
            self.skip(name, f"came out as {value}")
            return
        targets = [f"{word} {bound:g}" for word, bound in (("at least", least), ("at most", most)) if bound is not None]
        met = (least is None or value >= least) and (most is None or value <= most) if targets else None
        self._append(name, value=float(value), unit=unit, target=", ".join(targets), met=met)

    def skip(self, name: str, reason: str) -> None:
        """Add a row without a value, with the reason."""
        self._append(name, skipped=reason)

    def _append(self, name: str, **values: Any) -> None:
        empty = {"value": None, "unit": "", "target": "", "met": None, "skipped": None}
        self.rows.append({"name": name, **empty, **values, "explanation": explanation(name)})


def explanation(name: str) -> str:
    """One line on a row; empty for a part that failed, which has the name of the part."""
    return next((text for pattern, text in EXPLANATIONS if fnmatchcase(name, pattern)), "")


def reason(error: Exception) -> str:
    """An error in one line; for a failed process the last line of its error output."""
    if isinstance(error, subprocess.CalledProcessError):
        lines = (error.stderr or "").strip().splitlines()
        return lines[-1] if lines else f"exit status {error.returncode}"
    return " ".join(f"{type(error).__name__}: {error}".split())
