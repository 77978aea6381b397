"""An order of observers in which the matrices M_i have a small profile."""

from __future__ import annotations

from collections.abc import Sequence


def profile_order(adjacency: Sequence[frozenset[int]], members: Sequence[int]) -> list[int]:
    """Order observers by reversed breadth-first search within their own graph: little fill-in when M_i is factorised.

    Source: E. Cuthill and J. McKee, Reducing the bandwidth of sparse symmetric matrices, 1969.
    """
    inside = set(members)
    degree = {agent: len(adjacency[agent] & inside) for agent in members}
    order: list[int] = []
    for root in sorted(members, key=lambda agent: (degree[agent], agent)):
        if root not in inside:
            continue
        inside.discard(root)
        queue = [root]
        for agent in queue:
            fresh = sorted(adjacency[agent] & inside, key=lambda other: (degree[other], other))
            inside.difference_update(fresh)
            queue.extend(fresh)
        order.extend(queue)
    return order[::-1]
