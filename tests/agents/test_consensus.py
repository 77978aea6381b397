"""The paper's law against its formula, and the velocity controllers of all models."""

import networkx as nx
import numpy as np
import pytest

from agents import LAWS, LawError, LinearConsensus, TanhConsensus, make_law
from khop_env.physics import MODELS, AgentModel, velocity_to_input
from khop_env.scenarios import LawChoice, mixed_fleet, paper


def law_input(simulator):
    """u of the law at the simulator's present state."""
    plant, state = simulator.plant, simulator.state
    return plant.law(state.t, plant.views.update(state))


@pytest.mark.parametrize("observe", ["estimate", "oracle", "local"])
@pytest.mark.parametrize("batch", [1, 3])
def test_tanh_law_is_the_papers_sum_over_task_edges(observe, batch):
    scenario = paper()
    simulator = scenario.build(law=make_law(scenario.law), observe=observe, num_envs=batch)
    for _ in range(5):
        simulator.step(0.01)
    u = law_input(simulator).reshape(batch, 8, 2)
    x = simulator.x.reshape(batch, 8, 2)
    slot = simulator.design.states.layout.slot
    for b in range(batch):
        for i in range(8):
            expected = np.zeros(2)
            for j in scenario.task[i]:
                if scenario.communication.has_edge(i, j) or observe == "oracle":
                    expected += np.tanh(x[b, j] - x[b, i])
                elif observe == "estimate":
                    at = slot[i, j]
                    expected += np.tanh(simulator.estimates[b, at : at + 2] - x[b, i])
            np.testing.assert_allclose(u[b, i], 2.0 * expected, rtol=1e-13, atol=1e-14)


def test_inputs_of_a_mixed_fleet_stay_within_its_limits():
    scenario = mixed_fleet()
    simulator = scenario.build(law=TanhConsensus(gain=50.0), num_envs=4)
    for _ in range(20):
        simulator.step(0.01)
        assert np.all(np.abs(simulator.u) <= simulator.fleet.input_limit)
    assert np.any(np.abs(simulator.u) == simulator.fleet.input_limit)  # so the limits were reached


@pytest.mark.parametrize("kind", sorted(MODELS))
def test_velocity_controller_reaches_the_commanded_velocity(kind):
    """Held for a while, every model's position moves with the command (the unicycle's point ahead of its axle too)."""
    model = MODELS[kind]()
    wanted = np.array([0.03, 0.02])
    x, dt, start = np.zeros((1, model.n)), 0.01, None
    for step in range(6000):
        if step == 5000:
            start = x[0, model.position_index].copy()
        u = velocity_to_input(model, x, wanted[None])
        assert np.all(np.abs(u) <= model.input_limit)
        drift = 0.0 if kind == "drifter" else model.drift(np.zeros(1), x)
        x = x + dt * (drift + model.input_map(np.zeros(1), x, u))
    velocity = (x[0, model.position_index] - start) / 10.0
    tolerance = 0.35 if kind == "vessel" else 0.02  # the vessel's drag isn't cancelled
    assert np.linalg.norm(velocity - wanted) <= tolerance * np.linalg.norm(wanted)


def test_an_unknown_model_is_told_where_to_add_a_controller():
    class Blimp(AgentModel):
        type = "blimp"
        states = {"x": "m", "y": "m"}  # noqa: RUF012
        inputs = {"u": "m/s"}  # noqa: RUF012
        position = ("x", "y")
        input_limit = 1.0

    with pytest.raises(ValueError, match=r"no velocity controller for agents of type 'blimp'.*VELOCITY_CONTROLLERS"):
        velocity_to_input(Blimp(), np.zeros((1, 2)), np.zeros((1, 2)))


def test_laws_by_name():
    assert make_law("tanh") == TanhConsensus()
    assert make_law(LawChoice("tanh", {"gain": 3.0})) == TanhConsensus(3.0)
    assert make_law("tanh:gain=4") == TanhConsensus(4.0)
    assert make_law("linear:gain=3,cancel_drift=true") == LinearConsensus(3.0, True)
    for text, said in (
        ("tanh:gian=4", r"law 'tanh' has no parameter 'gian'; did you mean 'gain'"),
        ("tanh:gain=fast", r"law 'tanh:gain=fast': gain must be of type float; got 'fast'"),
        ("tanh:4", r"law 'tanh:4': expected parameter=value after the colon; got '4'"),
        ("tan:gain=4", r"no law 'tan'; did you mean 'tanh'"),
        ("tanh:gain=-4", r"gain must be positive and finite; got -4\.0"),
    ):
        with pytest.raises(LawError, match=said):
            make_law(text)
    assert set(LAWS) == {"tanh", "linear", "formation", "leader_following"}
    with pytest.raises(ValueError, match="no law 'tan'; did you mean 'tanh'"):
        make_law("tan")
    with pytest.raises(LawError, match=r"no parameter 'gian'; did you mean 'gain'\? \(known: gain\)") as caught:
        make_law(LawChoice("tanh", {"gian": 1.0}))
    assert caught.value.parameter == "gian"
    with pytest.raises(LawError, match="no parameter 'zzz'; known: gain"):
        make_law(LawChoice("tanh", {"zzz": 1.0}))
    for value in ("fast", True, (1.0, 2.0)):
        with pytest.raises(LawError, match="gain of law 'tanh' must be a number; got"):
            make_law(LawChoice("tanh", {"gain": value}))
    for value in (np.inf, np.nan):
        with pytest.raises(ValueError, match="positive and finite"):
            TanhConsensus(value)
    with pytest.raises(ValueError, match="gain must be positive and finite; got -1"):
        TanhConsensus(-1.0)


def test_lemma_consensus_without_drift_and_disturbance():
    """V = |Pi x|^2 / 2 decreases at every step for single integrators under the law with the true states."""
    from khop_env.physics import SingleIntegrator

    scenario = paper().replace(models=(SingleIntegrator(input_limit=20.0),) * 8, disturbance=None)
    simulator = scenario.build(law=make_law(scenario.law), observe="oracle")
    previous = np.inf
    for _ in range(200):
        p = simulator.fleet.positions(simulator.x)[0]
        value = 0.5 * np.sum((p - p.mean(axis=0)) ** 2)
        assert value < previous
        previous = value
        simulator.step(0.01)
    assert previous < 0.05
    assert nx.is_connected(scenario.task)
