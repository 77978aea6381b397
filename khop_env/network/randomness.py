"""Random numbers without a generator: a hash of (key, round, link), the same in compiled loops and in plain Python.

SplitMix64's output function twice: first over the round, then over the link. An environment holds one 64-bit key and
nothing else, so that a number doesn't depend on which others were asked for, or on the batch.

Source: G. L. Steele, D. Lea and C. H. Flood, Fast splittable pseudorandom number generators, OOPSLA 2014.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import NDArray

from khop_env.compiled import inlined

LOSS, DELAY, NOISE, EPISODE = 0, 1, 2, 3  # purposes of a number: 4 of each link and round
EPISODE_ROUND = -1  # before the first round: numbers of the whole episode
SCHEDULE_ROUND = -2  # likewise, of the schedules of links

_STEP = 0x9E3779B97F4A7C15
_FIRST = 0xBF58476D1CE4E5B9
_SECOND = 0x94D049BB133111EB
_MASK = 0xFFFFFFFFFFFFFFFF


@inlined
def mixed(z: np.uint64) -> np.uint64:
    """SplitMix64's bijection of 64-bit words."""
    z = (z ^ (z >> np.uint64(30))) * np.uint64(_FIRST)
    z = (z ^ (z >> np.uint64(27))) * np.uint64(_SECOND)
    return z ^ (z >> np.uint64(31))


@inlined
def round_key(key: np.uint64, number: int) -> np.uint64:
    """The key of a round, from -2, of an environment."""
    return mixed(key + np.uint64(_STEP) * np.uint64(number + 2))


@inlined
def uniform(of_round: np.uint64, link: int, purpose: int) -> float:
    """A number in [0, 1) of a link, or row, and a purpose in the round with the key `of_round`."""
    z = mixed(of_round + np.uint64(_STEP) * np.uint64(4 * link + purpose + 1))
    return np.float64(np.int64(z >> np.uint64(11))) * 1.1102230246251565e-16


def plain_uniform(key: int, number: int, link: int, purpose: int) -> float:
    """`uniform(round_key(key, number), link, purpose)` in plain Python, bit for bit."""
    z = _plain_mixed(key + _STEP * (number + 2))
    return (_plain_mixed(z + _STEP * (4 * link + purpose + 1)) >> 11) * 2.0**-53


def _plain_mixed(z: int) -> int:
    z &= _MASK
    z = (z ^ (z >> 30)) * _FIRST & _MASK
    z = (z ^ (z >> 27)) * _SECOND & _MASK
    return z ^ (z >> 31)


def draw_keys(rngs: Sequence[np.random.Generator]) -> NDArray[np.uint64]:
    """(R,) a 64-bit key from a child of each generator; the generators' own streams stay as they are."""
    keys = [rng.spawn(1)[0].integers(0, 2**64, dtype=np.uint64) for rng in rngs]
    return np.array(keys, np.uint64)
