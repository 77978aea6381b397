"""The observer for a robot's own loop: hand-made cases, adversaries, and messages that come as they like."""

import dataclasses
import math
import os
import subprocess
import sys
from pathlib import Path

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from agents import make_law
from khop_env.network import Network
from khop_env.observers import (
    Certificate,
    Known,
    Message,
    Networked,
    ObserverDesign,
    ObserverNode,
    PairLayout,
    TargetObservers,
)
from khop_env.observers.impulse import impulse
from khop_env.observers.solve import solve
from khop_env.physics import (
    DoubleIntegrator,
    DriftingIntegrator,
    Links,
    SingleIntegrator,
    SurfaceVessel,
)
from khop_env.registry import scenario
from tests.observers.node_rounds import Rounds, T, design_of
from tests.strategies import SEEDS

ROOT = Path(__file__).parents[2]

# -- one observer --------------------------------------------------------------------------------------------------


@given(
    b=st.floats(-6.0, 6.0).map(lambda power: 10.0**power) | st.floats(0.0, 1.5),
    sign=st.sampled_from([-1.0, 1.0]),
    stiffness=st.floats(-12.0, 8.0).map(lambda power: 10.0**power),
)
@settings(max_examples=300)
def test_the_scalar_equation_is_solved_to_rounding(b: float, sign: float, stiffness: float) -> None:
    """As the compiled solve of many does, to its tolerance; and e(z) + s z = b itself, with e(z) by other means."""
    z = impulse(sign * b, stiffness)
    assert impulse(-sign * b, stiffness) == -z
    low, high = 0.0, min(700.0, 0.5 * abs(z))  # bisection for eps, from eps (1 + cosh eps) = |z|
    for _ in range(200):
        eps = 0.5 * (low + high)
        low, high = (eps, high) if eps * (1.0 + math.cosh(eps)) < abs(z) else (low, eps)
    assert math.tanh(0.5 * low) + stiffness * abs(z) == pytest.approx(b, rel=4e-15, abs=1e-300)

    graph = nx.Graph([(0, 1), (1, 2)])
    layout = PairLayout.build(Links.of(graph), [[2], [], []], [1] * 3, range(4), relay=True, targets=[0])
    predictor, estimate, rho = np.array([[sign * b]]), np.zeros((1, 1)), np.ones((1, 1))
    buffers = np.zeros((1, 1)), estimate, np.zeros((1, 1))
    solve(layout.packed, stiffness, predictor, np.zeros((3, 1)), rho, *buffers, (0, 1), (0, 1))
    assert sign * b - stiffness * z == pytest.approx(estimate[0, 0], abs=2e-11 * max(1.0, b))


def test_numbers_that_are_not_finite_are_refused() -> None:
    for b, stiffness in ((math.nan, 1.0), (math.inf, 1.0), (1.0, 0.0), (1.0, math.nan), (1.0, math.inf)):
        with pytest.raises(ValueError, match="finite disagreement and a positive, finite stiffness"):
            impulse(b, stiffness)


def test_a_round_by_hand() -> None:
    """Two relays: what is held of them, the implicit step, the box, and what is sent on."""
    graph = nx.Graph([(0, 1), (0, 2), (1, 3), (2, 3)])
    design = design_of([SingleIntegrator(1, 2.0)] * 4, graph=graph)
    node = ObserverNode(design, 3, period=T, center=0.5, radius=1.0, noise=0.01)
    assert node.targets == ("integrator_0", "integrator_1", "integrator_2")
    assert node.hears == ("integrator_1", "integrator_2")
    node.update(0.0, [0.1], [0.2])
    sent = node.message()
    assert (sent.known, sent.heard) == ({}, {})
    assert (sent.state, sent.input_effect, sent.estimates[0], sent.input_estimates[0]) == (0.1, 0.2, 0.5, 0.0)
    found = node.estimates(0.0)["integrator_0"]
    assert (found.bound, found.age) == (pytest.approx(1.0), math.inf)

    def message(sender: int, t: float, known: dict, heard: dict) -> Message:
        empty = {i: np.zeros(1) for i in sent.design.states.layout.target if (sender, i) in design.states.layout.slot}
        array = np.array([2.0 + sender])
        return Message(design, sender, t, array, known, "ppso", array, empty, empty, heard)

    before = node._states[0].estimate[0], node._inputs[0].estimate[0]
    node.update(T, [0.1], [0.2])
    assert node.message().estimates[0] == before[0] + T * before[1]
    known = [{0: Known(stamp, 1, np.array([value]))} for stamp, value in ((0.0, 1.0), (T / 2, 1.2))]
    late, fresh = (message(p, time, k, {0: np.array([0.7])}) for p, time, k in ((1, T / 2, known[0]), (2, T, known[1])))
    assert node.receive(fresh)
    assert node.receive(late)
    assert not node.receive(late)
    found = node.estimates(T)
    estimate, bound, age, *_ = found["integrator_0"]
    assert age == pytest.approx(T / 2)
    radius = Certificate(design.fleet.models[0], start=0.01).radius(np.array(T / 2))[0]
    assert estimate == pytest.approx(np.clip(node._states[0].estimate, 1.2 - radius, 1.2 + radius))
    assert bound == pytest.approx(radius + abs(estimate - 1.2))
    assert found["integrator_1"][0] == pytest.approx(3.0)  # at one hop: the box's centre

    # the equation itself, and that of the input
    for observer, predicted, held in (
        (node._states[0], before[0] + T * before[1], [1.0, 1.2]),
        (node._inputs[0], before[1], [0.7, 0.7]),
    ):
        rho, y = observer.rho[0](np.array([T]))[0], observer.estimate[0]
        e = (2.0 * y - sum(held)) / rho
        slope = math.log((1.0 + e) / (1.0 - e)) * 2.0 / (1.0 - e * e)
        assert y - predicted + T * slope / rho == pytest.approx(0.0, abs=1e-14)
    y, g = node._states[0].estimate, node._inputs[0].estimate
    node.update(2 * T, [0.1], [0.2])
    passed_on = node.message()
    assert abs(g[0]) > 1e-6
    assert passed_on.estimates[0] == pytest.approx(y + T * g, rel=1e-12)
    assert passed_on.known[0][:2] == (T / 2, 2)
    assert passed_on.heard[1] == 3.0
    assert passed_on.heard[2] == 4.0


@pytest.mark.parametrize("estimator", ["relay", "ppso"])
@pytest.mark.parametrize("name", ["paper", "mixed_fleet"])
def test_nodes_equal_the_batch(name: str, estimator: str) -> None:
    """With losses, delays, reordering, noise, and steps shorter than the period."""
    chosen, network = scenario(name), Network(0.1, loss=0.3, burst=3, latency=0.15, jitter=0.1, noise=0.02)
    design, fleet, h = chosen.design, chosen.design.fleet, 0.01
    simulator = chosen.build(law=make_law(chosen.law), observers=Networked(network, estimator))
    simulator.reset(seed=3)
    memory = simulator.state.memory
    bound = chosen.disturbance.attach(fleet).bound
    known = {"disturbance": bound, "center": chosen.initial.center, "radius": chosen.initial.radius}
    rounds = Rounds(design, network, int(memory["channel.key"][0]), estimator=estimator, step=h, sampled=True, **known)
    u = np.zeros(fleet.m)
    for step in range(81):  # eight rounds: what came late in one has an effect three rounds later at the earliest
        if step:
            u = simulator.u[0].copy()
            simulator.step(h)
        t, memory = float(simulator.t[0]), simulator.state.memory
        rounds.update(t, simulator.x[0], u)
        found, information = rounds.estimates(t), simulator.observers.information(simulator.state)
        for (a, i), at in design.knowledge.slot.items():
            estimate, certified, *of_messages = found[a][fleet.ids[i]]
            here = slice(at, at + len(estimate))
            np.testing.assert_allclose(estimate, memory["estimate"][here, 0], rtol=0, atol=1e-12)
            np.testing.assert_allclose(certified, memory["bound"][here, 0], rtol=1e-12, atol=1e-12)
            pair = design.knowledge.column_pair[at]
            np.testing.assert_allclose(of_messages, [each[pair, 0] for each in information], rtol=1e-12, atol=1e-12)


# -- messages as they come -----------------------------------------------------------------------------------------


def recorded(design: ObserverDesign, estimator: str, rounds: int = 8) -> list[list[Message]]:
    """What every agent sends in each round, when all messages arrive."""
    rng = np.random.default_rng(0)
    x = rng.uniform(-1, 1, design.fleet.n)
    together = Rounds(design, Network(T), estimator=estimator, radius=2.0)
    found = []
    for step in range(rounds):
        together.update(step * T, x, 0.0 * x[: design.fleet.m])
        found.append([sent[-1] for sent in together.sent])
    return found


@pytest.mark.parametrize("estimator", ["relay", "ppso"])
@settings(max_examples=25)
@given(seed=SEEDS)
def test_loss_delay_doubling_and_another_order_only_widen(estimator: str, seed: int) -> None:
    rng = np.random.default_rng(seed)
    design = design_of([DriftingIntegrator(2.0)] * 4, 3, graph=nx.cycle_graph(4))
    sent = recorded(design, estimator)
    best, poor = (ObserverNode(design, 0, estimator=estimator, period=T, radius=2.0) for _ in range(2))
    waiting: list[Message] = []
    for step, messages in enumerate(sent):
        for node in (best, poor):
            node.update(step * T, messages[0].state, np.zeros(2))
        waiting += [messages[p] for p in (1, 3) if rng.random() < 0.7]
        for p in (1, 3):
            best.receive(messages[p])
        rng.shuffle(waiting)
        arriving, waiting = waiting[: rng.integers(len(waiting) + 1)], waiting
        for message in arriving:
            poor.receive(message)
        for target, (estimate, _, age, *_) in best.estimates(step * T).items():
            other = poor.estimates(step * T)[target]
            assert other.age >= age
            if estimator == "relay":
                assert (other.bound >= best.estimates(step * T)[target].bound - 1e-12).all()
            assert np.isfinite(estimate).all()


@pytest.mark.parametrize("estimator", ["relay", "ppso"])
def test_the_order_within_a_round_does_not_matter(estimator: str) -> None:
    design = design_of([DriftingIntegrator(2.0)] * 4, 3, graph=nx.cycle_graph(4))
    sent = recorded(design, estimator)
    forwards, backwards = (ObserverNode(design, 0, estimator=estimator, period=T, radius=2.0) for _ in range(2))
    for step, messages in enumerate(sent):
        for node, order in ((forwards, (1, 3)), (backwards, (3, 1))):
            node.update(step * T, messages[0].state, np.zeros(2))
            for p in order:
                # one and the same state of agent 2, which they don't predict alike
                known = {i: each._replace(state=each.state + 1e-3 * p) for i, each in messages[p].known.items()}
                assert node.receive(dataclasses.replace(messages[p], known=known))
                assert not node.receive(messages[p])
        for one, other in zip(forwards.estimates(step * T).values(), backwards.estimates(step * T).values()):  # noqa: B905
            for values, same in zip(one, other, strict=True):
                np.testing.assert_array_equal(values, same)
        assert forwards.message().pack() == backwards.message().pack()


def test_a_message_ahead_of_the_clock_waits_for_its_time() -> None:
    design = design_of([DoubleIntegrator()] * 3)
    sent = recorded(design, "relay", 4)
    node = ObserverNode(design, 0, estimator="relay", period=T, radius=2.0)
    node.update(0.0, np.zeros(4), np.zeros(2))
    assert node.receive(sent[1][1])
    assert node.estimates(0.0)["cart_1"].age == math.inf
    assert not node.receive(sent[1][1])
    node.update(0.9 * T, np.zeros(4), np.zeros(2))
    assert node.estimates(0.9 * T)["cart_1"].age == math.inf
    node.update(1.2 * T, np.zeros(4), np.zeros(2))
    assert node.estimates(1.2 * T)["cart_1"].age == pytest.approx(0.2 * T)
    assert node.estimates(1.5 * T)["cart_1"].age == pytest.approx(0.5 * T)
    with pytest.raises(ValueError, match=r"t = 0.15 s, 0.09 s ahead of the last update; clocks differ by more than"):
        node.receive(sent[3][1])


def test_rounds_fall_due_at_multiples_of_the_period() -> None:
    design = design_of([SingleIntegrator()] * 3)
    node = ObserverNode(design, 0, period=0.1, step=0.03)
    due = []
    for step in range(14):
        node.update(step * 0.03, np.zeros(2), np.zeros(2))
        due.append(node.due)
    assert [step for step, now in enumerate(due) if now] == [0, 4, 7, 10, 14][:4]


def test_what_cannot_be_right_is_refused_and_changes_nothing() -> None:
    design = design_of([DoubleIntegrator()] * 4)
    other = design_of([DoubleIntegrator()] * 4, 3)
    node = ObserverNode(design, "cart_0", estimator="relay", period=T, radius=2.0)
    with pytest.raises(ValueError, match="no message before the first update"):
        node.message()
    node.update(0.0, np.zeros(4), np.zeros(2))
    sent = recorded(design, "relay", 1)[0]
    before = node.message().pack(), repr(node.estimates(0.0))
    rounded = dataclasses.replace(sent[1], dtype="float16")
    for call, message in (
        (lambda: node.receive(sent[2]), "a message of 'cart_2', which it doesn't hear; it hears"),
        (lambda: node.receive(recorded(other, "relay", 1)[0][1]), "a message of another fleet"),
        (lambda: node.receive(recorded(design, "ppso", 1)[0][1]), "runs the estimator 'ppso', this node 'relay'"),
        (lambda: node.receive(rounded), "sent float16, but this node's bounds allow for float64"),
        (lambda: node.update(T, np.zeros(3), np.zeros(2)), "its state must be 4 finite numbers"),
        (lambda: node.update(T, "abcd", np.zeros(2)), "its state must be 4 finite numbers"),
        (lambda: node.update("soon", np.zeros(4), np.zeros(2)), "the time of update must be a number; got 'soon'"),
        (lambda: node.estimates(None), "must be a number; got None"),
        (lambda: node.update(T, np.zeros(4), [0.0, np.nan]), "its input must be 2 finite numbers"),
        (lambda: node.update(-T, np.zeros(4), np.zeros(2)), "expected 0.0 s, the last time, or later"),
        (lambda: node.update(math.nan, np.zeros(4), np.zeros(2)), "expected 0.0 s, the last time, or later"),
        (lambda: node.update(1.7e9, np.zeros(4), np.zeros(2)), "times are in seconds since the fleet started"),
        (lambda: node.estimates(-1.0), "estimates at t = -1.0"),
    ):
        with pytest.raises(ValueError, match=message):
            call()
        assert (node.message().pack(), repr(node.estimates(0.0))) == before
    small = ObserverNode(design, 0, estimator="relay", period=T, dtype="float16", largest=0.5)
    small.update(0.0, np.full(4, 0.6), np.zeros(2))
    with pytest.raises(ValueError, match="beyond largest = "):
        small.message()
    with pytest.raises(ValueError, match="sent a state of 'cart_1' beyond largest"):
        small.receive(dataclasses.replace(sent[1], state=np.full(4, 0.6)))


def test_bad_arguments_are_refused() -> None:
    design = design_of([SingleIntegrator()] * 3)
    for arguments, message in (
        ({"period": 0.0}, "period must be positive"),
        ({"period": "a"}, "period must be a number; got 'a'"),
        ({"period": T, "step": "a"}, "step must be a number; got 'a'"),
        ({"period": T, "skew": None}, "skew must be a number; got None"),
        (
            {"period": T, "noise": "a"},
            "noise must be a number or .* numbers, of the whole fleet's states, not negative",
        ),
        ({"period": T, "center": [[1], [1, 2]]}, "center must be a number or .* finite; got"),
        ({"period": T, "step": 2 * T}, "step, between two updates, must be positive and at most the period 0.05 s"),
        ({"period": T, "estimator": "pps"}, "estimator must be one of ppso, relay; got 'pps'; did you mean 'ppso'"),
        ({"period": T, "estimator": "kalman"}, "estimator must be one of ppso, relay; got 'kalman'$"),
        ({"period": T, "dtype": "float8"}, "dtype must be one of float64, float32, float16"),
        ({"period": T, "dtype": "float16"}, "dtype='float16' rounds what is sent: give `largest`"),
        ({"period": T, "skew": 0.1, "sampled": True}, "a sampled system has one clock"),
        ({"period": T, "skew": -1.0}, "skew must be finite and not negative"),
        ({"period": T, "noise": [1.0, 2.0]}, "noise must be a number or 6 numbers, of the whole fleet"),
        ({"period": T, "center": np.inf}, "center must be a number or 6 numbers"),
    ):
        with pytest.raises(ValueError, match=message):
            ObserverNode(design, 0, **arguments)
    with pytest.raises(ValueError, match=r"DriftingIntegrator need steps of at most 0\.5 s.*; got 0\.6"):
        ObserverNode(design_of([DriftingIntegrator()] * 3), 0, period=0.6, sampled=True)
    with pytest.raises(ValueError, match="no agent 'integrator_9'"):
        ObserverNode(design, "integrator_9", period=T)


def test_nothing_declared_nothing_certified() -> None:
    design = design_of([SurfaceVessel()] * 3)
    node = ObserverNode(design, 0, period=T)  # without an initial set no operating region is known
    assert "not certified: SurfaceVessel.drift_growth() gives no bound" in node.reasons["vessel_1"]
    node.update(0.0, np.zeros(6), np.zeros(3))
    assert np.isinf(node.estimates(0.0)["vessel_2"].bound).all()
    assert ObserverNode(design, 0, period=T, radius=1.0).reasons == {}


def test_a_state_that_no_assumption_allows_is_certified_no_longer() -> None:
    design = design_of([SurfaceVessel()] * 3, targets=[TargetObservers(input_observer=False)] * 3)
    node = ObserverNode(design, 0, estimator="relay", period=T, radius=0.1)
    node.update(0.0, np.zeros(6), np.zeros(3))
    state = np.array([0.0, 0.0, 0.0, 50.0, 0.0, 0.0])  # 50 m/s: outside any region that the forces allow
    node.receive(Message(design, 1, 0.0, state, {}))
    assert np.isinf(node.estimates(0.0)["vessel_1"].bound).all()


def test_it_runs_without_numba_and_gives_the_same_bits(tmp_path: Path) -> None:
    code = """
import numpy as np
from khop_env.observers import Message, ObserverNode
from khop_env.registry import scenario
design = scenario("paper").design
nodes = [ObserverNode(design, a, period=0.05, radius=1.5) for a in range(8)]
x = np.random.default_rng(0).uniform(-1, 1, 16)
for step in range(6):
    for a, node in enumerate(nodes):
        node.update(step * 0.05, x[2 * a : 2 * a + 2], x[:2])
    sent = [node.message().pack() for node in nodes]
    for sender, a in design.links.index:
        nodes[a].receive(Message.unpack(sent[sender], design))
print(sent[3].hex(), nodes[3].estimates(0.3))
"""
    environment = {**os.environ, "PYTHONPATH": str(ROOT)}
    said = []
    for before in ("", "import sys; sys.modules['numba'] = None\n"):
        command = [sys.executable, "-W", "error", "-c", before + code]
        done = subprocess.run(command, cwd=tmp_path, env=environment, capture_output=True, text=True, check=True)
        said.append(done.stdout)
    assert said[0] == said[1] != ""
