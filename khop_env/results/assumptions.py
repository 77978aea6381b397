"""Check of the paper's six assumptions on a scenario: status and reason of each."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Literal

import networkx as nx
import numpy as np

from khop_env.observers import Exponential, FloatArray, FunnelBank, Funnels
from khop_env.physics import BandLimitedNoise, DriftingIntegrator, Gust, SingleIntegrator, Sinusoid, one_way_links
from khop_env.results.changing import changing_graph
from khop_env.scenarios import Scenario

Status = Literal["holds", "doesn't hold", "holds by construction", "not known"]

_MARGIN = 1.05  # Assumption 6 is checked for an accuracy this factor above the norm of all infima

_DENSE = 1000  # agents: eigenvalues of a dense matrix take seconds beyond


@dataclass(frozen=True)
class Assumption:
    """One assumption of the paper.

    Attributes:
        number: number in the paper, e.g. "1-ii".
        statement: short form of the assumption.
        status: whether this scenario satisfies it; "not known" if it depends on the user's own functions.
        why: the reason, with numbers.
    """

    number: str
    statement: str
    status: Status
    why: str


def assumptions(scenario: Scenario) -> list[Assumption]:
    """Assumptions 1 to 6 for a scenario whose observers can be designed."""
    return [
        _lipschitz_drift(scenario),
        _measurable_input_map(scenario),
        _bounded_disturbance(scenario),
        _input_map(scenario),
        _fixed_graph(scenario),
        _relay(scenario),
        _nominal_controller(scenario),
        _steady_state_bound(scenario),
    ]


def _lipschitz_drift(scenario: Scenario) -> Assumption:
    constants = {model.type: model.drift_lipschitz() for model in scenario.models}
    known = [value for value in constants.values() if math.isfinite(value)]
    local = [kind for kind, value in constants.items() if math.isinf(value)]
    unknown = [kind for kind, value in constants.items() if math.isnan(value)]
    why = []
    if known:
        names = [kind for kind, value in constants.items() if math.isfinite(value)]
        whose = "" if len(known) == len(constants) else f"{_listed(names)}: "
        why = [f"{whose}Lipschitz, with a declared constant of {max(known):.4g} (1/s) at most"]
    if local:
        why.append(
            f"{_listed(local)}: only locally Lipschitz, but Theorem 1 uses a constant: keep states in a bounded region"
        )
    if unknown:
        why.append(f"{_listed(unknown)}: no constant declared (drift_lipschitz)")
    blind = [i for i, option in enumerate(scenario.design.options) if not option.drift]
    if blind:
        why.append(f"observers of {len(blind)} agents don't use f (Theorem 2): their motion must stay bounded")
    return Assumption("1-i", "each f is locally Lipschitz", "not known" if unknown else "holds", "; ".join(why))


def _measurable_input_map(scenario: Scenario) -> Assumption:
    own = sorted({model.type for model in scenario.models if not type(model).__module__.startswith("khop_env.")})
    return Assumption(
        "1-ii",
        "each g is measurable and locally bounded",
        "not known" if own else "holds",
        f"{_listed(own)}: your own model; any continuous g satisfies it"
        if own
        else "the library's input maps are continuous",
    )


def _bounded_disturbance(scenario: Scenario) -> Assumption:
    statement = "each w is continuous and uniformly bounded"
    bound = _disturbance_bound(scenario)
    if scenario.disturbance is None or not bound.any():
        return Assumption("1-iii", statement, "holds", "w = 0")
    terms = scenario.disturbance.terms
    kinds = _listed(sorted({type(term).__name__ for term in terms}))
    own = sorted({type(term).__name__ for term in terms if not type(term).__module__.startswith("khop_env.")})
    why = f"|w| <= {bound.max():.4g} in every component, as declared by {kinds}"
    if own:
        return Assumption(
            "1-iii",
            statement,
            "not known",
            f"{why}; {_listed(own)}: your own; holds if it is continuous and within the declared bound",
        )
    return Assumption("1-iii", statement, "holds", f"{why}, all continuous")


def _input_map(scenario: Scenario) -> Assumption:
    fleet, options = scenario.fleet, scenario.design.options
    bounded = [i for i in range(len(fleet)) if np.isfinite(fleet.input_map_bound[fleet.state_slice(i)]).all()]
    observed = sum(option.input_observer for option in options)
    why = [f"(i) g is bounded for {len(bounded)} of {len(fleet)} agents"]
    if bounded:
        largest = max(fleet.input_map_bound[fleet.state_slice(i)].max() for i in bounded)
        why[0] += f", |g| <= {largest:.4g} in every component"
    if observed:
        why.append(
            f"(ii) for the {observed} with an input observer g' is bounded while states move at bounded rates under a "
            "Lipschitz law that is evaluated along the trajectory; not under inputs that jump"
        )
    status: Status = "holds" if len(bounded) == len(fleet) else "not known"
    return Assumption("2", "each g is bounded (i), or its time derivative is (ii)", status, "; ".join(why))


def _fixed_graph(scenario: Scenario) -> Assumption:
    statement = "the graph is undirected and doesn't change; each agent knows its k-hop neighbours"
    if scenario.schedule is not None:
        return Assumption("3", statement, "doesn't hold", changing_graph(scenario))
    one_way, edges = len(one_way_links(scenario.communication)), scenario.communication.number_of_edges()
    if one_way:
        return Assumption(
            "3",
            statement,
            "doesn't hold",
            f"{one_way} of {edges} links go one way. In continuous time our extension of Theorems 1 to 3 holds instead "
            "(docs/theory/graphs.md): the graph is fixed, and each target reaches its observers by the links. At the "
            "grid points of the proximal step the funnels are kept by construction",
        )
    kind = f"connected, and all its {edges} links go both ways" if scenario.communication.is_directed() else None
    return Assumption(
        "3",
        statement,
        "holds by construction",
        f"the graph is fixed, {kind or f'undirected and connected ({edges} edges)'}, and neighbourhoods are computed "
        "from it",
    )


def _relay(scenario: Scenario) -> Assumption:
    statement = "agents relay their neighbours' states and inputs"
    if scenario.relay:
        return Assumption(
            "4", statement, "holds by construction", "relay = true: 2-hop observers receive the true value"
        )
    return Assumption(
        "4",
        statement,
        "doesn't hold",
        "relay = false, and not needed: the variant of the paper's remark is used, in which 1-hop neighbours join the "
        "k-hop set",
    )


def _nominal_controller(scenario: Scenario) -> Assumption:
    statement = "under the true states the law reaches the goal set whatever w is"
    if not _disturbance_bound(scenario).any():
        status, why = _undisturbed(scenario)
        return Assumption("5", statement, status, f"w = 0; {why}")
    assert scenario.disturbance is not None
    positions = set(scenario.fleet.position_index.ravel().tolist())
    lasting = {
        type(term).__name__
        for term in scenario.disturbance.terms
        if isinstance(term, BandLimitedNoise | Gust | Sinusoid)
        and positions & set(term.channels(scenario.fleet).index.tolist())
    }
    if lasting and scenario.task.number_of_edges():
        return Assumption(
            "5",
            statement,
            "doesn't hold",
            f"w acts on positions permanently ({_listed(sorted(lasting))}), and a law without knowledge of w can't "
            "cancel it: agents stay at some distance from the goal set. The effect of estimates is the excess over the "
            "distance under the true states (compare --observe oracle)",
        )
    return Assumption(
        "5",
        statement,
        "not known",
        "w acts on positions through other states only, or vanishes in agreement, or is your own: the final distance "
        "is measured only (compare --observe oracle)",
    )


def _disturbance_bound(scenario: Scenario) -> FloatArray:
    """(n,) bound on each component of |w|; zeros without a disturbance."""
    if scenario.disturbance is None:
        return np.zeros(scenario.fleet.n)
    return scenario.disturbance.attach(scenario.fleet).bound


def _undisturbed(scenario: Scenario) -> tuple[Status, str]:
    """Status and reason: does the tanh law reach agreement without a disturbance?"""
    models = scenario.models
    if not nx.is_connected(scenario.task):
        return "doesn't hold", "the task graph isn't connected, so agreement is possible within its components only"
    if len(models) == 1:
        return "holds", "a single agent is in the goal set"
    if scenario.law.name != "tanh":
        return "not known", f"no proof is implemented for the law {scenario.law.name!r}"
    if all(isinstance(model, SingleIntegrator) for model in models):
        # u is minus V's gradient, clipped component by component, and V is convex with its minimum at agreement only
        return "holds", (
            "the sum of log cosh of the displacements along all task edges decreases until agents agree: integrators "
            "under the tanh law descend it, inputs at their limits included, and the task graph is connected"
        )
    if all(isinstance(model, DriftingIntegrator) for model in models) and len(models) <= _DENSE:
        # near agreement tanh(z) = z and no input is at its limit: e' = (f' - k_c L_T) e, and |f'| <= l_f
        adjacency = nx.to_numpy_array(scenario.task)
        connectivity = float(np.linalg.eigvalsh(np.diag(adjacency.sum(axis=0)) - adjacency)[1])
        enough = max(model.drift_lipschitz() for model in models) / connectivity
        gain = scenario.law.parameters.get("gain")
        return "not known", (
            f"near agreement it holds if the gain k_c exceeds l_f / lambda_2(G_T) = {enough:.4g} 1/s"
            f"{'' if gain is None else f' (here k_c = {gain:.4g})'}; far from it, where tanh saturates, it is measured "
            "only"
        )
    return "not known", "for models other than integrators agreement is measured, not proven"


def _steady_state_bound(scenario: Scenario) -> Assumption:
    statement = "after a finite time t_x the norm of all delta stays below the required accuracy"
    states = scenario.design.states
    if not states.layout.size:
        return Assumption("6", statement, "holds by construction", "no agent is estimated")
    # number of observers with each row's delta
    rows = states.layout.arrays.observers[states.layout.row_target].astype(float)
    floor = float(np.sqrt(rows @ states.delta.infimum() ** 2))
    own = sorted({type(bound).__name__ for bound in states.bounds if not isinstance(bound, Exponential)})
    time = None if own else _first_time_below(lambda t: _norm(states, rows, t), _MARGIN * floor)
    if time is None:
        why = f"convergence to it depends on your own {_listed(own)}" if own else "convergence takes more than a year"
        return Assumption("6", statement, "not known", f"the norm of all infima is {floor:.4g}; {why}")
    return Assumption(
        "6",
        statement,
        "holds by construction",
        f"for any accuracy above the norm of all delta(inf), {floor:.4g}, over all pairs and components; for "
        f"{_MARGIN * floor:.4g} after t_x = {time:.3g} s",
    )


def _norm(states: Funnels, rows: FloatArray, t: float) -> float:
    bank: FunnelBank = states.delta
    values = bank.evaluate(np.array([t]), np.empty((len(bank), 1)))[:, 0]
    return float(np.sqrt(rows @ values**2))


def _first_time_below(norm: Callable[[float], float], level: float) -> float | None:
    """Time in s from which a non-increasing norm stays below `level`; None if it doesn't within a year."""
    low, high = 0.0, 1.0
    while norm(high) > level:
        low, high = high, 2.0 * high
        if high > 3e7:
            return None
    for _ in range(40):
        middle = 0.5 * (low + high)
        low, high = (middle, high) if norm(middle) > level else (low, middle)
    return high


def _listed(names: list[str]) -> str:
    return ", ".join(names[:6]) + (" and others" if len(names) > 6 else "")
