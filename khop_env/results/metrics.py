"""Summary of a recording in a few numbers, as plain JSON."""

from __future__ import annotations

import importlib.metadata
import platform
from typing import Any

import numpy as np

import khop_env
from khop_env.observers import FloatArray, Networked, Observers, PairLayout
from khop_env.physics import Fleet
from khop_env.results.recording import Recording, StoppedError
from khop_env.results.records import MessageRecord
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
    dt: float | None,
    observers: Observers,
    controller: str,
    observe: Observe,
    tolerance: float | None = None,
) -> dict[str, Any]:
    """Summary of a run.

    The paper guarantees that two ratios stay below 1 over all pairs, components and steps: the disagreement over its
    funnel, and the estimation error over its bound. `funnel_kept` is True if they did, for both kinds of observers, and
    the run reached its end with finite states. `diverged` indicates an unstable closed loop. Numbers that aren't finite
    are null.

    Where links come and go there is one key more: `cut_off`, the share of pairs and samples at which the target didn't
    reach its observer, so that there was no guarantee.

    Steps of controlled size have two keys more: `tolerance`, and `rejected_steps`, how many were taken back.

    Over a network of messages the certified bounds are what is guaranteed, and the disagreements are those that the
    estimator's agents compute from what they hold, null where it has none. `funnel_kept` is about
    these only, and null, too, where there are none. There are further keys: `network` and `estimator`; `drawn`, if the
    network has ranges, with what this run drew from them; `bounds_kept`, which is True if errors kept their certified
    bounds and the run reached its end with finite states; `violations`, how many of the `pair_samples` (pairs and
    samples) have an error above the certified bound; `mean_age`, of the states that have arrived, in s; and
    `uncertified`, by agent why it has no bound.

    Args:
        recording: recording of the run.
        scenario: scenario of the run.
        seed: seed of the initial state and the disturbance.
        dt: step in s; None for steps of controlled size.
        observers: those of the simulator.
        controller: name of the feedback law.
        observe: information of the law on k-hop targets: estimates, true states, or none.
        tolerance: of steps of controlled size.
    """
    extremes = recording.extremes
    state_ratios = [extremes.normalized[0], extremes.relative[0]]
    input_ratios = [extremes.input_normalized[0], extremes.input_relative[0]]
    states, networked = recording.states, isinstance(observers, Networked)
    has_inputs = recording.inputs is not None and recording.design.inputs.layout.size > 0
    ended = recording.completed or isinstance(recording.error, StoppedError)
    ended = ended and bool(np.all(np.isfinite(recording.x)))
    without_funnels = networked and not state_ratios[0]
    disagreements, errors = zip(state_ratios, input_ratios, strict=True)
    kept = all(ratio < 1.0 for ratio in (disagreements if networked else disagreements + errors))
    found = {
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
        "pairs": states.layout.pairs,
        "max_normalized_disagreement": None if without_funnels else finite(state_ratios[0]),
        "max_error_to_bound": finite(state_ratios[1]),
        "max_normalized_disagreement_input": finite(input_ratios[0]) if has_inputs else None,
        "max_error_to_bound_input": finite(input_ratios[1]) if has_inputs else None,
        "position_unit": recording.fleet.position_unit(),
        "final_consensus_error": finite(float(consensus_error(recording.fleet, recording.x[-1]))),
        "diverged": _diverged(recording.x),
        "funnel_kept": None if without_funnels else ended and kept,
        "error": None if recording.error is None else str(recording.error),
        "versions": {
            "khop_env": khop_env.__version__,
            "python": platform.python_version(),
            **{name: importlib.metadata.version(name) for name in ("numpy", "numba")},
        },
    }
    if tolerance is not None:
        found |= {"tolerance": tolerance, "rejected_steps": recording.rejected}
    if isinstance(states, MessageRecord):
        kept = ended and all(ratio < 1.0 + ROUNDING for ratio in errors)  # an error may reach its certified bound
        return found | _of_network(observers, recording.fleet, states, kept)
    return (
        found
        if states.up is None
        else found | {"cut_off": float(states.cut_off.mean()) if states.layout.pairs else 0.0}
    )


def _of_network(observers: Observers, fleet: Fleet, states: MessageRecord, kept: bool) -> dict[str, Any]:
    """What a network adds to a summary."""
    assert isinstance(observers, Networked)
    arrived = states.age[np.isfinite(states.age)]
    ranges = observers.network.ranges
    return {
        "network": observers.network.described(),
        **({"drawn": {name: getattr(states.network, name) for name in ranges}} if ranges else {}),
        "estimator": observers.estimator.name,
        "bounds_kept": kept,
        "violations": violations(np.abs(states.error).T, states.bound.T, states.truth.T, states.layout),
        "pair_samples": states.layout.pairs * len(states.time),
        "mean_age": finite(arrived.mean()) if arrived.size else None,
        "uncertified": {fleet.ids[agent]: reason for agent, reason in observers.uncertified.items()},
    }


ROUNDING = 1e-9
"""Relative to a bound and a state: what an error may be above its bound without being a violation."""


def violations(error: FloatArray, bound: FloatArray, x: FloatArray, layout: PairLayout) -> int:
    """Pairs and environments with an error above its bound in any component, by more than rounding.

    Args:
        error: (P, B) absolute errors.
        bound: (P, B) guaranteed bounds.
        x: (n, B) true states.
        layout: of the pairs.
    """
    wrong = ~(error <= bound)  # nan is wrong, too
    if not wrong.any():
        return 0
    pair, env = np.nonzero(~(error - bound <= ROUNDING * (bound + np.abs(x[layout.column_source]))))
    return len(set(zip(layout.column_pair[pair].tolist(), env.tolist(), strict=True)))
