"""The design report: properties of a scenario's observers before a run, as plain JSON."""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any

import numpy as np

from khop_env.observers import DesignError, Exponential, FloatArray, Funnels, ObserverDesign, PerformanceFunction
from khop_env.observers.design import design_rule_for
from khop_env.physics import one_way_links
from khop_env.results.assumptions import assumptions
from khop_env.scenarios import Scenario
from khop_env.simulation.plant import parts_of_step


def design_report(scenario: Scenario) -> dict[str, Any]:
    """Design report of a scenario: feasibility, targets, bounds and the paper's assumptions.

    Keys:
        feasible: True if all conditions of the observers that can be checked before the start hold; otherwise `error`
            names the violated condition.
        edges: number of edges of the communication graph, or of links if it is directed; one_way_links: number of links
            without the opposite link.
        design_rule: from the bounds delta and theta to the funnels rho and omega.
        targets: per estimated agent: its k-hop set, eta, lambda_min and lambda_max of M_i (moduli of its eigenvalues on
            directed graphs), own_bound, the smallest and the largest of its observers' own guaranteed bounds over
            delta (theta), and under `state` and `input` per group of components with equal numbers: delta and rho
            (theta and omega), each with initial and final value and rate, and start_share, the largest
            |xi(0)| / rho(0) over the initial set; null if |g| is unbounded, so that only `Simulator.reset` can check
            it.
        pairs: number of observer-target pairs; estimates: number of estimated components.
        explicit_step_bound_s: upper bound on stable explicit Euler steps at steady state (accurate steps are far
            shorter): the smallest over all targets, for both kinds of observers.
        assumptions: the paper's six assumptions, each with status and reason.

    Infinite or unknown numbers are null. All keys are always present: if the observers can't be designed, results of
    the design are null, and targets and assumptions are empty.
    """
    report: dict[str, Any] = {
        "scenario": scenario.name,
        "description": scenario.description,
        "agents": len(scenario.models),
        "edges": scenario.communication.number_of_edges(),
        "one_way_links": len(one_way_links(scenario.communication)),
        "k": scenario.k,
        "relay": scenario.relay,
        "design_rule": design_rule_for(scenario.communication, scenario.design_rule),
        "feasible": False,
        "error": None,
        "pairs": None,
        "estimates": None,
        "explicit_step_bound_s": {"state": None, "input": None},
        "plant_step_s": None,
        "plant_agent": None,
        "warnings": scenario.warnings,
        "targets": [],
        "assumptions": [],
    }
    try:
        design = scenario.design
    except DesignError as error:
        return {**report, "error": str(error)}
    longest, agent = scenario.longest_step
    if np.isfinite(longest):
        report |= {"plant_step_s": longest, "plant_agent": scenario.fleet.ids[agent]}
    bound = scenario.fleet.input_map_bound
    radius = {"state": scenario.initial.radius, "input": bound}
    try:  # as the simulator does: its reset checks the initial inputs where g is unbounded
        design.require_feasible_start(scenario.initial.radius, np.where(np.isfinite(bound), bound, 0.0))
        parts_of_step(scenario.dt, longest, f"the drift of {scenario.fleet.ids[agent]!r}")
        _require_digits(scenario)
        report["feasible"] = True
    except ValueError as error:
        report["error"] = str(error)
    report["pairs"] = design.states.layout.pairs
    report["estimates"] = design.states.layout.size + design.inputs.layout.size
    report["explicit_step_bound_s"] = {
        kind: _finite(funnels.explicit_step_bound().min(initial=np.inf)) for kind, funnels in _kinds(design)
    }
    targets = _targets(design)
    for kind, funnels in _kinds(design):
        share = funnels.feasible_at_start(radius[kind])
        for target, groups in _funnel_groups(design, funnels, share, *_LETTERS[kind]).items():
            targets[target][kind] = groups
    report["targets"] = list(targets.values())
    report["assumptions"] = [vars(assumption) for assumption in assumptions(scenario)]
    return report


_DIGITS = 4.0  # rho must exceed this many units in the last place of an estimate per link of its observer
_REGION = 10.0  # states are assumed to stay within this multiple of the initial set


def _require_digits(scenario: Scenario) -> None:
    """Check that bounds are large enough for floating point: estimates have errors of a unit in the last place.

    A disagreement is a sum of d_a differences of estimates, one per link of its observer, each with such an error.
    States are assumed to stay within `_REGION` times the initial set, or as far as inputs and disturbances drive them.

    Raises:
        DesignError: if one isn't; the message names agent, component and the smallest admissible delta (theta) at
            infinity.
    """
    fleet, design = scenario.fleet, scenario.design
    reach = np.abs(scenario.initial.center) + scenario.initial.radius
    pushed = 0.0 if scenario.disturbance is None else scenario.disturbance.attach(fleet).bound
    inputs = np.where(np.isfinite(fleet.input_map_bound), fleet.input_map_bound, 0.0)
    region = {"state": np.maximum(_REGION * reach, reach + scenario.duration * (inputs + pushed)), "input": inputs}
    for kind, funnels in _kinds(design):
        layout, (bound, funnel) = funnels.layout, _LETTERS[kind]
        if not layout.size:
            continue
        links = np.maximum.reduceat(layout.arrays.diagonal, layout.arrays.pair)[layout.row_target]
        largest = region[kind][layout.row_source]
        needed = _DIGITS * links * np.spacing(largest)
        rho = funnels.rho.infimum()
        row = int(np.argmax(needed / rho))
        if rho[row] < needed[row]:
            agent, name, unit = fleet.component_names()[layout.row_source[row]]
            quantity, unit = (name, unit) if kind == "state" else (f"input effect on {name}", f"{unit}/s")
            raise DesignError(
                f"{bound}(inf) = {funnels.delta.infimum()[row]:.3g} of {agent!r}, component {name!r}, is too small for "
                f"floating point: where the {quantity} may be {largest[row]:.3g} {unit}, {funnel}(inf) = "
                f"{rho[row]:.3g} must exceed {_DIGITS * links[row]:g} units in its last place, {needed[row]:.3g}; take "
                f"{bound}(inf) above {1.05 * needed[row] / funnels.gain[row]:.2g}"
            )


_LETTERS = {"state": ("delta", "rho"), "input": ("theta", "omega")}


def _kinds(design: ObserverDesign) -> tuple[tuple[str, Funnels], tuple[str, Funnels]]:
    return ("state", design.states), ("input", design.inputs)


def _targets(design: ObserverDesign) -> dict[int, dict[str, Any]]:
    layout, ids = design.states.layout, design.fleet.ids
    shares = [design.states.share[block.pairs] for block in layout.blocks]
    return {
        i: {
            "agent": ids[i],
            "k_hop": [ids[j] for j in design.neighborhoods[i]],
            "eta": len(design.neighborhoods[i]),
            "lambda_min": smallest,
            "lambda_max": largest,
            "own_bound": [float(share.min()), float(share.max())],
            "drift_known": design.options[i].drift,
            "state": [],
            "input": [],
        }
        for i, (smallest, largest), share in zip(
            layout.target.tolist(), layout.eigenvalues.tolist(), shares, strict=True
        )
    }


def _funnel_groups(
    design: ObserverDesign, funnels: Funnels, share: FloatArray, bound_name: str, funnel_name: str
) -> dict[int, list[dict[str, Any]]]:
    """Per target: its components, grouped by equal bounds."""
    layout = funnels.layout
    described: dict[tuple[Hashable, float], dict[str, Any]] = {}
    targets: dict[int, list[dict[str, Any]]] = {}
    for block in layout.blocks:
        i, n, first = block.agent, block.components, block.rows.start
        groups: dict[Hashable, dict[str, Any]] = {}
        for row, component in zip(range(first, first + n), design.fleet.models[i].states, strict=True):
            bound = funnels.bounds[row]
            same = bound if isinstance(bound, Exponential) else id(bound)  # a user's own function need not be hashable
            key = same, float(funnels.gain[row])
            if key not in described:
                described[key] = {bound_name: _numbers(bound), funnel_name: _numbers(funnels.rho.functions[row])}
            group = groups.setdefault(same, {"components": [], **described[key], "start_share": []})
            group["components"].append(component)
            group["start_share"].append(share[row])
        targets[i] = [{**group, "start_share": _finite(max(group["start_share"]))} for group in groups.values()]
    return targets


def _numbers(function: PerformanceFunction) -> dict[str, float | None]:
    return {
        "initial": _finite(function(np.zeros(1))[0]),
        "final": _finite(function.infimum()),
        "rate": function.rate if isinstance(function, Exponential) else None,
    }


def _finite(value: float) -> float | None:
    return float(value) if np.isfinite(value) else None
