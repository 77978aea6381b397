"""Decentralisation (the remark after the PPSO's equation): an observer uses what its 1-hop neighbours send, and no
more.

In one message agent l sends its own estimates and, under Assumption 4, the states and inputs of its neighbours.
"""

import numpy as np
from hypothesis import given, settings

from agents import TanhConsensus
from khop_env.observers import BatchedRightHandSide, Proximal
from khop_env.simulation.state import SimulatorState
from tests.strategies import System, relays, systems


class Probe:
    """The observers' derivatives of a system at some state in which all its numbers differ."""

    def __init__(self, system: System) -> None:
        self.design, self.fleet = system.design, system.design.fleet
        simulator = system.simulator(Proximal())
        simulator.step(0.02, self.fleet.input_limit * np.random.default_rng(system.seed).uniform(-1, 1, self.fleet.m))
        self.state = simulator.save()
        self.right_hand_side = BatchedRightHandSide(self.design, 1)
        self.funnels = [
            funnels.rho.evaluate(self.state.t, np.ones((funnels.layout.rows, 1)))
            for funnels in (self.design.states, self.design.inputs)
        ]

    def derivative(self, state: SimulatorState) -> list[np.ndarray]:
        """Of the state estimates and of the input estimates."""
        return [rate.copy() for rate in self.right_hand_side(state, *self.funnels)[:2]]

    def pairs(self):
        """(kind, observer, target, columns) of every estimate of states (0) and inputs (1)."""
        for kind, funnels in enumerate((self.design.states, self.design.inputs)):
            for (observer, target), slot in funnels.layout.slot.items():
                yield kind, observer, target, slice(slot, slot + self.fleet.models[target].n)


@settings(max_examples=60)
@given(system=systems(largest=7))
def test_an_observer_uses_messages_of_its_neighbors_only(system):
    """A change of all that an agent outside N_a and a knows, its state, its effect g and its estimates, changes no bit
    of a's right-hand side, unless it is the target itself, whose state (and g) a neighbour relays where h_a > 0.
    """
    probe, graph = Probe(system), system.design.communication
    before = probe.derivative(probe.state)
    rng = np.random.default_rng(system.seed)
    for j in graph:
        own = system.design.fleet.state_slice(j)
        estimated, everything = probe.state.copy(), probe.state.copy()
        for state in (estimated, everything):
            for kind, observer, _, columns in probe.pairs():
                if observer == j:
                    estimates = state.memory["input_estimate" if kind else "estimate"]
                    estimates[columns] += rng.normal(size=estimates[columns].shape)
        everything.x[own] += rng.normal(size=everything.x[own].shape)
        everything.g[own] += rng.normal(size=everything.g[own].shape)
        after_estimated, after_everything = probe.derivative(estimated), probe.derivative(everything)
        for kind, a, i, columns in probe.pairs():
            if j == a or graph.has_edge(a, j):
                continue
            np.testing.assert_array_equal(after_estimated[kind][columns], before[kind][columns])
            if j != i or relays(graph, a, i, system.design.relay) == 0:
                np.testing.assert_array_equal(after_everything[kind][columns], before[kind][columns])


@settings(max_examples=60)
@given(system=systems(largest=7))
def test_an_observer_does_use_messages_of_its_neighbors(system):
    """The control of the test above: the estimates of a's neighbours in N_i^{k-hop}, and x_i where it is relayed, do
    matter.

    And nothing else of a neighbour does: its own state, and its estimates of third agents, enter the disagreement on i
    in no way.
    """
    probe, graph = Probe(system), system.design.communication
    before = probe.derivative(probe.state)
    slots = [funnels.layout.slot for funnels in (system.design.states, system.design.inputs)]
    for kind, a, i, columns in probe.pairs():
        n = columns.stop - columns.start
        for j in graph[a]:
            changed = probe.state.copy()
            estimates = changed.memory["input_estimate" if kind else "estimate"]
            if (j, i) in slots[kind]:
                slot = slots[kind][j, i]
                estimates[slot : slot + n] += 0.01 * (1.0 + np.abs(estimates[slot : slot + n]))
                assert np.all(probe.derivative(changed)[kind][columns] != before[kind][columns])
            elif j != i:
                for target in graph:
                    if (j, target) in slots[kind]:
                        estimates[slots[kind][j, target]] += 1.0
                changed.x[system.design.fleet.state_slice(j)] += 1.0
                changed.g[system.design.fleet.state_slice(j)] += 1.0
                np.testing.assert_array_equal(probe.derivative(changed)[kind][columns], before[kind][columns])
        changed = probe.state.copy()
        truth = changed.g if kind else changed.x
        own = system.design.fleet.state_slice(i)
        truth[own] += 0.01 * (1.0 + np.abs(truth[own]))
        moved = probe.derivative(changed)[kind][columns] != before[kind][columns]
        assert np.all(moved) if relays(graph, a, i, system.design.relay) else not np.any(moved)


@settings(max_examples=60)
@given(system=systems(largest=7))
def test_a_law_acts_on_what_its_agent_knows(system):
    """u_i = psi_i(x_bar_i, x_hat^i) (Section V): a change of the state of an agent that isn't i's neighbour changes
    no bit of u_i, nor does a change of the estimates of such an agent.
    """
    simulator = system.simulator(Proximal(), law=TanhConsensus(1.0))
    simulator.step(0.02)
    probe, graph, fleet = Probe(system), system.design.communication, system.design.fleet
    plant, state = simulator.plant, simulator.save()

    def inputs(changed: SimulatorState) -> np.ndarray:
        plant.actuate(changed)
        return changed.u.copy()

    before = inputs(state)
    for j in graph:
        changed = state.copy()
        changed.x[fleet.state_slice(j)] += 1.0
        for kind, observer, _, columns in probe.pairs():
            if observer == j and kind == 0:
                changed.memory["estimate"][columns] += 1.0
        after = inputs(changed)
        for i in graph:
            if i != j and not graph.has_edge(i, j):
                np.testing.assert_array_equal(after[fleet.input_slice(i)], before[fleet.input_slice(i)])
