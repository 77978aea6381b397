"""Summary of a recording in a few numbers, as plain JSON."""

from __future__ import annotations

import importlib.metadata
import platform
from typing import Any

import numpy as np

import khop_env
from khop_env.observers import FloatArray, Observers
from khop_env.physics import Fleet
from khop_env.results.recording import Recording, StoppedError
from khop_env.scenarios import Scenario
from khop_env.simulation import Observe

_ABSURD = 1e6  # times the largest initial state; no task leads agents so far away


def consensus_error(fleet: Fleet, x: FloatArray) -> FloatArray:
    """(...,) |Pi p|: distance of the agents' positions p from agreement, in their unit.

    Pi subtracts the mean (the paper's disagreement projection), applied to the stacked position outputs, so that it is
    defined for mixed fleets, too.

    Args:
        fleet: the agents.
        x: (..., n) states of the fleet.
    """
    positions = fleet.positions(x)
    with np.errstate(over="ignore", invalid="ignore"):  # diverged states give inf or nan
        return np.asarray(np.linalg.norm(positions - positions.mean(axis=-2, keepdims=True), axis=(-2, -1)))


def _diverged(x: FloatArray) -> bool:
    """True if a state exceeds a million times the largest initial state (at least 1)."""
    largest = _ABSURD * max(1.0, float(np.abs(x[0]).max()))
    return not bool(np.all(np.abs(x) <= largest))


def finite(value: float) -> float | None:
    """The number as a JSON value: None if it is infinite or nan."""
    return float(value) if np.isfinite(value) else None


def summarize(
    recording: Recording,
    scenario: Scenario,
    *,
    seed: int,
    dt: float,
    observers: Observers,
    controller: str,
    observe: Observe,
) -> dict[str, Any]:
    """Summary of a run.

    The paper guarantees that two ratios stay below 1 over all pairs, components and steps: the disagreement over its
    funnel, and the estimation error over its bound. `funnel_kept` is True if they did, for both kinds of observers, and
    the run reached its end with finite states. `diverged` indicates an unstable closed loop. Numbers that aren't finite
    are null.

    Args:
        recording: recording of the run.
        scenario: scenario of the run.
        seed: seed of the initial state and the disturbance.
        dt: step in s.
        observers: realisation of the observers.
        controller: name of the feedback law.
        observe: information of the law on k-hop targets: estimates, true states, or none.
    """
    extremes = recording.extremes
    state_ratios = [extremes.normalized[0], extremes.relative[0]]
    input_ratios = [extremes.input_normalized[0], extremes.input_relative[0]]
    has_inputs = recording.design.inputs.layout.size > 0
    kept = all(ratio < 1.0 for ratio in (*state_ratios, *input_ratios)) and bool(np.all(np.isfinite(recording.x)))
    return {
        "scenario": scenario.name,
        "controller": controller,
        "observe": observe,
        "seed": seed,
        "dt": dt,
        "integrator": observers.name,
        "order": observers.order,
        "duration": float(recording.time[-1]),
        "steps": recording.steps,
        "samples": len(recording.time),
        "wall_time_s": recording.wall_time,
        "agents": len(recording.fleet),
        "pairs": recording.design.states.layout.pairs,
        "max_normalized_disagreement": finite(state_ratios[0]),
        "max_error_to_bound": finite(state_ratios[1]),
        "max_normalized_disagreement_input": finite(input_ratios[0]) if has_inputs else None,
        "max_error_to_bound_input": finite(input_ratios[1]) if has_inputs else None,
        "position_unit": recording.fleet.position_unit(),
        "final_consensus_error": finite(float(consensus_error(recording.fleet, recording.x[-1]))),
        "diverged": _diverged(recording.x),
        "funnel_kept": (recording.completed or isinstance(recording.error, StoppedError)) and kept,
        "error": None if recording.error is None else str(recording.error),
        "versions": {
            "khop_env": khop_env.__version__,
            "python": platform.python_version(),
            **{name: importlib.metadata.version(name) for name in ("numpy", "numba")},
        },
    }
