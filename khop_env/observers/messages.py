"""The observers as robots would run them: one object per agent, which uses only the messages of its neighbours.

A slow and simple reference for the batched right-hand side, which shows that the observers are decentralised.
`Explicit(MessagePassing)` integrates it.
"""

from __future__ import annotations

from collections.abc import Collection, Mapping, Sequence
from dataclasses import dataclass, field

import numpy as np

from khop_env.observers.base import PlantState
from khop_env.observers.design import Funnels, ObserverDesign
from khop_env.observers.explicit import Derivative
from khop_env.observers.funnel_observers import LinksNow
from khop_env.observers.layout import FloatArray
from khop_env.observers.performance import PerformanceFunction
from khop_env.physics import AgentModel


@dataclass(frozen=True)
class Broadcast:
    """The message that an agent broadcasts to its 1-hop neighbours.

    Attributes:
        state: its own x_i, (n_i,).
        input_map: its own g_i(u_i), (n_i,).
        relayed: under the relay assumption, x and g of each of its neighbours, which it measures.
        estimates: its estimate of each of the targets' states that reach it.
        input_estimates: likewise of their input maps.
    """

    state: FloatArray
    input_map: FloatArray
    relayed: Mapping[int, tuple[FloatArray, FloatArray]]
    estimates: Mapping[int, FloatArray]
    input_estimates: Mapping[int, FloatArray]

    def knows(self, i: int, sender: int) -> bool:
        """Whether the true state of `i` is in this message of `sender`."""
        return i == sender or i in self.relayed

    def truth(self, i: int, sender: int) -> tuple[FloatArray, FloatArray]:
        """x_i and g_i(u_i) in this message of `sender`."""
        return (self.state, self.input_map) if i == sender else self.relayed[i]


@dataclass
class HeldEstimate:
    """Memory of one agent about one target: fixed design data, and its two estimates.

    Attributes:
        model: of the target.
        drift_known: whether the observer uses f_i.
        rho: funnels of the state observer, one per component.
        omega: funnels of the input observer; None without one.
        peers: neighbours that estimate the target, too.
        relays: neighbours that send the target's true state: common neighbours, or the target itself.
        estimate: (n_i,) of the state.
        input_estimate: (n_i,) of g_i(u_i).
    """

    model: AgentModel
    drift_known: bool
    rho: tuple[PerformanceFunction, ...]
    omega: tuple[PerformanceFunction, ...] | None
    peers: tuple[int, ...]
    relays: tuple[int, ...]
    estimate: FloatArray = field(default_factory=lambda: np.zeros(0))
    input_estimate: FloatArray = field(default_factory=lambda: np.zeros(0))


class ObserverAgent:
    """The observers of one agent; their only inputs are the messages in its inbox.

    Args:
        index: of the agent.
        targets: its memory about each agent that it estimates.
    """

    def __init__(self, index: int, targets: dict[int, HeldEstimate]) -> None:
        self.index, self.targets = index, targets

    def reached(self, i: int, inbox: Mapping[int, Broadcast]) -> bool:
        """Whether target `i` reaches this agent: a neighbour sends its true state, or an estimate of it."""
        target = self.targets[i]
        return any(inbox[p].knows(i, p) for p in target.relays if p in inbox) or any(
            i in inbox[p].estimates for p in target.peers if p in inbox
        )

    def message(
        self,
        state: FloatArray,
        input_map: FloatArray,
        measured: Mapping[int, tuple[FloatArray, FloatArray]],
        known: Collection[int],
    ) -> Broadcast:
        """The message to its neighbours: its own state and input, measurements of its neighbours, and its estimates.

        Args:
            state: its own.
            input_map: its own.
            measured: states and input maps of its neighbours.
            known: the targets that reach it; of others it knows nothing new, and sends nothing.
        """
        targets = {i: target for i, target in self.targets.items() if i in known}
        return Broadcast(
            state,
            input_map,
            measured,
            {i: target.estimate for i, target in targets.items()},
            {i: target.input_estimate for i, target in targets.items() if target.omega is not None},
        )

    def derivative(self, t: float, i: int, inbox: Mapping[int, Broadcast]) -> tuple[FloatArray, ...]:
        """Rates of change of its estimates of target `i`, (n_i,) each, and the normalised disagreements e and q.

        Without an input observer of that target the second and the fourth are empty.
        """
        target = self.targets[i]
        relayed = [inbox[p].truth(i, p) for p in target.relays if p in inbox and inbox[p].knows(i, p)]
        peers = [p for p in target.peers if p in inbox and i in inbox[p].estimates]
        others = [inbox[p].estimates[i] for p in peers] + [state for state, _ in relayed]
        rate, e = _correction(t, _disagreement(target.estimate, others), target.rho)
        if target.drift_known:
            rate = rate + target.model.drift(np.array([t]), target.estimate[None])[0]
        if target.omega is None:
            return rate, np.zeros(0), e, np.zeros(0)
        others = [inbox[p].input_estimates[i] for p in peers] + [input_map for _, input_map in relayed]
        input_rate, q = _correction(t, _disagreement(target.input_estimate, others), target.omega)
        return rate + target.input_estimate, input_rate, e, q


def _disagreement(own: FloatArray, others: list[FloatArray]) -> FloatArray:
    """Sum of the differences between the own estimate and each of the others."""
    total = np.zeros_like(own)
    for other in others:
        total += own - other
    return total


def _correction(t: float, xi: FloatArray, funnels: tuple[PerformanceFunction, ...]) -> tuple[FloatArray, FloatArray]:
    rho = np.array([float(funnel(np.array([t]))[0]) for funnel in funnels])
    e = xi / rho
    with np.errstate(invalid="ignore", divide="ignore"):  # |e| >= 1 is reported by the integrator
        return -2.0 / (1.0 - e**2) * np.log((1.0 + e) / (1.0 - e)) / rho, e


class MessagePassing:
    """The observers' derivative, agent by agent and message by message; a `RightHandSide`.

    Args:
        design: the observers.
        num_envs: number of environments B.
    """

    def __init__(self, design: ObserverDesign, num_envs: int) -> None:
        self._design, senders = design, design.links.senders
        self._links = None if design.schedule is None else LinksNow(design, num_envs)
        rho = _per_target(design.states)
        omega = _per_target(design.inputs)
        self.agents: list[ObserverAgent] = []
        for a in range(len(design.fleet)):
            targets = {}
            for i in sorted(i for observer, i in design.states.layout.slot if observer == a):
                relays = [p for p in senders[a] if (i in senders[p] if design.relay else p == i)]
                targets[i] = HeldEstimate(
                    design.fleet.models[i],
                    design.options[i].drift,
                    rho[i],
                    omega.get(i),
                    peers=tuple(sorted(senders[a] & set(design.neighborhoods[i]))),
                    relays=tuple(sorted(relays)),
                )
            self.agents.append(ObserverAgent(a, targets))

    def __call__(self, state: PlantState, rho: FloatArray, omega: FloatArray) -> Derivative:
        """See `RightHandSide`."""
        estimate, input_estimate = state.memory["estimate"], state.memory["input_estimate"]
        found = Derivative(*(np.zeros_like(values) for values in (estimate, input_estimate) * 2))
        links = self._design.links
        for env in range(state.t.size):
            senders: Sequence[Collection[int]] = links.senders
            if self._links is not None:
                up = self._links.up(state)[:, env]
                senders = [links.sender[up & (links.receiver == a)].tolist() for a in range(links.agents)]
            self._in_one_environment(state, env, senders, found)
        return found

    def _in_one_environment(
        self, state: PlantState, env: int, senders: Sequence[Collection[int]], found: Derivative
    ) -> None:
        design, fleet, memory = self._design, self._design.fleet, state.memory
        slot, input_slot = design.states.layout.slot, design.inputs.layout.slot
        for agent in self.agents:
            for i, target in agent.targets.items():
                at, n = slot[agent.index, i], target.model.n
                target.estimate = memory["estimate"][at : at + n, env]
                if target.omega is not None:
                    at = input_slot[agent.index, i]
                    target.input_estimate = memory["input_estimate"][at : at + n, env]

        own = [(state.x[fleet.state_slice(i), env], state.g[fleet.state_slice(i), env]) for i in range(len(fleet))]
        measured = [{j: own[j] for j in senders[a]} if design.relay else {} for a in range(len(fleet))]
        known: list[set[int]] = [set() for _ in self.agents]
        spreading = True
        while spreading:  # exchange takes no time: until no target reaches one more agent
            sent = [a.message(*own[a.index], measured[a.index], known[a.index]) for a in self.agents]
            inboxes = [{j: sent[j] for j in senders[a.index]} for a in self.agents]
            reached = [{i for i in a.targets if a.reached(i, inboxes[a.index])} for a in self.agents]
            spreading, known = reached != known, reached
        for agent in self.agents:
            inbox = inboxes[agent.index]
            for i, target in agent.targets.items():
                rate, input_rate, normalized, input_normalized = agent.derivative(float(state.t[env]), i, inbox)
                at, n = slot[agent.index, i], target.model.n
                found.estimate[at : at + n, env], found.e[at : at + n, env] = rate, normalized
                if target.omega is not None:
                    at = input_slot[agent.index, i]
                    found.input_estimate[at : at + n, env], found.q[at : at + n, env] = input_rate, input_normalized


def _per_target(funnels: Funnels) -> dict[int, tuple[PerformanceFunction, ...]]:
    layout, functions = funnels.layout, funnels.rho.functions
    return {block.agent: functions[block.rows] for block in layout.blocks}
