"""The whole loop against an answer in closed form, and the integrator's own order through env.step."""

import itertools

import networkx as nx
import numpy as np
import pytest
from scipy.linalg import expm

from khop_env import consensus_v0
from khop_env.observers import Exponential
from khop_env.physics import DriftingIntegrator, SingleIntegrator
from khop_env.scenarios import Scenario

AGENTS, KAPPA, LIMIT = 5, 0.4, 40.0
GRAPH = nx.Graph([(0, 1), (1, 2), (2, 3), (3, 4), (0, 2)])
TASK = nx.Graph([(0, 2), (2, 4), (1, 3), (0, 3), (1, 4)])
LAPLACIAN = nx.laplacian_matrix(TASK, nodelist=range(AGENTS)).toarray().astype(float)


def scenario(model):
    """Five agents that are neighbours of all others or estimate them, without disturbance."""
    task = nx.Graph()
    task.add_nodes_from(range(AGENTS))
    task.add_edges_from(TASK.edges)
    return Scenario(
        name="closed_form",
        description="5 agents without disturbance",
        models=(model,) * AGENTS,
        communication=GRAPH,
        task=task,
        k=4,
        delta=Exponential(1.0, 0.1, 5.0),
        theta=Exponential(1.0, 1.0, 5.0),
        radius=1.5,
    ).sized()


INTEGRATORS, DRIFTERS = scenario(SingleIntegrator(input_limit=LIMIT)), scenario(DriftingIntegrator(input_limit=LIMIT))


def follow_the_law(env, cycles):
    """Linear consensus from the agents' observations alone: u_i = kappa * sum of the relative positions it sees."""
    observations, _ = env.reset(seed=2)
    start = env.state().reshape(AGENTS, 2).astype(float)
    path = [start]
    for _ in range(cycles):
        actions = {}
        for agent, observation in observations.items():
            seen = env.layout(agent).read(observation)
            sums = [
                sum(seen[f"slot{q}.position.{axis}"] * seen[f"slot{q}.task_edge"] for q in range(AGENTS - 1))
                for axis in "xy"
            ]
            actions[agent] = (KAPPA * np.array(sums) / LIMIT).astype(np.float32)
        observations, *_ = env.step(actions)
        path.append(env.state().reshape(AGENTS, 2).astype(float))
    return np.array(path)


@pytest.mark.parametrize("order", [1, 2])
@pytest.mark.parametrize("uniform", [True, False])
def test_sampled_consensus_is_a_matrix_power(order, uniform):
    """x(n h) = (I - kappa h L)^n x(0), to the float32 of observations and actions, with the truth in the slots."""
    h, cycles = 0.05, 40
    env = consensus_v0.parallel_env(INTEGRATORS, observe="oracle", control_period=h, uniform=uniform, order=order)
    path = follow_the_law(env, cycles)
    step = np.eye(AGENTS) - KAPPA * h * LAPLACIAN
    for n, x in enumerate(path):
        np.testing.assert_allclose(x, np.linalg.matrix_power(step, n) @ path[0], atol=2e-6)
    assert np.ptp(path[-1], axis=0).max() < 0.5 * np.ptp(path[0], axis=0).max()  # they do meet


def test_substeps_change_nothing_of_it():
    """Between the agent's actions the input is held, so finer steps of the simulator give the same answer."""
    paths = [
        follow_the_law(consensus_v0.parallel_env(INTEGRATORS, observe="oracle", control_period=0.05, dt=dt), 10)
        for dt in (None, 0.025, 0.01)
    ]
    for path in paths[1:]:
        np.testing.assert_allclose(path, paths[0], atol=1e-6)


def test_estimates_come_near_to_it():
    """With estimates instead of the truth the closed form isn't met, but nearly, as the bounds shrink."""
    env = consensus_v0.parallel_env(INTEGRATORS, observe="estimate", control_period=0.05)
    path = follow_the_law(env, 60)
    exact = np.linalg.matrix_power(np.eye(AGENTS) - KAPPA * 0.05 * LAPLACIAN, 60) @ path[0]
    assert 1e-5 < np.abs(path[-1] - exact).max() < 0.5


def slope(steps, errors):
    """Of the straight line through the errors over the steps, both logarithmic."""
    return np.polyfit(np.log(steps), np.log(errors), 1)[0]


def test_sampling_costs_one_order_of_the_control_period():
    """The distance to the continuous-time answer expm(-kappa L t) x(0) falls with slope 1 +- 0.2."""
    duration, periods = 1.0, np.array([0.1, 0.05, 0.025, 0.0125])
    errors = []
    for h in periods:
        env = consensus_v0.parallel_env(INTEGRATORS, observe="oracle", control_period=h, max_cycles=1000)
        path = follow_the_law(env, round(duration / h))
        errors.append(np.abs(path[-1] - expm(-KAPPA * duration * LAPLACIAN) @ path[0]).max())
    assert slope(periods, errors) == pytest.approx(1.0, abs=0.2)
    for one, other in itertools.pairwise(errors):
        assert np.log2(one / other) == pytest.approx(1.0, abs=0.2)


@pytest.mark.parametrize("order", [1, 2])
def test_the_integrator_s_own_order_shows_through_step(order):
    """Actions given in advance at a fixed control period, agents with drift: refining dt has slope order +- 0.2."""
    period, cycles = 0.2, 5
    actions = np.random.default_rng(0).uniform(-0.05, 0.05, (cycles, 1, AGENTS, 2))

    def end(steps, order):
        env = consensus_v0.batched_env(DRIFTERS, control_period=period, dt=period / steps, order=order)
        env.reset(seed=1)
        for one in actions:
            env.step(one)
        return env.simulator.x[0].copy()

    exact = end(640, 2)
    counts = np.array([5, 10, 20, 40])
    errors = [np.abs(end(count, order) - exact).max() for count in counts]
    assert slope(period / counts, errors) == pytest.approx(order, abs=0.2)
    for one, other in itertools.pairwise(errors):
        assert np.log2(one / other) == pytest.approx(order, abs=0.2)
