"""The message-passing reference: agents that read their inbox only compute what the batch computes."""

import numpy as np
from hypothesis import given, settings

from agents import make_law
from khop_env.observers import BatchedRightHandSide, Explicit, MessagePassing, Proximal
from khop_env.scenarios import paper
from tests.strategies import systems


def derivatives(simulator):
    """Both right-hand sides at the simulator's present state."""
    design, num_envs, state = simulator.design, simulator.num_envs, simulator.state
    rho, omega = (
        funnels.rho.evaluate(state.t, np.empty((funnels.layout.rows, num_envs)))
        for funnels in (design.states, design.inputs)
    )
    batched, by_messages = BatchedRightHandSide(design, num_envs), MessagePassing(design, num_envs)
    return batched(state, rho, omega), by_messages(state, rho, omega)


@settings(max_examples=40)
@given(system=systems() | systems(directed=True))
def test_messages_equal_the_batch_to_rounding(system):
    """Equations of the disagreements, of the state observer and of the input observer, written per agent."""
    simulator = system.simulator(Proximal(2), num_envs=2)
    rng = np.random.default_rng(system.seed)
    for _ in range(3):
        simulator.step(0.02, u=rng.uniform(-1, 1, simulator.fleet.m) * np.minimum(simulator.fleet.input_limit, 1.0))
    for ours, theirs in zip(*derivatives(simulator), strict=True):
        scale = np.maximum(1.0, np.abs(ours))
        # a correction near the wall amplifies the rounding of e by phi'' / rho
        assert np.all(np.abs(ours - theirs) <= 1e-9 * scale)


def test_an_agent_reads_nothing_but_its_inbox():
    """Derivatives need exactly the messages of the peers and relays: one missing is a KeyError, others don't matter."""
    scenario = paper()
    simulator = scenario.build(law=make_law(scenario.law))
    network = MessagePassing(simulator.design, 1)
    derivatives(simulator)
    for agent in network.agents:
        for target in agent.targets.values():
            assert set(target.peers) | set(target.relays) <= set(scenario.communication[agent.index])


def test_an_explicit_run_by_messages_equals_the_batched_one():
    scenario = paper()
    runs = []
    for right_hand_side in (BatchedRightHandSide, MessagePassing):
        simulator = scenario.build(law=make_law(scenario.law), observers=Explicit(right_hand_side))
        for _ in range(50):
            simulator.step(1e-5)
        runs.append(simulator.save())
    np.testing.assert_allclose(runs[0].x, runs[1].x, rtol=1e-12, atol=1e-13)
    for name in ("estimate", "input_estimate"):
        np.testing.assert_allclose(runs[0].memory[name], runs[1].memory[name], rtol=1e-12, atol=1e-13)
