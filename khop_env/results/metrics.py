"""A recording in a few numbers, as plain JSON."""

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

_ABSURD = 1e6  # times the largest initial state: no task sends agents so far away


def consensus_error(fleet: Fleet, x: FloatArray) -> FloatArray:
    """(...,) |Pi p|: how far the agents' positions p are from agreement, in their unit.

    Pi subtracts the mean (the paper's disagreement projection), here from the stacked position read-outs, so that mixed
    fleets have a consensus error too.

    Args:
        fleet: the agents.
        x: (..., n) their states.
    """
    positions = fleet.positions(x)
    with np.errstate(over="ignore", invalid="ignore"):  # of states that ran away: inf or nan says it
        return np.asarray(np.linalg.norm(positions - positions.mean(axis=-2, keepdims=True), axis=(-2, -1)))


def _diverged(x: FloatArray) -> bool:
    """Whether a state grew a million times as large as any at the beginning, and 1 of its unit."""
    largest = _ABSURD * max(1.0, float(np.abs(x[0]).max()))
    return not bool(np.all(np.abs(x) <= largest))


def finite(value: float) -> float | None:
    """A number as JSON has it: null where it is infinite or not a number."""
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
    """The summary of a run.

    The two ratios are the paper's guarantee: below 1 over all pairs, components and steps, each disagreement stayed in
    its funnel and each estimation error within its bound. `funnel_kept` says that they are, for both kinds of
    observers, and that the run got to its end with every state finite. `diverged` hints at a plant that ran away.
    Numbers that aren't finite are null.

    Args:
        recording: of the run.
        scenario: what was run.
        seed: of the initial state and the disturbance.
        dt: step in s.
        observers: how they were stepped.
        controller: name of the feedback law.
        observe: what the law read of agents beyond its neighbours.
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
