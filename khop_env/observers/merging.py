"""Store and forward: of every agent the freshest state that has come along any way, in compiled code."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from khop_env.compiled import compiled, place
from khop_env.network.rounds import FEW_SLOTS
from khop_env.observers.layout import FloatArray, IntArray, PairLayout

TIME = 0  # row of a message's time


class Sources(NamedTuple):
    """Where each pair (observer, target) may hear of its target: from the target, or from another that knows it.

    Attributes:
        start: (pairs + 1,) where each pair's part of the other arrays begins; ordered by sender.
        link: over which it comes.
        state: first row of the target's state in what all agents send.
        stamp: row of its stamp: that of the message's time where the target itself sends.
        hops: row of the number of links that it has come already; -1 for the target itself.
        error: first row of its certified error; -1 for the target itself.
        data: first row of the target's data.
        column: (pairs,) first column of the pair's prediction.
        components: (pairs,) of its state.
    """

    start: IntArray
    link: IntArray
    state: IntArray
    stamp: IntArray
    hops: IntArray
    error: IntArray
    data: IntArray
    column: IntArray
    components: IntArray

    @staticmethod
    def of(layout: PairLayout, components_of_all: int, agents: int, message_size: int) -> Sources:
        """The sources of a layout of all agents within k hops.

        What is sent has these rows: the message's time; the states of the fleet, of `components_of_all` in all; the
        predictions and their certified errors (P each) and then the stamps and the hops (pairs each) of all pairs; the
        data of all `agents`, and what each pair holds of its target's, `message_size` rows each.
        """
        arrays, sender = layout.arrays, layout.links.sender
        start, found = [0], list[tuple[int, int, int, int, int, int]]()
        first_data = 1 + components_of_all + 2 * (layout.size + layout.pairs)
        column, components = [], []
        for block in layout.blocks:
            for number, pair in enumerate(range(block.pairs.start, block.pairs.stop)):
                own_data = first_data + int(layout.pair_target[pair]) * message_size
                ways = [
                    (link, 1 + block.sources.start, TIME, -1, -1, own_data)
                    for link in layout.relay_link[layout.relay_start[pair] : layout.relay_start[pair + 1]].tolist()
                ]
                part = slice(arrays.entry_start[pair], arrays.entry_start[pair + 1])
                for other, link in zip(arrays.entry[part].tolist(), layout.entry_link[part].tolist(), strict=True):
                    state = 1 + components_of_all + block.columns.start + other * block.components
                    stamp = 1 + components_of_all + 2 * layout.size + block.pairs.start + other
                    data = first_data + (agents + block.pairs.start + other) * message_size
                    ways.append((link, state, stamp, stamp + layout.pairs, state + layout.size, data))
                found += sorted(ways, key=lambda way: int(sender[way[0]]))
                start.append(len(found))
                column.append(block.columns.start + number * block.components)
                components.append(block.components)
        link, state, stamps, hops, errors, data = np.array(found, np.int64).reshape(-1, 6).T.copy()
        first, places, sizes = (np.array(values, np.int64) for values in (start, column, components))
        return Sources(first, link, state, stamps, hops, errors, data, places, sizes)


@compiled
def merge(
    sources: Sources,
    late: bool,
    sent: FloatArray,
    number: NDArray[np.int64],
    newest: NDArray[np.int64],
    heard: NDArray[np.bool_],
    noise: float,
    even_since: FloatArray,
    t: FloatArray,
    now: FloatArray,
    center: FloatArray,
    error: FloatArray,
    stamp: FloatArray,
    hops: FloatArray,
    arrived: FloatArray,
    data: FloatArray,
    lag: FloatArray,
    low: int,
    high: int,
) -> bool:
    """Take over what is fresher than what is held, from the messages that have just arrived.

    Args:
        sources: as a plain tuple.
        late: True for messages of earlier rounds, False for those of this one.
        sent: (rounds, W, B) what was sent.
        number: (B,) this round.
        newest: (L, B) round in which each link's newest message was sent.
        heard: (L, B) whether it has just arrived.
        noise: certified error of a state that its agent itself sends.
        even_since: (B,) since when steps are equal, in s. What has been on its way since before then isn't used: it
            can't be moved in the steps of the plant.
        t: (B,) time that predictions are of, in s.
        now: (B,) the round's time, in s.
        center: (P, B) predictions; changed.
        error: (P, B) their certified errors; changed.
        stamp: (pairs, B) when the state behind each was measured, -1 for none; changed.
        hops: (pairs, B) links over which it came; changed.
        arrived: (pairs, B) when; changed.
        data: (pairs * message_size, B) what else the target has sent with that state; changed.
        lag: (pairs, B) time from the message that was taken over to `t`, in s, else 0; written.
        low: first environment.
        high: one past the last.

    Returns:
        Whether any of these is positive.
    """
    start, link, state, stamp_row, hops_row, error_row, data_row, column, components = sources
    capacity, width, message_size = sent.shape[0], high - low, data.shape[0] // max(column.size, 1)
    choice, slot_of = np.empty(width, np.int64), np.empty(width, np.int64)
    slots = np.empty((newest.shape[0], width), np.int64)  # of the ring, -1 where nothing is to be read
    in_use = np.zeros((newest.shape[0], capacity), np.bool_)
    for over in range(newest.shape[0]):
        for e in range(width):
            b = place(low + e)
            arrives = heard[over, b] and (newest[over, b] < number[b]) == late
            at = newest[over, b] % capacity
            usable = arrives and sent[at, TIME, b] >= even_since[b] - 1e-12
            slots[over, e] = at if usable else -1
            if usable:
                in_use[over, at] = True
    behind = 0.0
    for pair in range(column.size):
        for e in range(width):
            choice[e] = -1
            lag[pair, place(low + e)] = 0.0
        found = False
        for way in range(start[pair], start[pair + 1]):
            over, row = link[way], stamp_row[way]
            if in_use[over].sum() > FEW_SLOTS:
                found = True
                for e in range(width):
                    b, slot = place(low + e), slots[over, e]
                    if slot >= 0 and sent[slot, row, b] > stamp[pair, b]:
                        stamp[pair, b] = sent[slot, row, b]
                        choice[e], slot_of[e] = way, slot
                continue
            for slot in range(capacity):
                if not in_use[over, slot]:
                    continue
                found = True
                for e in range(width):
                    b = place(low + e)
                    held, offered = stamp[pair, b], sent[slot, row, b]
                    fresher = slots[over, e] == slot and offered > held
                    stamp[pair, b] = offered if fresher else held
                    choice[e] = way if fresher else choice[e]
                    slot_of[e] = slot if fresher else slot_of[e]
        if not found:
            continue
        for c in range(components[pair]):  # the batch innermost: neighbouring environments lie side by side
            q = column[pair] + c
            for e in range(width):
                way = choice[e]
                if way >= 0:
                    b = place(low + e)
                    center[q, b] = sent[slot_of[e], state[way] + c, b]
                    error[q, b] = noise if error_row[way] < 0 else sent[slot_of[e], error_row[way] + c, b]
        for c in range(message_size):
            q = pair * message_size + c
            for e in range(width):
                way = choice[e]
                if way >= 0:
                    b = place(low + e)
                    data[q, b] = sent[slot_of[e], data_row[way] + c, b]
        for e in range(width):
            way = choice[e]
            if way >= 0:
                b = place(low + e)
                hops[pair, b] = 1.0 if hops_row[way] < 0 else sent[slot_of[e], hops_row[way], b] + 1.0
                arrived[pair, b] = now[b]
                lag[pair, b] = t[b] - sent[slot_of[e], TIME, b]
                behind = max(behind, lag[pair, b])
    return behind > 1e-12


@compiled
def largest_share(
    column_source: IntArray,
    estimate: FloatArray,
    x: FloatArray,
    bound: FloatArray,
    largest: FloatArray,
    low: int,
    high: int,
) -> None:
    """Raise `largest` (B,) to the largest |error| / bound of any estimate (P, B); 0 / 0 counts as 0.

    In the environments from `low` to `high` - 1.
    """
    for q in range(column_source.size):
        row = column_source[q]
        for e in range(high - low):
            b = place(low + e)
            error = abs(estimate[q, b] - x[row, b])
            share = error / bound[q, b] if error > 0.0 else 0.0 * error  # a NaN stays, and is reported
            most = largest[b]
            largest[b] = share if not share <= most and most == most else most
