"""A recording in a few numbers, as plain JSON."""

from __future__ import annotations

import importlib.metadata
import platform
from typing import Any

import numpy as np

import khop_env
from khop_env.observers import FloatArray
from khop_env.physics import Fleet
from khop_env.results.recording import Recording
from khop_env.scenarios import Scenario
from khop_env.simulation import Integrator, Observe


def consensus_error(fleet: Fleet, x: FloatArray) -> FloatArray:
    """(...,) |Pi p|: how far the agents' positions p are from agreement, in m.

    Pi subtracts the mean (the paper's disagreement projection), here from the stacked position read-outs, so that mixed
    fleets have a consensus error too.

    Args:
        fleet: the agents.
        x: (..., n) their states.
    """
    positions = fleet.positions(x)
    return np.asarray(np.linalg.norm(positions - positions.mean(axis=-2, keepdims=True), axis=(-2, -1)))


def summarize(
    recording: Recording,
    scenario: Scenario,
    *,
    seed: int,
    dt: float,
    integrator: Integrator,
    controller: str,
    observe: Observe,
) -> dict[str, Any]:
    """The summary of a run.

    The two ratios are the paper's guarantee: below 1 over all pairs, components and steps, each disagreement stayed in
    its funnel and each estimation error within its bound. `funnel_kept` says that they are, for both kinds of
    observers, and that the run got to its end.

    Args:
        recording: of the run.
        scenario: what was run.
        seed: of the initial state and the disturbance.
        dt: step in s.
        integrator: how it was integrated.
        controller: name of the feedback law.
        observe: what the law saw of agents out of earshot.
    """
    extremes = recording.extremes
    state_ratios = [float(extremes.normalized[0]), float(extremes.relative[0])]
    input_ratios = [float(extremes.input_normalized[0]), float(extremes.input_relative[0])]
    has_inputs = recording.design.inputs.layout.size > 0
    return {
        "scenario": scenario.name,
        "controller": controller,
        "observe": observe,
        "seed": seed,
        "dt": dt,
        "integrator": integrator.name,
        "order": integrator.order,
        "duration": float(recording.time[-1]),
        "steps": recording.steps,
        "samples": len(recording.time),
        "wall_time_s": recording.wall_time,
        "agents": len(recording.fleet),
        "pairs": recording.design.states.layout.pairs,
        "max_normalized_disagreement": state_ratios[0],
        "max_error_to_bound": state_ratios[1],
        "max_normalized_disagreement_input": input_ratios[0] if has_inputs else None,
        "max_error_to_bound_input": input_ratios[1] if has_inputs else None,
        "final_consensus_error": float(consensus_error(recording.fleet, recording.x[-1])),
        "funnel_kept": recording.completed and max(*state_ratios, *input_ratios) < 1.0,
        "error": None if recording.error is None else str(recording.error),
        "versions": {
            "khop_env": khop_env.__version__,
            "python": platform.python_version(),
            **{name: importlib.metadata.version(name) for name in ("numpy", "numba")},
        },
    }
