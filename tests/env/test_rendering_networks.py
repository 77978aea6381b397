"""Frames under a network: boxes of the certified bounds, links that fade or are down, and the age of what is known."""

import itertools

import networkx as nx
import numpy as np
import pytest

import khop_env
from khop_env.env.rendering import Messages, Renderer, Scene
from khop_env.env.rendering.canvas import Canvas
from khop_env.env.rendering.links import DOWN, FRESH, faded, stroke_of
from khop_env.env.rendering.panel import Panel, _ages
from khop_env.env.rendering.renderer import described
from khop_env.network import Network, Outage
from khop_env.observers import Networked
from khop_env.scenarios import mixed_fleet, paper
from khop_env.simulation import Simulator
from tests.env.drawing import TASK, design

X = np.array([0.0, 0.0, 3.0, 0.0, 6.0, 0.0])


def networked(scenario, network: str, estimator: str = "relay") -> Simulator:
    return scenario.build(observers=Networked(network, estimator)).reset(3)


def drawn_on_a_path(missed=(0.0, 0.0, 0.0, 0.0), up=None, ages=(0.1,) * 6, graph=None, **changes):
    """Agents at 0, 3 and 6 m on a line; agent 0's estimates. Links: 1 -> 0, 0 -> 1, 2 -> 1, 1 -> 2."""
    layout = design(graph=graph).knowledge
    scene = Scene(
        1.0,
        X,
        X[layout.column_source],
        np.full(layout.size, 0.5),
        0.5,
        messages=Messages(np.array(ages), np.array(missed)),
        up=None if up is None else np.array(up),
    )
    network = Network.of("wifi")
    renderer = Renderer(
        design(graph=graph), np.zeros((0, 2), int), layout=layout, network=network, estimator="relay", observer=0
    )
    return renderer, renderer.frame(scene._replace(**changes))


def red(renderer: Renderer, frame: np.ndarray, x: float) -> np.ndarray:
    """Red values on the line between agents around `x` m, 24 pixels long."""
    column, row = renderer._camera.pixels(np.array([x, 0.0])).round().astype(int)
    return frame[row, column - 12 : column + 12, 0].astype(int)


class TestScene:
    @pytest.mark.parametrize("estimator", ["ppso", "relay"])
    def test_boxes_are_the_certified_bounds_of_the_observer_s_own_estimates(self, estimator):
        """Of neighbours, too, and of each coordinate by itself."""
        simulator = networked(mixed_fleet(), "saturation", estimator)
        simulator.step(1.0)
        scene, observers, fleet = Scene.of(simulator), simulator.observers, simulator.fleet
        certified = simulator.error_bounds().bound[:, 0]
        renderer = Renderer(simulator.design, TASK, layout=observers.layout, observer=0)
        targets = renderer._estimates.targets
        assert set(targets) > set(simulator.design.communication[0])
        half = renderer._estimates.half_widths(scene.bounds)
        for number, j in enumerate(targets):
            first = observers.layout.slot[0, j] - fleet.state_offset[j]
            assert half[number].tolist() == certified[first + fleet.position_index[j, :2]].tolist()
            here = renderer._estimates.positions(scene.estimates)[number]
            assert np.all(np.abs(simulator.x[0][fleet.position_index[j, :2]] - here) <= half[number] * (1 + 1e-9))

    def test_the_drawn_box_has_the_size_of_the_bound(self):
        renderer, frame = drawn_on_a_path(missed=(9.0,) * 4)
        for x, side in ((6.5, 1), (5.5, -1)):  # agent 2's box, beside the line
            column, row = renderer._camera.pixels(np.array([x, 0.25])).round().astype(int)
            around = frame[row, column - 8 : column + 9, 0].astype(int)
            assert around.min() < 60
            assert abs(int(np.argmin(around)) - 8) <= 1
            assert around[0 if side > 0 else -1] < 250  # tinted inside
            assert around[-1 if side > 0 else 0] == 255

    def test_boxes_grow_until_something_arrives(self):
        simulator = networked(paper(), "ideal:loss=1")
        sizes = []
        for _ in range(4):
            sizes.append(Scene.of(simulator).bounds)
            simulator.step(0.1)
        assert all(np.all(after > before) for before, after in itertools.pairwise(sizes))

    def test_links_miss_the_rounds_that_were_lost(self):
        """Against the channel's own record, in a network whose messages need 2 or 3 rounds."""
        simulator = networked(paper(), "saturation:loss=0.5,burst=4")
        for _ in range(30):
            simulator.step(0.05)
            memory, missed = simulator.state.memory, Scene.of(simulator).messages.missed
            age = simulator.observers.channel.age({n: memory[f"channel.{n}"] for n in ("newest", "round")})[:, 0]
            assert missed.tolist() == [np.inf if a < 0 else max(0, a - 3) for a in age.tolist()]
        assert 0 < np.sum(missed > 0) < missed.size

    def test_ratio_and_ages(self):
        simulator = networked(paper(), "wifi")
        simulator.step(0.5)
        scene = Scene.of(simulator, 1.5)
        assert scene.ratio == simulator.extremes.relative[0] > 0.1
        assert scene.task_error == 1.5
        renderer = Renderer(simulator.design, TASK, layout=simulator.observers.layout)
        layout, age = simulator.observers.layout, simulator.observers.information(simulator.state).age[:, 0]
        pairs = zip(layout.observer.tolist(), layout.pair_target.tolist(), strict=True)
        own = {i: age[pair] for pair, (a, i) in enumerate(pairs) if a == renderer.observer}
        assert renderer._estimates.ages(scene.messages).tolist() == [own[i] for i in sorted(own)]

    def test_without_a_network_nothing_changes(self):
        simulator = paper().build().reset(0)
        scene = Scene.of(simulator)
        assert scene.messages is None
        assert scene.up is None
        assert scene.ratio == simulator.extremes.kept()[0]
        ideal = Renderer(simulator.design, TASK).frame(scene)
        assert np.array_equal(ideal, Renderer(simulator.design, TASK, layout=simulator.observers.layout).frame(scene))


class TestLinks:
    def test_a_lost_message_makes_its_link_paler_round_by_round(self):
        colors = [faded(missed).color[0] for missed in (0.0, 1.0, 2.0, 4.0)]
        assert sorted(set(colors)) == colors
        assert faded(0.0) == FRESH
        assert faded(np.inf).color[0] < 225  # darker than the grid, still

    def test_the_half_beside_the_receiver(self):
        """Of the line between agents 0 and 1, when 0 hears 1 and 1 hasn't heard 0 for long."""
        renderer, frame = drawn_on_a_path(missed=(0.0, 9.0, 0.0, 0.0))
        assert red(renderer, frame, 1.0).max() < 130
        assert red(renderer, frame, 2.0).min() > 200
        assert red(renderer, frame, 2.0).max() < 228  # darker than the grid
        assert red(renderer, frame, 4.2).max() < 130

    def test_a_link_that_is_down_is_dashed(self):
        renderer, frame = drawn_on_a_path(up=(True, True, False, True))
        down, other = red(renderer, frame, 4.2), red(renderer, frame, 4.9)
        assert down.min() < 210  # dashes ...
        assert down.max() > 230  # and gaps, on a line of the grid
        assert other.max() < 130
        scene = Scene(0.0, X, X, X, 0.5, up=np.array([True, False]))
        assert [stroke_of(scene, link) for link in (0, 1)] == [FRESH, DOWN]

    @pytest.mark.parametrize("network", [None, "wifi"])
    def test_links_follow_the_schedule(self, network):
        whole = paper()
        scenario = whole.replace(schedule=Outage(agent=0, start=0.25, duration=0.5))
        simulator = scenario.build(observers=None if network is None else Networked(network, "relay"))
        links = simulator.design.links
        of_agent = (links.sender == 0) | (links.receiver == 0)
        for t in (0.0, 0.5, 1.0):
            if t:
                simulator.step(0.5)
            up = Scene.of(simulator).up
            assert up.tolist() == [not (t == 0.5 and cut) for cut in of_agent]
        assert Scene.of(whole.build()).up is None

    def test_an_arrow_fades_with_its_link(self):
        graph = nx.DiGraph([(0, 1), (1, 0), (1, 2)])
        for missed, dark in ((0.0, True), (9.0, False)):
            renderer, frame = drawn_on_a_path(missed=(0.0, 0.0, missed), ages=(0.1,) * 4, graph=graph)
            x, y = renderer._camera.pixels(np.array([6.0, 0.0])).round().astype(int)
            head = frame[[y - 2, y + 2], round(x - 1.6 * renderer._radius - 7.0), 0]
            assert np.all(head < 160) == dark
            assert np.all(head < 240)


class TestPanel:
    def test_a_bound_that_is_reached_is_no_alarm(self):
        """Certified bounds hold up to rounding, with equality; funnels without."""
        alarm = np.array([0xD5, 0x5E, 0x00])

        def alarmed(ratio):
            _, frame = drawn_on_a_path(ratio=ratio)
            return bool((np.abs(frame.astype(int) - alarm).max(axis=2) < 5).any())

        assert [alarmed(ratio) for ratio in (1.0, 1.0 + 1e-9, 1.01, np.nan)] == [False, False, True, True]

    def test_texts(self):
        assert described(Network.of("wifi")) == "network wifi: a message every 50 ms, 1 % lost, 10 ± 1 ms late"
        assert described(Network(loss=0.3, burst=5)) == "a message every 50 ms, 30 % lost in bursts of 5"
        assert _ages(np.array([0.1, 0.3])) == ["states 0.20 s old in the", "mean, the oldest 0.30 s"]
        assert _ages(np.array([0.1, np.inf])) == [
            "states 0.10 s old in the",
            "mean, the oldest 0.10 s",
            "nothing yet of 1 agent",
        ]
        assert _ages(np.array([np.inf, np.inf])) == ["nothing yet of 2 agents"]


def test_an_environment_over_a_network_renders():
    env = khop_env.make("consensus_v0", network="lossy:loss=0.6,burst=5", render_mode="rgb_array")
    env.reset(seed=0)
    first = env.render()
    env.step({agent: np.zeros(env.action_space(agent).shape, np.float32) for agent in env.agents})
    second = env.render()
    assert first.shape == second.shape == (720, 900, 3)
    assert not np.array_equal(first, second)
    renderer, simulator = env._renderer, env.batched.simulator
    known = [target for observer, target in simulator.observers.layout.slot if observer == renderer.observer]
    assert renderer._estimates.targets == sorted(known)
    assert "60 % lost in bursts of 5" in renderer._network
    assert renderer._panel._estimator == "ppso"


class TestCutOff:
    """Continuous exchange over links that are down: a target that doesn't reach the observer has no bound."""

    def test_it_has_no_box_and_the_panel_says_so(self, monkeypatch):
        written = []
        monkeypatch.setattr(Panel, "_note", lambda self, canvas, *lines: written.append(" ".join(lines)))
        scenario = paper().replace(schedule=Outage(0.0, 9.0, agent=2))
        simulator = scenario.build().reset(3)
        for _ in range(50):  # until boxes are smaller than the view
            simulator.step(0.1)
        scene = Scene.of(simulator)
        layout = simulator.observers.layout
        observer, target = next(pair for pair in layout.slot if pair[1] == 2)
        renderer = Renderer(simulator.design, TASK, observer=observer)
        bounds = renderer._estimates.half_widths(scene.bounds)
        cut_off = np.isinf(bounds).any(axis=1)
        assert cut_off[renderer._estimates.targets.index(target)]
        assert not cut_off.all()
        boxes = []
        monkeypatch.setattr(Canvas, "box", lambda self, *box: boxes.append(box))
        renderer.frame(scene)
        of_legend = 1
        assert len(boxes) - of_legend == np.count_nonzero(~cut_off)
        have = "target has" if cut_off.sum() == 1 else "targets have"
        assert f"{cut_off.sum()} {have} no bound now, and no box" in written
        assert not any("larger than the view" in text for text in written)
