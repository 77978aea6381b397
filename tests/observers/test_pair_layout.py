"""Pair layouts and what agents hold of messages, against loops that are as plain as their definitions."""

import networkx as nx
import numpy as np
import pytest
from hypothesis import given, settings
from hypothesis import strategies as st

from khop_env.observers import PairLayout
from khop_env.observers.indexing import find, ranges
from khop_env.observers.ordering import profile_order
from khop_env.observers.rounds import _held
from khop_env.physics import Links, k_hop_neighbors

GRAPHS = st.builds(
    lambda agents, share, seed, directed: nx.gnp_random_graph(agents, share, seed=seed, directed=directed),
    st.integers(1, 12),
    st.floats(0.1, 0.6),
    st.integers(0, 10**6),
    st.booleans(),
)


def laid_out(graph, k, relay, dimensions, targets=None, changing=False):
    links, neighborhoods = Links.of(graph), k_hop_neighbors(graph, k, relay=relay)
    offsets = np.cumsum([0, *dimensions])
    return PairLayout.build(
        links, neighborhoods, dimensions, offsets, relay=relay, targets=targets, changing=changing
    ), neighborhoods


@settings(max_examples=150, deadline=None)
@given(graph=GRAPHS, k=st.integers(2, 3), relay=st.booleans(), changing=st.booleans(), data=st.data())
def test_a_layout_is_what_its_attributes_say(graph, k, relay, changing, data):
    agents = graph.number_of_nodes()
    dimensions = data.draw(st.lists(st.integers(1, 3), min_size=agents, max_size=agents))
    targets = data.draw(st.none() | st.lists(st.integers(0, agents - 1), unique=True))
    layout, neighborhoods = laid_out(graph, k, relay, dimensions, targets, changing)
    links, arrays, offsets = layout.links, layout.arrays, np.cumsum([0, *dimensions])
    pair = column = row = entries = relays = number = 0
    last = []
    for i in range(agents) if targets is None else sorted(targets):
        members = profile_order(links.senders, neighborhoods[i])
        if not members:
            continue
        of_target = [int(values[number]) for values in arrays[:6]]
        assert of_target == [len(members), dimensions[i], column, offsets[i], row, pair]
        assert layout.target[number] == i
        for a, agent in enumerate(members):
            linked = sorted(members.index(other) for other in links.senders[agent] if other in members)
            sending = sorted(p for p in links.senders[agent] if (i in links.senders[p] if relay else p == i))
            assert layout.observer[pair] == agent
            assert (arrays.relay[pair], arrays.diagonal[pair]) == (len(sending), len(sending) + len(linked))
            assert arrays.first[pair] == min([a, *linked])
            assert (arrays.entry_start[pair], layout.relay_start[pair]) == (entries, relays)
            assert arrays.entry[entries : entries + len(linked)].tolist() == linked
            expected = [links.index[members[b], agent] for b in linked]
            assert layout.entry_link[entries : entries + len(linked)].tolist() == expected
            expected = [links.index[p, agent] for p in sending]
            assert layout.relay_link[relays : relays + len(sending)].tolist() == expected
            begin = len(last) - a
            last.append(max([a, *linked, *last[begin + min([a, *linked]) : begin + a]]))
            pair, entries, relays = pair + 1, entries + len(linked), relays + len(sending)
        column, row, number = column + len(members) * dimensions[i], row + dimensions[i], number + 1
    assert (layout.pairs, len(layout.target), layout.size, layout.rows) == (pair, number, column, row)
    assert (len(layout.entry_link), len(layout.relay_link)) == (entries, relays)
    assert arrays.last.tolist() == (last if changing or not links.symmetric else [])
    assert {values.dtype for values in (*arrays, layout.observer, layout.relay_start)} == {
        np.dtype(np.int64),
        np.dtype(np.float64),
    }


@settings(max_examples=60, deadline=None)
@given(graph=GRAPHS, data=st.data())
def test_what_is_held_are_estimates_and_then_relayed_values(graph, data):
    agents = graph.number_of_nodes()
    dimensions = data.draw(st.lists(st.integers(1, 3), min_size=agents, max_size=agents))
    layout, _ = laid_out(graph, 3, True, dimensions)
    known, _ = laid_out(graph, 3, False, dimensions)
    relayed = {pair: 1000 + start for pair, start in known.slot.items()}
    held = _held(layout, 100, 10, relayed)
    values, number = [], 0
    for block in layout.blocks:
        for pair in range(block.pairs.start, block.pairs.stop):
            assert (held.start[pair], held.offset[pair]) == (number, len(values))
            for k in range(layout.arrays.entry_start[pair], layout.arrays.entry_start[pair + 1]):
                first = 100 + block.columns.start + layout.arrays.entry[k] * block.components
                values += [(layout.entry_link[k], first + c, block.sources.start + c) for c in range(block.components)]
                number += 1
            for link in layout.relay_link[layout.relay_start[pair] : layout.relay_start[pair + 1]]:
                p = layout.links.sender[link]
                first = 10 + block.sources.start if p == block.agent else relayed[p, block.agent]
                values += [(link, first + c, block.sources.start + c) for c in range(block.components)]
                number += 1
    assert list(zip(held.link, held.row, held.source, strict=True)) == values
    assert held.start[-1] == number


@pytest.mark.parametrize("known", [[], [3], [5, 1, 9]])
def test_numbers_are_found_where_they_are(known):
    found, place = find(np.arange(12), np.array(known, np.int64))
    assert np.flatnonzero(found).tolist() == sorted(known)
    assert [known[at] for at in place[found]] == sorted(known)


def test_ranges_follow_each_other():
    which, number = ranges(np.array([5, 0, 7]), np.array([2, 0, 3]))
    assert (which.tolist(), number.tolist()) == ([0, 0, 2, 2, 2], [5, 6, 7, 8, 9])
