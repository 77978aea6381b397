"""Compiled rounds: what becomes of the messages of all links, in a range of environments.

`low` is the first environment and `high` one past the last, so that threads share a batch.
"""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from khop_env.compiled import compiled, inlined, place
from khop_env.network.network import Network
from khop_env.network.randomness import DELAY, EPISODE, EPISODE_ROUND, LOSS, NOISE, round_key, uniform
from khop_env.physics import FloatArray, IndexArray

WORD = 64
FEW_SLOTS = 4  # of the ring: up to so many one loop each, which vectorises, costs less than looking each place up


class Rules(NamedTuple):
    """A network as compiled loops take it: of all that episodes draw the lowest and the highest value."""

    loss: tuple[float, float]
    latency: tuple[float, float]
    burst: tuple[float, float]  # 0 for independent losses
    jitter: tuple[float, float]
    period: float
    most_rounds_late: int

    @staticmethod
    def of(network: Network) -> Rules:
        """The rules of a network."""
        burst = (0.0, 0.0) if network.burst is None else network.bounds("burst")
        loss, latency, jitter = (network.bounds(name) for name in ("loss", "latency", "jitter"))
        return Rules(loss, latency, burst, jitter, network.period, network.most_rounds_late)


@inlined
def _drawn(span: tuple[float, float], base: np.uint64, number: int) -> float:
    """What `Network.drawn` draws: `number` is that of `DRAWN`."""
    low, high = span
    return low if low == high else min(high, low + (high - low) * uniform(base, number, EPISODE))


@inlined
def _rounds_late(rules: Rules, latency: float, jitter: float, u: float) -> int:
    delay = latency - jitter + 2.0 * jitter * u
    return min(rules.most_rounds_late, math.ceil(delay / rules.period - 1e-9))


@compiled
def start_links(rules: Rules, key: NDArray[np.uint64], env_ids: IndexArray, bad: NDArray[np.bool_]) -> None:
    """Draw the links' first states from their stationary distribution."""
    for b in env_ids:
        base = round_key(key[b], EPISODE_ROUND)
        loss = _drawn(rules.loss, base, 0)
        for link in range(bad.shape[0]):
            bad[link, b] = uniform(base, link, LOSS) < loss


@compiled
def run_round(
    rules: Rules,
    key: NDArray[np.uint64],
    number: NDArray[np.int64],
    due: NDArray[np.bool_],
    up: NDArray[np.bool_],
    bad: NDArray[np.bool_],
    lost: NDArray[np.uint64],
    newest: NDArray[np.int64],
    heard: NDArray[np.bool_],
    low: int,
    high: int,
) -> None:
    """One round in the environments that are due: who loses what, and what arrives."""
    links, width = newest.shape[0], high - low
    bits = WORD * lost.shape[0]
    of_round = np.empty(width, np.uint64)
    after_delivery, after_loss = np.empty(width), np.empty(width)
    latency, jitter = np.empty(width), np.empty(width)
    soonest, latest = np.empty(width, np.int64), np.empty(width, np.int64)
    for e in range(width):
        b = place(low + e)
        if due[b]:
            number[b] += 1
        base = round_key(key[b], EPISODE_ROUND)
        loss, latency[e] = _drawn(rules.loss, base, 0), _drawn(rules.latency, base, 1)
        burst, jitter[e] = _drawn(rules.burst, base, 2), _drawn(rules.jitter, base, 3)
        after_delivery[e] = after_loss[e] = loss
        if burst > 0.0:
            recovery = 1.0 / burst
            after_delivery[e], after_loss[e] = recovery * loss / (1.0 - loss), 1.0 - recovery
        of_round[e] = round_key(key[b], number[b])
        soonest[e] = _rounds_late(rules, latency[e], jitter[e], 0.0)
        latest[e] = _rounds_late(rules, latency[e], jitter[e], 1.0)
    for link in range(links):
        for e in range(width):
            b = place(low + e)
            heard[link, b] = False
            if not due[b]:
                continue
            now = number[b]
            threshold = after_loss[e] if bad[link, b] else after_delivery[e]
            bad[link, b] = uniform(of_round[e], link, LOSS) < threshold
            word, bit = now % bits // WORD, np.uint64(1) << np.uint64(now % WORD)
            if bad[link, b] or not up[link, b]:
                lost[word, link, b] |= bit
            else:
                lost[word, link, b] &= ~bit
            for age in range(soonest[e], min(latest[e], now - newest[link, b] - 1) + 1):
                sent = now - age
                if (lost[sent % bits // WORD, link, b] >> np.uint64(sent % WORD)) & np.uint64(1):
                    continue
                if latest[e] > soonest[e]:
                    u = uniform(round_key(key[b], sent), link, DELAY)
                    if _rounds_late(rules, latency[e], jitter[e], u) > age:
                        continue
                newest[link, b], heard[link, b] = sent, True
                break


@compiled
def send(
    parts: tuple[FloatArray, ...],
    first: int,
    number: NDArray[np.int64],
    due: NDArray[np.bool_],
    sent: FloatArray,
    low: int,
    high: int,
) -> None:
    """Keep what agents send, parts (rows, B) one below the other, in this round's place of the ring (rounds, W, B).

    Its rows there begin at `first`.
    """
    capacity, width = sent.shape[0], high - low
    slots = np.empty(width, np.int64)  # of the ring; -1 where nothing is sent
    in_use = np.zeros(capacity, np.bool_)
    for e in range(width):
        b = place(low + e)
        slots[e] = number[b] % capacity if due[b] else -1
        if slots[e] >= 0:
            in_use[slots[e]] = True
    for slot in range(capacity):
        if not in_use[slot]:
            continue
        row = first
        for k in range(len(parts)):
            values = parts[k]
            for r in range(values.shape[0]):
                for e in range(width):
                    b = place(low + e)
                    sent[slot, row, b] = values[r, b] if slots[e] == slot else sent[slot, row, b]
                row += 1


@compiled
def add_noise(
    noise: float,
    key: NDArray[np.uint64],
    number: NDArray[np.int64],
    x: FloatArray,
    out: FloatArray,
    low: int,
    high: int,
) -> None:
    """Write what agents measure for the next round into `out`."""
    for b in range(low, high):
        base = round_key(key[b], number[b] + 1)
        for row in range(x.shape[0]):
            out[row, b] = x[row, b] + noise * (2.0 * uniform(base, row, NOISE) - 1.0)


@compiled
def take_heard(
    sent: FloatArray,
    newest: NDArray[np.int64],
    heard: NDArray[np.bool_],
    link: IndexArray,
    row: IndexArray,
    out: FloatArray,
    low: int,
    high: int,
) -> None:
    """Copy into `out` (C, B) what came over links in this round, and leave the rest."""
    capacity, width = sent.shape[0], high - low
    slots = np.empty((newest.shape[0], width), np.int64)  # of the ring, -1 where nothing is new
    in_use = np.zeros((newest.shape[0], capacity), np.bool_)
    for over in range(newest.shape[0]):
        for e in range(width):
            b = place(low + e)
            slots[over, e] = newest[over, b] % capacity if heard[over, b] else -1
            if slots[over, e] >= 0:
                in_use[over, slots[over, e]] = True
    for c in range(len(link)):
        over = link[c]
        if in_use[over].sum() > FEW_SLOTS:
            for e in range(width):
                if slots[over, e] >= 0:
                    out[c, place(low + e)] = sent[slots[over, e], row[c], place(low + e)]
            continue
        for slot in range(capacity):
            if in_use[over, slot]:
                for e in range(width):
                    b = place(low + e)
                    out[c, b] = sent[slot, row[c], b] if slots[over, e] == slot else out[c, b]
