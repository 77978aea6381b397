"""Frames: agents at their positions, estimates in boxes as wide as the bound, and nothing of earlier episodes."""

import copy
import pickle
import sys

import networkx as nx
import numpy as np
import pytest

from khop_env.env.rendering import Renderer, canvas
from khop_env.env.rendering.estimates import Estimates, default_observer
from khop_env.env.rendering.looks import ALARM_COLOR, COLORS, EDGE_COLOR, TASK_COLOR, looks, short_names
from khop_env.observers import Exponential, ObserverDesign
from khop_env.physics import DoubleIntegrator, DriftingIntegrator, Fleet, SingleIntegrator, SurfaceVessel, Unicycle
from tests.env.drawing import DELTA, TASK, design, renderer, scene, scene_of
from tests.strategies import definition_of_m


def rgb(color: str) -> np.ndarray:
    return np.array([int(color[k : k + 2], 16) for k in (1, 3, 5)])


BLUE = rgb(COLORS[0])


def at(drawn: Renderer, frame: np.ndarray, point) -> np.ndarray:
    """The colour at a place in the plane."""
    column, row = np.round(drawn._camera.pixels(np.array(point, float))).astype(int)
    return frame[row, column].astype(int)


def near(color, other, tolerance=40) -> bool:
    return bool(np.abs(np.asarray(color) - other).max() <= tolerance)


class TestFrame:
    def test_is_a_fresh_picture(self):
        drawn = renderer(size=(640, 480))
        first = drawn.frame(scene())
        kept = first.copy()
        second = drawn.frame(scene(1.0, x=(0.5, 0.5, 3.0, 1.0, 1.0, -2.0)))
        assert first.shape == (480, 640, 3)
        assert first.dtype == np.uint8
        assert first.flags.writeable
        assert first.flags.c_contiguous
        assert not np.shares_memory(first, second)
        assert np.array_equal(first, kept)
        assert not np.array_equal(first, second)

    def test_same_scene_same_picture(self):
        assert np.array_equal(renderer().frame(scene()), renderer().frame(scene()))

    def test_agents_are_where_they_are(self):
        drawn = renderer()
        first = drawn.frame(scene(0.0))
        for place in ((0, 0), (3, 1), (1, -2)):
            assert near(at(drawn, first, place), BLUE)
        assert not near(at(drawn, first, (2, 0)), BLUE)
        moved = drawn.frame(scene(5.0, x=(2.0, 0.0, 3.0, 1.0, 1.0, -2.0)))
        assert near(at(drawn, moved, (2, 0)), BLUE)
        assert not near(at(drawn, moved, (0, 0)), BLUE)

    @pytest.mark.parametrize("link", [(1, 2), (2, 1)])
    def test_links_that_go_one_way_have_an_arrow_at_the_receiver(self, link):
        """On the path 0, 1, 2 from left to right, of which the first link goes both ways."""
        graph = nx.DiGraph([(0, 1), (1, 0), link])
        drawn = Renderer(design(graph=graph), np.zeros((0, 2), int))
        frame = drawn.frame(scene_of(design(graph=graph), 0.0, np.array([0.0, 0.0, 3.0, 0.0, 6.0, 0.0])))
        for agent, marked in ((1, False), (2, link == (1, 2))):
            x, y = drawn._camera.pixels(np.array([3.0 * agent, 0.0])).round().astype(int)
            beside = frame[[y - 2, y + 2], round(x - 1.6 * drawn._radius - 7.0), 0]  # of the line to the left
            assert np.all(beside < 160) == marked
            assert np.all(beside > 200) != marked
            assert frame[y, x - 60, 0] < 160

    def test_north_is_up(self):
        drawn = renderer()
        drawn.frame(scene())
        assert drawn._camera.pixels(np.array([0.0, 1.0]))[1] < drawn._camera.pixels(np.array([0.0, 0.0]))[1]

    @pytest.mark.parametrize("t", [0.8, 1.0, 9.0])
    def test_boxes_are_as_wide_as_the_bound(self, t):
        """Agent 0's estimate of agent 2 is 0.2 m off; the bound's edges are delta(t) from the estimate: eta = 1."""
        drawn = renderer(observer=0)
        frame = drawn.frame(scene(t, offset=0.2))
        estimated, delta = np.array([1.2, -1.8]), DELTA(t)
        steps = np.arange(-8, 9)  # pixels across the edge
        for side in ((-1.0, -0.5), (1.0, -0.5), (0.0, -1.0), (0.0, 1.0)):  # where nothing else is drawn
            edge, outwards = estimated + delta * np.array(side), np.trunc(side)
            red = [at(drawn, frame, edge + n * drawn._camera.meters * outwards)[0] for n in steps]
            assert min(red) < 130, "no edge there"
            assert abs(steps[np.argmin(red)]) <= 1
        inside, outside = estimated + 0.8 * delta * np.array([1, -1]), estimated + 1.1 * delta * np.array([1, -1])
        assert at(drawn, frame, inside)[0] < at(drawn, frame, outside)[0]  # tinted

    def test_boxes_larger_than_the_view_are_counted(self):
        drawn = renderer(observer=0)
        drawn.frame(scene(0.0))
        estimated = np.array([[1.0, -2.0]])
        for t, hidden in ((0.0, 1), (9.0, 0)):
            assert drawn._draw_boxes(drawn._canvas, estimated, np.full((1, 2), DELTA(t))) == hidden

    def test_an_estimate_is_drawn_as_a_hollow_marker(self):
        drawn = renderer(observer=0)
        apart = drawn.frame(scene(1.0, offset=0.4))
        radius = 1.55 * drawn._radius * drawn._camera.meters
        assert near(at(drawn, apart, (1.4 + radius, -1.6)), BLUE, 60)
        assert not near(at(drawn, apart, (1.4, -1.6 + 0.5 * radius)), BLUE, 60)  # hollow

    def test_trails_end_with_the_episode(self):
        drawn = renderer()
        first = drawn.frame(scene(0.0))
        for t in (0.5, 1.0, 1.5):
            later = drawn.frame(scene(t, x=(t, t, 3.0, 1.0, 1.0, -2.0)))
        assert at(drawn, later, (1.2, 1.2))[0] < 225  # the trail: darker than white and the grid
        assert at(drawn, first, (1.2, 1.2))[0] > 225
        assert np.array_equal(drawn.frame(scene(0.0)), first)

    def test_the_guarantee_broken_is_alarming(self):
        def alarmed(ratio):
            frame = renderer().frame(scene(ratio=ratio))
            return int((np.abs(frame.astype(int) - rgb(ALARM_COLOR)).max(axis=2) < 5).sum())

        assert alarmed(0.99) == 0
        assert alarmed(1.01) > 1000
        assert alarmed(np.nan) > 1000
        assert alarmed(np.inf) > 1000

    @pytest.mark.parametrize("value", [np.nan, np.inf, -1e300, 1e12])
    def test_states_that_ran_away_leave_the_others_in_view(self, value):
        drawn = renderer()
        with np.errstate(all="raise"):
            frame = drawn.frame(scene(0.0, x=(value, 0.0, 3.0, 1.0, 1.0, -2.0), ratio=np.nan))
            drawn.frame(scene(1.0, x=(value,) * 6))
        drawn = renderer()
        frame = drawn.frame(scene(0.0, x=(value, 0.0, 3.0, 1.0, 1.0, -2.0)))
        assert near(at(drawn, frame, (3, 1)), BLUE)

    @pytest.mark.parametrize("dim", [1, 3])
    def test_fleets_on_a_line_and_in_space(self, dim):
        fleet = design((SingleIntegrator(dim=dim),) * 3)
        drawn = Renderer(fleet, TASK, driven=[1])
        x = np.zeros(3 * dim)
        x[dim] = 1.0
        frame = drawn.frame(scene_of(fleet, 2.0, x))
        column, middle = drawn._camera.pixels(np.zeros(2)).round().astype(int)
        for row in drawn._rows.round().astype(int)[[0, 2]] if dim == 1 else [middle]:
            assert near(frame[row, column], BLUE)
        assert drawn._camera.pixels(np.array([1.0, 0.0]))[0] > column + 100

    def test_without_anyone_to_estimate(self):
        complete = design(graph=nx.complete_graph(3))
        assert Renderer(complete, TASK).frame(scene_of(complete, 0.0, np.arange(6.0))).shape == (720, 900, 3)


class TestWhoIsShown:
    def test_the_agent_with_most_edges_to_targets_by_default(self):
        fleet = design((SingleIntegrator(),) * 5, k=4)
        assert default_observer(fleet, np.array([[0, 1], [1, 0], [3, 1], [3, 0], [4, 0]])) == 3
        assert default_observer(fleet, np.array([[4, 0], [2, 0]])) == 2
        assert Renderer(fleet, np.zeros((0, 2), int)).observer == 0

    def test_beliefs_are_each_target_s_own(self):
        """In a fleet of agents that differ in their states and bounds, against the layout's own tables."""
        fleet = Fleet([SurfaceVessel(), SingleIntegrator(), Unicycle(), DoubleIntegrator(), SurfaceVessel()])
        bounds = {
            i: [Exponential(9.0 + i, 0.1 * (i + 1) + 0.01 * c, 1.0) for c in range(model.n)]
            for i, model in enumerate(fleet.models)
        }
        mixed = ObserverDesign(fleet, nx.path_graph(5), 4, bounds, Exponential(5.0, 1.0, 5.0))
        estimates = np.random.default_rng(0).normal(size=mixed.states.layout.size)
        bounds_at_2 = scene_of(mixed, 2.0, np.zeros(fleet.n)).bounds
        for observer in range(5):
            drawn = Estimates(mixed, observer)
            assert tuple(drawn.targets) == mixed.neighborhoods[observer]
            for number, j in enumerate(drawn.targets):
                start = mixed.states.layout.slot[observer, j]
                estimated = dict(zip(fleet.models[j].states, estimates[start:], strict=False))
                assert drawn.positions(estimates)[number].tolist() == [estimated["x"], estimated["y"]]
                assert drawn.headings(estimates)[number] == estimated.get("heading", 0.0)
                members = list(mixed.neighborhoods[j])
                m = definition_of_m(mixed.communication, members, j, True)
                share = np.linalg.eigvalsh(m)[0] / np.sqrt(len(m)) * np.linalg.inv(m).sum(axis=1)
                own = share[members.index(observer)]
                expected = [own * float(bounds[j][c](2.0)) for c in (0, 1)]
                assert drawn.half_widths(bounds_at_2)[number] == pytest.approx(expected, rel=1e-12)
                expected = [own * bounds[j][c].final for c in (0, 1)]
                assert drawn.half_widths_in_view(bounds_at_2)[number] == pytest.approx(expected, rel=1e-12)

    def test_no_such_agent(self):
        with pytest.raises(ValueError, match="no agent 7"):
            renderer(observer=7)
        with pytest.raises(ValueError, match="no agent 9"):
            renderer(driven=[9])

    def test_types_look_different_each(self):
        class Strange(DriftingIntegrator):
            type = "strange"

        class Headed(Unicycle):
            type = "headed"

        models = SingleIntegrator(), Strange(), DoubleIntegrator(), Unicycle(), SurfaceVessel(), Headed()
        found = looks([*models, *models])
        assert len(found) == 6
        assert len({look.color for look in found.values()}) == 6
        assert len({look.outline.tobytes() for look in found.values()}) == 6

    def test_edges_of_both_kinds_differ_in_lightness(self):
        """Which all readers see, also those to whom the pink is a grey."""
        light = [(rgb(color) / 255) ** 2.2 @ (0.2126, 0.7152, 0.0722) for color in (EDGE_COLOR, TASK_COLOR)]
        assert 2 * light[0] < light[1]

    def test_short_names(self):
        class Cargo(DriftingIntegrator):
            type = "cargo"

        assert short_names(Fleet([SingleIntegrator()] * 2)) == ["0", "1"]
        assert short_names(Fleet([SingleIntegrator(), Unicycle(), SingleIntegrator()])) == ["i0", "u0", "i1"]
        assert short_names(Fleet([DoubleIntegrator(), Cargo()])) == ["cart0", "carg0"]


class TestWithoutThePanel:
    def test_the_map_has_its_room(self):
        """And nothing of it is drawn: right of the map all is white."""
        whole, alone = renderer(size=(900, 720)), renderer(size=(900, 720), panel=False)
        assert (whole.frame(scene())[60:, 705:] != 255).any()
        frame = alone.frame(scene())
        assert (frame[:, 886:] == 255).all()
        assert (frame[300, 880:886].min(axis=1) < 200).any()  # the edge of the map


class TestAsAnObject:
    @pytest.mark.parametrize("copied", [copy.deepcopy, lambda one: pickle.loads(pickle.dumps(one))])
    def test_copies_go_on_alike(self, copied):
        drawn = renderer(title="two of them")
        drawn.frame(scene(0.0))
        other = copied(drawn)
        following = scene(0.5, x=(0.5, 0.5, 3.0, 1.0, 1.0, -2.0))
        assert np.array_equal(drawn.frame(following), other.frame(following))

    def test_without_pygame_it_says_what_to_install(self, monkeypatch):
        canvas.load_pygame.cache_clear()
        monkeypatch.setitem(sys.modules, "pygame", None)
        drawn = renderer()
        for draw in (drawn.frame, drawn.show):
            with pytest.raises(ModuleNotFoundError, match=r"pip install -c constraints.txt -e '\.\[render\]'"):
                draw(scene())

    @pytest.mark.parametrize("again", [False, True])
    def test_pygame_ended_by_others_is_no_end(self, again):
        """pygame.quit() makes all fonts invalid for good, also after pygame.init()."""
        pygame, drawn = canvas.load_pygame(), renderer()
        drawn.frame(scene())
        pygame.quit()
        if again:
            pygame.font.init()
        expected = renderer()
        expected.frame(scene())
        later = scene(0.1, x=(0.5, 0.5, 3.0, 1.0, 1.0, -2.0))
        assert np.array_equal(drawn.frame(later), expected.frame(later))
