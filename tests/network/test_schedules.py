"""Schedules of links: which are up, as a pure function of key, time and positions."""

import pickle

import networkx as nx
import numpy as np
import pytest
from hypothesis import given
from hypothesis import strategies as st

from khop_env.network import Both, Fixed, Outage, RandomLinks, Range, Schedule, Switching
from khop_env.network.randomness import draw_keys, plain_uniform
from khop_env.physics import Links
from tests.strategies import SEEDS, connected_graphs, digraphs, schedules

RING = nx.cycle_graph(6)
ONE_WAY = nx.cycle_graph(6, create_using=nx.DiGraph)


def up_in(schedule, graph=RING, t=0.0, batch=1, x=None, seed=0, key=None):
    """(L, B) links that are up, and the links."""
    links = Links.of(graph)
    agents = len(graph)
    key = draw_keys([np.random.default_rng(seed + b) for b in range(batch)]) if key is None else key
    positions = np.arange(2 * agents).reshape(agents, 2)
    x = np.zeros((2 * agents, len(key))) if x is None else x
    activity = schedule.bind(links, positions)
    return activity.up(key, np.full(len(key), float(t)), x, np.zeros((len(links), len(key)), bool)), links


def edges_up(schedule, **options):
    """The links that are up in the first environment."""
    up, links = up_in(schedule, **options)
    return {link for link, number in links.index.items() if up[number, 0]}


def both_ways(edges):
    return {(i, j) for edge in edges for i, j in (edge, edge[::-1])}


class TestKinds:
    def test_fixed(self):
        assert edges_up(Fixed()) == both_ways(RING.edges)
        assert edges_up(Fixed(nx.Graph([(0, 1), (3, 4)]))) == both_ways([(0, 1), (3, 4)])
        assert edges_up(Fixed(nx.DiGraph([(1, 0)]))) == {(1, 0)}

    def test_switching_in_cycles(self):
        graphs = nx.Graph([(0, 1)]), nx.Graph([(1, 2)]), nx.DiGraph([(2, 3)])
        schedule = Switching(graphs, period=3.0)
        assert schedule.times == (0.0, 1.0, 2.0)
        expected = [both_ways([(0, 1)]), both_ways([(1, 2)]), {(2, 3)}]
        for t in (0.0, 0.5, 1.0, 1.99, 2.0, 3.0, 4.5, 3e5 + 2.5):
            assert edges_up(schedule, t=t) == expected[int(t % 3.0)]

    def test_switching_once(self):
        schedule = Switching((RING, nx.Graph([(1, 2)])), times=(0, 2))
        assert [len(edges_up(schedule, t=t)) for t in (0.0, 1.9, 2.0, 1e6)] == [12, 12, 2, 2]

    def test_a_change_does_not_wait_for_rounding(self):
        """Ten steps of 0.1 s end at 0.9999999999999999 s."""
        t = np.cumsum([0.1] * 10)[-1]
        assert t < 1.0
        assert len(edges_up(Switching((RING, nx.Graph([(1, 2)])), times=(0, 1)), t=t)) == 2
        assert len(edges_up(Outage(1.0, 1.0, agent=0), t=t)) == 8
        assert len(edges_up(Outage(0.0, 1.0, agent=0), t=t)) == 12

    def test_range(self):
        x = np.zeros((12, 2))
        x[0] = 3.0, 4.0  # agent 0 in the two environments
        x[1] = 4.0, 4.0
        up, links = up_in(Range(5.0), x=x, batch=2)
        assert up[:, 0].all()
        assert {link for link, q in links.index.items() if not up[q, 1]} == both_ways([(0, 1), (0, 5)])

    def test_outages(self):
        assert edges_up(Outage(1.0, 2.0, agent=2), t=1.0) == both_ways(set(RING.edges) - {(1, 2), (2, 3)})
        assert edges_up(Outage(1.0, 2.0, link=(2, 3)), t=2.9) == both_ways(RING.edges) - {(2, 3)}
        for t in (0.0, 0.99, 3.0, 9.0):
            assert len(edges_up(Outage(1.0, 2.0, agent=2), t=t)) == 12

    def test_random_outages_take_any_agent(self):
        up, links = up_in(Outage((0.0, 2.0), 1.0), t=1.0, batch=4000)
        off = np.array([~up[links.receiver == a].any(axis=0) for a in range(6)])
        np.testing.assert_allclose(off.mean(axis=1), 0.5 / 6, atol=0.02)  # 0 < t - start < 1 in half of the episodes
        assert off.sum(axis=0).max() == 1

    def test_random_links_have_their_share(self):
        up, _ = up_in(RandomLinks(0.3), batch=4000)
        np.testing.assert_allclose(up.mean(axis=1), 0.3, atol=0.03)
        up, _ = up_in(RandomLinks((0.2, 1.0)), batch=4000)
        assert up.mean() == pytest.approx(0.6, abs=0.02)
        assert np.unique(up.sum(axis=0)).size == 7

    @pytest.mark.parametrize("both", [False, True])
    def test_random_links_are_those_of_the_plain_hash(self, both):
        schedule = Fixed() & RandomLinks(0.4, both_ways=both)
        up, links = up_in(schedule, batch=20)
        keys = draw_keys([np.random.default_rng(b) for b in range(20)])
        names = [tuple(sorted(link)) if both else link for link in links.index]
        first = len(links) + 3  # of the second schedule
        for b, key in enumerate(keys.tolist()):
            drawn = [plain_uniform(key, -2, first + 1 + sorted(set(names)).index(name), 0) < 0.4 for name in names]
            assert drawn == up[:, b].tolist()

    def test_one_draw_for_both_ways(self):
        up, links = up_in(RandomLinks(0.5), batch=50)
        back = [links.index[j, i] for i, j in links.index]
        np.testing.assert_array_equal(up, up[back])
        up, _ = up_in(RandomLinks(0.5, both_ways=False), batch=50)
        assert not np.array_equal(up, up[back])

    @given(graph=connected_graphs(), seed=SEEDS, probability=st.floats(0.0, 1.0))
    def test_connected_graphs_add_no_more_than_a_tree(self, graph, seed, probability):
        free, links = up_in(RandomLinks(probability), graph, batch=3, seed=seed)
        tied, _ = up_in(RandomLinks(probability, connected=True), graph, batch=3, seed=seed)
        assert np.all(tied >= free)
        for b in range(3):
            before, after = (nx.empty_graph(len(graph)) for _ in range(2))
            before.add_edges_from(link for link, q in links.index.items() if free[q, b])
            after.add_edges_from(link for link, q in links.index.items() if tied[q, b])
            assert nx.is_connected(after)
            missing = nx.number_connected_components(before) - 1
            assert after.number_of_edges() - before.number_of_edges() == missing


@given(data=st.data(), graph=connected_graphs() | digraphs(), seed=SEEDS)
def test_all_of_several(data, graph, seed):
    """`&` is the intersection, flat and associative; the number of a part decides its random numbers."""
    parts = [data.draw(schedules(graph)) for _ in range(3)]
    a, b, c = parts
    assert ((a & b) & c).parts == (a & (b & c)).parts == (*a.parts, *b.parts, *c.parts)
    rng = np.random.default_rng(seed)
    x, t = rng.uniform(-3.0, 3.0, (2 * len(graph), 4)), rng.uniform(0.0, 10.0)
    options = {"graph": graph, "t": t, "x": x, "batch": 4, "seed": seed}
    joined, links = up_in(a & b & c, **options)
    activity = [
        part.part(links, np.arange(2 * len(graph)).reshape(-1, 2), n) for n, part in enumerate((a & b & c).parts)
    ]
    expected = np.ones_like(joined)
    keys = draw_keys([np.random.default_rng(seed + i) for i in range(4)])
    for part in activity:
        alone = np.ones_like(joined)
        part(keys, np.full(4, t), x, alone)
        expected &= alone
    np.testing.assert_array_equal(joined, expected)


@given(data=st.data(), graph=connected_graphs() | digraphs(), seed=SEEDS)
def test_a_pure_function(data, graph, seed):
    """The same alone as in a batch, in any order of calls, and from a pickle."""
    schedule = data.draw(schedules(graph))
    links, agents = Links.of(graph), len(graph)
    rng = np.random.default_rng(seed)
    keys = rng.integers(0, 2**64, 5, np.uint64)
    t, x = rng.uniform(0.0, 30.0, 5), rng.uniform(-3.0, 3.0, (2 * agents, 5))
    bound = schedule.bind(links, np.arange(2 * agents).reshape(agents, 2))
    whole = bound.up(keys, t, x, np.zeros((len(links), 5), bool)).copy()
    other = pickle.loads(pickle.dumps(bound))
    for b in rng.permutation(5).tolist():
        alone = other.up(keys[[b]], t[[b]], np.ascontiguousarray(x[:, [b]]), np.zeros((len(links), 1), bool))
        np.testing.assert_array_equal(alone[:, 0], whole[:, b])
    keys[2] += np.uint64(1)  # a new episode in one environment
    again = bound.up(keys, t, x, np.zeros((len(links), 5), bool))
    np.testing.assert_array_equal(np.delete(again, 2, axis=1), np.delete(whole, 2, axis=1))


class TestAsUsersWriteThem:
    def test_tables(self):
        schedule = Schedule.of(
            [
                {"kind": "random", "probability": [0.5, 1.0], "connected": True},
                {"kind": "outage", "start": 1, "duration": 2.0, "link": [0, 1]},
            ]
        )
        assert schedule == RandomLinks((0.5, 1.0), connected=True) & Outage(1.0, 2.0, link=(0, 1))
        assert Schedule.of(None) is None
        assert Schedule.of(schedule) is schedule
        (part,) = Schedule.of({"kind": "fixed", "directed": True, "graph": [[1, 0]]}).parts
        assert set(part.graph.edges) == {(1, 0)}
        assert part.graph.is_directed()
        assert isinstance(Schedule.of([{"kind": "range", "radius": 1.0}]), Range)
        assert isinstance(schedule, Both)

    @pytest.mark.parametrize(
        ("wrong", "message"),
        [
            ("random", r"a schedule is a Schedule, a mapping with its 'kind'.*'random'"),
            ([], r"a schedule is a Schedule"),
            ([None], r"must not hold None"),
            ({"kind": "rnage"}, r"no kind of schedule 'rnage'; did you mean 'range'"),
            ({"kind": "range", "radus": 1.0}, r"Range: unknown key 'radus'; did you mean 'radius'"),
            ({"kind": "outage", "duration": 1.0}, r"Outage: start is missing"),
            ({"kind": "fixed", "graph": [[0, -1]]}, r"Fixed.graph must be a list of edges \[i, j\]"),
            ({"kind": "switching", "graphs": 3, "period": 1.0}, r"Switching.graphs must be a list of lists of edges"),
            ({"kind": "fixed", "directed": 1}, r"Fixed: directed must be true or false; got 1"),
        ],
    )
    def test_refused(self, wrong, message):
        with pytest.raises(ValueError, match=message):
            Schedule.of(wrong)

    @pytest.mark.parametrize(
        ("make", "message"),
        [
            (lambda: Range(0.0), r"Range.radius must be positive and finite, in m; got 0"),
            (lambda: RandomLinks(1.2), r"RandomLinks.probability must be from 0 to 1; got 1.2"),
            (lambda: RandomLinks(0.5, connected=1), r"RandomLinks.connected must be True or False; got 1"),
            (lambda: RandomLinks(0.5, False, True), r"drawn edge by edge; set both_ways = True"),
            (lambda: Outage(-1.0, 1.0), r"Outage.start must be finite and not negative, in s; got -1"),
            (lambda: Outage(1.0, np.inf), r"Outage.duration must be finite"),
            (lambda: Outage(1.0, 1.0, agent=1, link=(0, 1)), r"give an agent or a link, not both"),
            (lambda: Outage(1.0, 1.0, link=(0, 1, 2)), r"Outage.link must be the indices of two agents"),
            (
                lambda: Outage(1.0, 1.0, agent="drifter_0"),
                r"Outage.agent must be an agent's index \(a schedule doesn't know ids: "
                r"scenario.fleet.agent\('drifter_0'\) is the index\); got 'drifter_0'",
            ),
            (
                lambda: Outage(1.0, 1.0, link=("a_0", "a_1")),
                r"\(a schedule doesn't know ids: .*'a_0'.*got \('a_0', 'a_1'",
            ),
            (lambda: Switching((RING,)), r"give the period of a cycle, or the times"),
            (lambda: Switching((RING, RING), times=(0.0,)), r"times must be 2 numbers, one for each graph"),
            (lambda: Switching((RING, RING), 2.0, (0.0, 2.0)), r"ascend from 0, below the period of 2 s"),
            (lambda: Switching((), 1.0), r"Switching.graphs must be graphs, at least one"),
            (lambda: Fixed([(0, 1)]), r"Fixed.graph must be a networkx.Graph or DiGraph"),
            (lambda: Fixed(nx.Graph([("a", "b")])), r"nodes must be agents' indices; got 'a'"),
        ],
    )
    def test_values_out_of_range(self, make, message):
        with pytest.raises(ValueError, match=message):
            make()

    @pytest.mark.parametrize(
        ("schedule", "graph", "message"),
        [
            (
                Fixed(nx.Graph([(0, 3)])),
                RING,
                r"Fixed.graph has 2 links that .* first from 0 to 3; .*add them to it",
            ),
            (Switching((RING,), 1.0), ONE_WAY, r"Switching.graphs\[0\] has 6 links .* the first from 0 to 5"),
            (Fixed(nx.Graph([(0, 2)]).to_directed()), RING, r"Fixed.graph has 2 links that the"),
            (Fixed(nx.DiGraph([(0, 2)])), RING, r"Fixed.graph has 1 link that the communication graph doesn't have"),
            (Outage(0.0, 1.0, agent=6), RING, r"Outage.agent must be from 0 to 5; got 6"),
            (Outage(0.0, 1.0, link=(1, 0)), ONE_WAY, r"the communication graph has no link from 1 to 0"),
            (RandomLinks(0.5, connected=True), ONE_WAY, r"links that go one way, out of which no connected graph"),
        ],
    )
    def test_that_do_not_fit_the_graph(self, schedule, graph, message):
        with pytest.raises(ValueError, match=message):
            schedule.bind(Links.of(graph), np.zeros((6, 2), np.int64))

    def test_only_schedules_are_joined(self):
        with pytest.raises(TypeError):
            _ = Fixed() & 3

    def test_a_schedule_of_ones_own_needs_a_part(self):
        class Own(Schedule):
            pass

        with pytest.raises(NotImplementedError, match=r"Own has no part\(links, positions, number\)"):
            Own().bind(Links.of(nx.path_graph(3)), np.zeros((3, 2), np.int64))


class TestNextChange:
    """The times up to which nothing changes but for agents' positions."""

    @staticmethod
    def after(schedule, times, batch=1, graph=RING):
        activity = schedule.bind(Links.of(graph), np.arange(2 * len(graph)).reshape(-1, 2))
        key = draw_keys([np.random.default_rng(b) for b in range(batch)])
        return [activity.next_change(key, np.full(batch, float(t))) for t in times]

    def test_of_graphs_that_switch(self):
        graphs = RING, nx.Graph([(1, 2)]), nx.Graph([(2, 3)])
        found = self.after(Switching(graphs, period=3.0), (0.0, 0.4, 1.0, 2.5, 3.0, 300.2))
        assert np.ravel(found) == pytest.approx([1.0, 1.0, 2.0, 3.0, 4.0, 301.0], abs=1e-12)
        found = self.after(Switching(graphs, times=(0, 0.5, 2)), (0.0, 0.5 - 5e-10, 1.0, 2.0, 5.0))
        assert np.ravel(found) == pytest.approx([0.5, 2.0, 2.0, np.inf, np.inf], abs=1e-12)

    def test_of_an_outage(self):
        found = self.after(Outage(1.0, 0.5, agent=2), (0.0, 1.0 - 5e-10, 1.2, 1.5, 9.0))
        assert np.ravel(found) == pytest.approx([1.0, 1.5, 1.5, np.inf, np.inf], abs=1e-12)

    def test_of_all_parts_the_first(self):
        joined = Outage(1.0, 0.5) & Switching((RING, RING), times=(0, 1.2)) & Range(2.0) & RandomLinks(0.5) & Fixed()
        assert np.ravel(self.after(joined, (0.0, 1.1, 1.3))) == pytest.approx([1.0, 1.2, 1.5], abs=1e-12)

    def test_of_a_schedule_that_does_not_say(self):
        class Own(Schedule):
            def part(self, links, positions, number):
                return lambda key, t, x, out: None

        assert self.after(Own(), (0.0,))[0] == np.inf

    @given(seed=SEEDS, start=st.floats(0, 5), length=st.floats(1e-3, 5))
    def test_links_do_not_change_before(self, seed, start, length):
        """Of drawn outages, environment by environment: just before the change nothing has changed, at it all has."""
        schedule, links = Outage((start, start + 2.0), (length, 2.0 * length), agent=1), Links.of(RING)
        activity = schedule.bind(links, np.arange(12).reshape(-1, 2))
        key = draw_keys([np.random.default_rng(seed + b) for b in range(3)])
        t, x, out = np.zeros(3), np.zeros((12, 3)), np.zeros((len(links), 3), bool)
        for change in range(3):
            before = activity.up(key, t, x, out).copy()
            following = activity.next_change(key, t)
            if change == 2:
                assert np.isinf(following).all()
                break
            assert np.all(following > t)
            assert np.array_equal(activity.up(key, following - 2e-9, x, out), before)
            assert (activity.up(key, following, x, out) != before).any(axis=0).all()
            t = following
