"""The design report: what a control engineer wants to know before running, as plain JSON."""

from __future__ import annotations

from collections.abc import Hashable
from typing import Any

import numpy as np

from khop_env.observers import DesignError, Exponential, FloatArray, Funnels, ObserverDesign, PerformanceFunction
from khop_env.observers.design import design_rule_for
from khop_env.physics import one_way_links
from khop_env.results.assumptions import assumptions
from khop_env.scenarios import Scenario
from khop_env.simulation.simulator import parts_of_step


def design_report(scenario: Scenario) -> dict[str, Any]:
    """Everything that the observers of a scenario rest on.

    Returns:
        feasible: whether every condition of the observers holds that can be checked before the start; `error` says
            which doesn't.
        edges: of the communication graph, or its links if it is directed; one_way_links: how many have no link back.
        design_rule: from the bounds delta and theta to the funnels rho and omega.
        targets: per agent that is estimated: its k-hop set (the agents that estimate it), eta, lambda_min and
            lambda_max of M_i (moduli of eigenvalues where links go one way), own_bound, the smallest and the largest of
            its observers' own guaranteed bounds over delta (theta), and under `state` and `input` per group of
            components with equal numbers: delta and rho (theta and omega), each with its value at 0 and at infinity and
            its rate, and start_share, the largest |xi(0)| / rho(0) over the initial set; null where |g| is unbounded,
            so that only `Simulator.reset` can tell.
        pairs: of observer and target; estimates: numbers that they estimate.
        explicit_step_bound_s: no explicit Euler step longer than this is stable at steady state (it has to be far
            shorter): the smallest over all targets, for both kinds of observers.
        assumptions: the paper's six, each with a status and why.

    Numbers that are infinite or unknown are null. All keys are there in any case: where the observers can't be
    designed at all, what follows from a design is null, and targets and assumptions are empty.
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
    try:  # as the simulator does: where g is unbounded, its reset checks where the inputs start
        design.require_feasible_start(scenario.initial.radius, np.where(np.isfinite(bound), bound, 0.0))
        parts_of_step(scenario.dt, longest, scenario.fleet.ids[agent])
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
    report["assumptions"] = [vars(one) for one in assumptions(scenario)]
    return report


_DIGITS = 4.0  # units in the last place of an estimate that rho has to exceed, for each link of its observer
_REGION = 10.0  # states are taken to stay within this many times the initial set


def _require_digits(scenario: Scenario) -> None:
    """Refuse bounds that floating point can't keep: an estimate is rounded to a unit in its last place.

    A disagreement adds up as many differences of estimates as its observer has links, d_a, each off by a unit or so.
    States are taken to stay within `_REGION` times the initial set, or as far as inputs and disturbances drive them.

    Raises:
        DesignError: naming agent, component and the smallest delta (theta) at infinity that can be kept there.
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
            who, name, unit = fleet.component_names()[layout.row_source[row]]
            what, unit = (name, unit) if kind == "state" else (f"input effect on {name}", f"{unit}/s")
            raise DesignError(
                f"{bound}(inf) = {funnels.delta.infimum()[row]:.3g} of {who!r}, component {name!r}, is too small for "
                f"floating point: where the {what} may be {largest[row]:.3g} {unit}, {funnel}(inf) = {rho[row]:.3g} "
                f"has to exceed {_DIGITS * links[row]:g} units in its last place, {needed[row]:.3g}; take {bound}(inf) "
                f"above {1.05 * needed[row] / funnels.gain[row]:.2g}"
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
    """Per target: its components, those with equal bounds together."""
    layout = funnels.layout
    described: dict[tuple[Hashable, float], dict[str, Any]] = {}
    targets: dict[int, list[dict[str, Any]]] = {}
    for block in layout.blocks:
        i, n, first = block.agent, block.components, block.rows.start
        groups: dict[Hashable, dict[str, Any]] = {}
        for row, component in zip(range(first, first + n), design.fleet.models[i].states, strict=True):
            bound = funnels.bounds[row]
            same = bound if isinstance(bound, Exponential) else id(bound)  # a user's own need not be hashable
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
