"""The design rule: from bounds on the estimation errors (delta, theta) to funnels on the disagreements (rho, omega).

Disagreements and errors of the observers of target i obey xi = M_i x_tilde. With one bound delta_i per target and
component, all its eta_i observers get one funnel, by one of two rules:

    "paper":  rho_i(t) = lambda_min(M_i) / sqrt(eta_i) delta_i(t)   (Problem 2: |rho_i| <= lambda_min(M_i) delta_i)
    "sharp":  rho_i(t) = delta_i(t) / max_a [M_i^-1 1]_a            (the widest: docs/theory/graphs.md)

Either way M_i^-1 >= 0 entry by entry, so that |xi| < rho_i bounds the error of each observer a by its own number

    |x_tilde_a| < [M_i^-1 1]_a rho_i(t) <= delta_i(t).

The whole way from bounds to funnels: docs/theory/design.md.
"""

from __future__ import annotations

import copy
import functools
from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field
from functools import cached_property
from typing import Literal, get_args

import networkx as nx
import numpy as np

from khop_env.brief import brief
from khop_env.network import Activity, Fixed, Schedule
from khop_env.observers.layout import FloatArray, PairLayout
from khop_env.observers.performance import FunnelBank, PerformanceFunction, scaled
from khop_env.physics import Fleet, Links, k_hop_neighbors, one_way_links, validate_graph

Bound = PerformanceFunction | Sequence[PerformanceFunction]
"""A bound on a target's estimation error: one function for all its components, or one for each.

All observers of a target share it; bounds that differ between observers go through `lower_bound` first.
"""

DesignRule = Literal["paper", "sharp"]
"""From a bound on errors to a funnel: the paper's sufficient rule, or the widest funnel with the same guarantee."""


class DesignError(ValueError):
    """The observers can't be designed with these arguments; the message names a value that is feasible."""


def design_rule_for(graph: nx.Graph, rule: DesignRule | None) -> DesignRule:
    """The design rule on a communication graph: `rule`, or the default, "sharp" where links go one way.

    Raises:
        ValueError: for an unknown rule; the message names the known ones.
    """
    if rule is None:
        return "sharp" if one_way_links(graph) else "paper"
    if not isinstance(rule, str) or rule not in get_args(DesignRule):
        raise ValueError(f"design_rule must be one of {', '.join(get_args(DesignRule))}; got {rule!r}")
    return rule


@dataclass(frozen=True)
class TargetObservers:
    """Options of the observers of one target: the paper's simplifications.

    Attributes:
        drift: whether the observers know f_i (without it the agent's motion has to be bounded: Theorem 2).
        input_observer: whether g_i(u_i) is estimated too (PPIO; needs a bounded derivative of g_i: Theorem 3). Without
            it g_i has to be bounded (the remark on Theorem 1) and counts as a disturbance.
    """

    drift: bool = True
    input_observer: bool = True


@dataclass(frozen=True, eq=False)
class Funnels:
    """The funnels of one kind of observer: a layout, the bounds on the errors, and the design rule's results.

    Attributes:
        layout: the pairs (observer, target).
        bounds: per row of the layout, delta (or theta): the bound on the estimation error.
        rule: the design rule.
    """

    layout: PairLayout
    bounds: tuple[PerformanceFunction, ...]
    rule: DesignRule = "paper"

    __repr__ = brief

    @cached_property
    def gain(self) -> FloatArray:
        """(rows,) the design rule's factor on delta: lambda_min(M_i) / sqrt(eta_i), or 1 / max_a [M_i^-1 1]_a."""
        layout = self.layout
        if self.rule == "paper":
            per_target = layout.eigenvalues[:, 0] / np.sqrt(layout.arrays.observers)
        else:
            largest = [layout.inverse_row_sums[block.pairs].max() for block in layout.blocks]
            per_target = 1.0 / np.array(largest, float)
        return per_target[layout.row_target]

    @cached_property
    def share(self) -> FloatArray:
        """(pairs,) each observer's own guaranteed bound [M_i^-1 1]_a rho_i, as a fraction of delta_i."""
        layout = self.layout
        per_target = self.gain[layout.arrays.row]  # equal for all components
        # at most 1, but for rounding
        return np.minimum(np.repeat(per_target, layout.arrays.observers) * layout.inverse_row_sums, 1.0)

    @cached_property
    def delta(self) -> FunnelBank:
        """The bounds on the estimation errors, row by row."""
        return FunnelBank(self.bounds)

    @cached_property
    def rho(self) -> FunnelBank:
        """The funnels on the disagreements that the design rule gives, row by row."""
        return FunnelBank([scaled(bound, gain) for bound, gain in zip(self.bounds, self.gain, strict=True)])

    def error_bounds(self, delta: FloatArray, out: FloatArray) -> FloatArray:
        """The guaranteed bound on the error of every estimate: its observer's own share of delta.

        Args:
            delta: (rows, B) values of `delta`.
            out: (P, B), written and returned; never above delta.
        """
        np.take(delta, self.layout.column_row, axis=0, out=out, mode="clip")  # the default mode copies `out` first
        return np.multiply(out, self.share[self.layout.column_pair, None], out=out)

    def largest_relay(self) -> FloatArray:
        """(rows,) h_max: with one common first guess c the disagreement starts as xi = H (c - x_i)."""
        per_target = [self.layout.arrays.relay[block.pairs].max() for block in self.layout.blocks]
        return np.array(per_target, float)[self.layout.row_target]

    def feasible_at_start(self, radius: FloatArray) -> FloatArray:
        """(rows,) largest |xi(0)| over the initial set, as a fraction of rho(0): must be below 1.

        Args:
            radius: (n,) largest distance of each true component from the observers' common first guess at t = 0.
        """
        start = self.rho.evaluate(np.zeros(1), np.empty((self.layout.rows, 1)))[:, 0]
        return self.largest_relay() * radius[self.layout.row_source] / start

    def smallest_initial_bound(self, radius: FloatArray) -> FloatArray:
        """(rows,) infimum of the delta(0) that are feasible for the initial set; any larger value is feasible.

        Args:
            radius: as in `feasible_at_start`.
        """
        return self.largest_relay() * radius[self.layout.row_source] / self.gain

    def explicit_step_bound(self) -> FloatArray:
        """(targets,) longest stable step of explicit Euler at steady state and e = 0, in s.

        It is 2 / (lambda_max(M_i) phi''(0) / rho(inf)^2) with phi''(0) = 4, and `PairLayout.euler_rate` in place of
        lambda_max on a directed graph. Away from e = 0 the stable step is up to a
        hundred times shorter, so choose steps far below it.
        """
        floor = self.rho.infimum()
        per_target = np.full(len(self.layout.target), np.inf)
        np.minimum.at(per_target, self.layout.row_target, floor)
        return 0.5 * per_target**2 / self.layout.euler_rate


@dataclass(frozen=True, eq=False)
class ObserverDesign:
    """All observers of a fleet: k-hop sets, layouts and funnels of the state and the input observers.

    Args:
        fleet: the agents.
        communication: their communication graph, nodes 0..N-1, connected; a networkx.DiGraph for links that go one
            way, with an edge b -> a where agent a hears agent b.
        k: estimate agents up to k hops away, along the links.
        delta: bound on the state estimation errors: one performance function for all, or one `Bound` per target.
        theta: likewise for the input estimation errors; may be None where no target has an input observer.
        relay: whether agents relay their neighbours' states (Assumption 4); without it 1-hop neighbours are estimated
            too, from the target's own messages (the paper's remarks).
        targets: per agent the options of its observers; `TargetObservers()` by default, without the input observer
            where the input map depends on the state.
        design_rule: from delta to the funnels, "paper" or "sharp"; by default the paper's, or the sharp one where links
            go one way and the paper's, which needs symmetric matrices, doesn't apply.
        schedule: which links are up, and when; None for all of them, always. The graph has all that may ever be up: it
            says who observes whom, and gives the funnels.

    Attributes:
        links: the directed links of the graph.
        neighborhoods: per agent the agents that estimate it; on an undirected graph also those that it estimates.
        options: per agent the options of its observers.
        states: the state observers' pairs and funnels.
        inputs: the input observers'.

    Raises:
        DesignError: the paper's design rule where links go one way, an input observer for an agent whose g depends on
            its state, none for an agent whose g is unbounded, or a bound that is missing or of a wrong length.
        ValueError: a graph that isn't connected and labelled 0..N-1, an unknown design rule, or a schedule with links
            that the graph doesn't have.
    """

    fleet: Fleet
    communication: nx.Graph
    k: int
    delta: PerformanceFunction | Mapping[int, Bound]
    theta: PerformanceFunction | Mapping[int, Bound] | None = None
    relay: bool = True
    targets: Sequence[TargetObservers] | None = None
    design_rule: DesignRule | None = None
    schedule: Schedule | None = None
    links: Links = field(init=False)
    neighborhoods: tuple[tuple[int, ...], ...] = field(init=False)
    options: tuple[TargetObservers, ...] = field(init=False)
    states: Funnels = field(init=False)
    inputs: Funnels = field(init=False)

    def __post_init__(self) -> None:
        fleet = self.fleet
        validate_graph(self.communication, len(fleet), directed=True)
        rule = design_rule_for(self.communication, self.design_rule)
        one_way = one_way_links(self.communication)
        if rule == "paper" and one_way:
            sender, receiver = (fleet.ids[i] for i in one_way[0])
            raise DesignError(
                f'design_rule = "paper" needs symmetric matrices M_i, and '
                f"{len(one_way)} link{' goes' if len(one_way) == 1 else 's go'} one way, the first "
                f'from {sender!r} to {receiver!r}; take design_rule = "sharp", or links both ways'
            )
        options = self.targets or [TargetObservers(input_observer=not m.input_map_uses_state) for m in fleet.models]
        if len(options) != len(fleet):
            raise DesignError(f"targets has {len(options)} entries, the fleet {len(fleet)} agents; give one per agent")
        for i, (model, option) in enumerate(zip(fleet.models, options, strict=True)):
            if option.input_observer and model.input_map_uses_state:
                raise DesignError(
                    f"agent {fleet.ids[i]!r} can't have an input observer: its input map g(x, u) depends on its state, "
                    "and Theorem 3 is about g(u); set input_observer=False for it"
                )
            if not option.input_observer and not model.input_map_bounded:
                raise DesignError(
                    f"agent {fleet.ids[i]!r} can't do without an input observer: its input map is unbounded "
                    "(Assumption 2-i); give its inputs finite limits or set input_observer=True"
                )
        neighborhoods = k_hop_neighbors(self.communication, self.k, relay=self.relay)
        links, dimensions = Links.of(self.communication), [model.n for model in fleet.models]
        observed_inputs = [i for i, option in enumerate(options) if option.input_observer]
        if observed_inputs and self.theta is None:
            raise DesignError(
                f"theta is missing: {len(observed_inputs)} agents have an input observer, the first "
                f"{fleet.ids[observed_inputs[0]]!r}; give a bound theta or set input_observer=False"
            )
        lay_out = functools.partial(
            PairLayout.build,
            links,
            neighborhoods,
            dimensions,
            fleet.state_offset,
            relay=self.relay,
            changing=self.schedule is not None,
        )
        states = lay_out()
        inputs = states if len(observed_inputs) == len(fleet) else lay_out(targets=observed_inputs)
        values = {
            "design_rule": rule,
            "links": links,
            "neighborhoods": neighborhoods,
            "options": tuple(options),
            "states": Funnels(states, self._rows(states, self.delta, "delta"), rule),
            "inputs": Funnels(inputs, self._rows(inputs, self.theta, "theta"), rule),
        }
        for name, value in values.items():
            object.__setattr__(self, name, value)
        self.activity()  # raises for a schedule that doesn't fit the graph

    def activity(self) -> Activity:
        """The schedule on this graph's links; all links up, always, without one."""
        return (self.schedule or Fixed()).bind(self.links, self.fleet.position_index)

    @cached_property
    def knowledge(self) -> PairLayout:
        """The pairs (observer, target) up to k hops apart, neighbours included: who knows of whom by messages."""
        neighborhoods = k_hop_neighbors(self.communication, self.k, relay=False)
        dimensions = [model.n for model in self.fleet.models]
        return PairLayout.build(self.links, neighborhoods, dimensions, self.fleet.state_offset, relay=False)

    def __str__(self) -> str:
        pairs = f"{self.states.layout.pairs} state and {self.inputs.layout.pairs} input observers"
        changing = "" if self.schedule is None else ", changing links"
        return f"{self.fleet}; k={self.k}{'' if self.relay else ', no relays'}{changing}, {pairs}"

    def __repr__(self) -> str:
        return f"ObserverDesign({self})"

    def with_bounds(
        self,
        delta: PerformanceFunction | Mapping[int, Bound],
        theta: PerformanceFunction | Mapping[int, Bound] | None = None,
    ) -> ObserverDesign:
        """The same observers with other bounds: graphs, layouts and spectra are shared, not computed again."""
        other, states, inputs = copy.copy(self), self.states, self.inputs
        for name, value in (
            ("delta", delta),
            ("theta", theta),
            ("states", Funnels(states.layout, self._rows(states.layout, delta, "delta"), states.rule)),
            ("inputs", Funnels(inputs.layout, self._rows(inputs.layout, theta, "theta"), inputs.rule)),
        ):
            object.__setattr__(other, name, value)
        return other

    def _rows(
        self, layout: PairLayout, bounds: PerformanceFunction | Mapping[int, Bound] | None, name: str
    ) -> tuple[PerformanceFunction, ...]:
        """One performance function per row of the layout."""
        rows: list[PerformanceFunction] = []
        known: dict[tuple[int, int], object] = {}  # bounds that have passed, by identity and size: often one for all
        for block in layout.blocks:
            i, n = block.agent, block.components
            if isinstance(bounds, Mapping) and i not in bounds:
                raise DesignError(f"{name} has no bound for agent {self.fleet.ids[i]!r}; give one per target")
            bound = bounds[i] if isinstance(bounds, Mapping) else bounds
            if (id(bound), n) in known:
                rows.extend(bound if isinstance(bound, Sequence) else [bound] * n)  # type: ignore[list-item]
                continue
            if isinstance(bound, type):
                raise DesignError(
                    f"{name}: expected an instance, got the class {bound.__name__}; write {bound.__name__}(...)"
                )
            functions = list(bound) if isinstance(bound, Sequence) else [bound] * n
            if len(functions) != n or not all(isinstance(f, PerformanceFunction) for f in functions):
                raise DesignError(
                    f"{name} of agent {self.fleet.ids[i]!r}: expected a performance function or a sequence of {n}, one "
                    f"per state component, got {bound!r}"
                )
            rows.extend(functions)  # type: ignore[arg-type]
            known[id(bound), n] = bound  # kept, so that its identity isn't another's
        return tuple(rows)

    def require_feasible_start(self, state_radius: FloatArray, input_radius: FloatArray) -> None:
        """Refuse funnels that the initial set doesn't fit into.

        Args:
            state_radius: (n,) largest distance of each component of x from the observers' first guess at t = 0.
            input_radius: (n,) likewise for g_i(u_i).

        Raises:
            DesignError: naming the agent and component, |xi(0)| and rho(0), and the infimum of the feasible delta(0).
        """
        for kind, funnels, radius, letters in (
            ("state", self.states, state_radius, ("xi", "rho", "delta")),
            ("input", self.inputs, input_radius, ("mu", "omega", "theta")),
        ):
            share = funnels.feasible_at_start(radius)
            if not np.any(share >= 1.0):
                continue
            row = int(np.argmax(share))
            agent, component, _ = self.fleet.component_names()[funnels.layout.row_source[row]]
            xi, rho, delta = letters
            start = float(funnels.rho.functions[row](np.zeros(1))[0])
            bound = float(funnels.bounds[row](np.zeros(1))[0])
            raise DesignError(
                f"the {kind} observers of {agent!r} can't start inside their funnel: component {component!r} may have "
                f"|{xi}(0)| = {share[row] * start:.4g}, but {rho}(0) = {start:.4g} (from {delta}(0) = {bound:.4g}); "
                f"take {delta}(0) above {funnels.smallest_initial_bound(radius)[row]:.4g}, or a smaller initial set"
            )
