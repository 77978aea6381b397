"""Compiled rounds: what becomes of the messages of all links of all environments."""

from __future__ import annotations

import math
from typing import NamedTuple

import numpy as np
from numpy.typing import NDArray

from khop_env.compiled import compiled, inlined
from khop_env.network.network import Network
from khop_env.network.randomness import DELAY, EPISODE, EPISODE_ROUND, LOSS, NOISE, round_key, uniform
from khop_env.physics import FloatArray, IndexArray

WORD = 64


class Rules(NamedTuple):
    """A network as compiled loops take it: every value that is drawn is low + span * uniform, of each episode."""

    loss_low: float
    loss_span: float
    recovery: float  # 1 / burst; 0 for independent losses
    latency_low: float
    latency_span: float
    jitter: float
    period: float
    most_rounds_late: int

    @staticmethod
    def of(network: Network) -> Rules:
        """The rules of a network."""
        loss, latency = network.bounds("loss"), network.bounds("latency")
        recovery = 0.0 if network.burst is None else 1.0 / network.burst
        late = network.most_rounds_late
        spans = loss[1] - loss[0], latency[1] - latency[0]
        return Rules(loss[0], spans[0], recovery, latency[0], spans[1], network.jitter, network.period, late)


@inlined
def _rounds_late(rules: Rules, latency: float, u: float) -> int:
    delay = latency - rules.jitter + 2.0 * rules.jitter * u
    return min(rules.most_rounds_late, math.ceil(delay / rules.period - 1e-9))


@compiled
def start_links(rules: Rules, key: NDArray[np.uint64], env_ids: IndexArray, bad: NDArray[np.bool_]) -> None:
    """Draw the links' first states from their stationary distribution."""
    for b in env_ids:
        base = round_key(key[b], EPISODE_ROUND)
        loss = rules.loss_low + rules.loss_span * uniform(base, 0, EPISODE)
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
) -> None:
    """One round in the environments that are due: who loses what, and what arrives."""
    links, batch = newest.shape
    bits = WORD * lost.shape[0]
    of_round = np.empty(batch, np.uint64)
    after_delivery, after_loss, latency = np.empty(batch), np.empty(batch), np.empty(batch)
    for b in range(batch):
        if due[b]:
            number[b] += 1
        base = round_key(key[b], EPISODE_ROUND)
        loss = rules.loss_low + rules.loss_span * uniform(base, 0, EPISODE)
        latency[b] = rules.latency_low + rules.latency_span * uniform(base, 1, EPISODE)
        after_delivery[b] = after_loss[b] = loss
        if rules.recovery > 0.0:
            after_delivery[b], after_loss[b] = rules.recovery * loss / (1.0 - loss), 1.0 - rules.recovery
        of_round[b] = round_key(key[b], number[b])
    for link in range(links):
        for b in range(batch):
            heard[link, b] = False
            if not due[b]:
                continue
            now = number[b]
            threshold = after_loss[b] if bad[link, b] else after_delivery[b]
            bad[link, b] = uniform(of_round[b], link, LOSS) < threshold
            word, bit = now % bits // WORD, np.uint64(1) << np.uint64(now % WORD)
            if bad[link, b] or not up[link, b]:
                lost[word, link, b] |= bit
            else:
                lost[word, link, b] &= ~bit
            soonest = _rounds_late(rules, latency[b], 0.0)
            latest = _rounds_late(rules, latency[b], 1.0)
            for age in range(soonest, min(latest, now - newest[link, b] - 1) + 1):
                sent = now - age
                if (lost[sent % bits // WORD, link, b] >> np.uint64(sent % WORD)) & np.uint64(1):
                    continue
                if latest > soonest:
                    u = uniform(round_key(key[b], sent), link, DELAY)
                    if _rounds_late(rules, latency[b], u) > age:
                        continue
                newest[link, b], heard[link, b] = sent, True
                break


@compiled
def send(values: FloatArray, first: int, number: NDArray[np.int64], due: NDArray[np.bool_], sent: FloatArray) -> None:
    """Keep what agents send in this round's place of the ring (rounds, W, B), as its rows from `first` on."""
    place = number % sent.shape[0]
    for row in range(values.shape[0]):
        for b in range(values.shape[1]):
            if due[b]:
                sent[place[b], first + row, b] = values[row, b]


@compiled
def add_noise(noise: float, key: NDArray[np.uint64], number: NDArray[np.int64], x: FloatArray, out: FloatArray) -> None:
    """Write what agents measure for the next round into `out`."""
    for b in range(x.shape[1]):
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
) -> None:
    """Copy into `out` (C, B) what came over links in this round, and leave the rest."""
    place = np.empty(newest.shape, np.int64)  # in the ring, -1 where nothing is new
    for over in range(newest.shape[0]):
        for b in range(newest.shape[1]):
            place[over, b] = newest[over, b] % sent.shape[0] if heard[over, b] else -1
    for c in range(len(link)):
        for b in range(out.shape[1]):
            at = place[link[c], b]
            if at >= 0:
                out[c, b] = sent[at, row[c], b]
