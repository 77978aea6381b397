"""Message rounds over directed links, of many environments at once: losses in bursts, delays, and what has arrived.

In round k, k periods after reset, every agent broadcasts one message. A link loses it, or delivers it after its delay,
rounded up to whole rounds; a receiver uses the newest message that it has, whatever order they came in. So a link is
one number, the round in which its newest message was sent; and what was sent lies in one ring of the last rounds, not
once per link. Randomness is a hash of (key, round, link): nothing is to be saved but the arrays of `Channel.allocate`.
"""

from __future__ import annotations

from collections.abc import Sequence
from typing import Any

import numpy as np
from numpy.typing import NDArray

from khop_env.network.network import Network
from khop_env.network.randomness import draw_keys
from khop_env.network.rounds import WORD, Rules, add_noise, run_round, send, start_links, take_heard
from khop_env.physics import FloatArray, IndexArray, Links
from khop_env.threads import Range

ChannelMemory = dict[str, NDArray[Any]]
"""Arrays of a channel by name, batch last; see `Channel.allocate`."""


class Channel:
    """The links of a network in B environments.

    Memory belongs to the caller, so that it is copied, saved and restored with everything else; the same memory
    continues with the same bits, in any batch. Methods that take a `part` work on that range of the environments, all
    of them by default, and touch no others, so that threads may share a batch.

    Args:
        network: what happens to messages.
        links: directed links that may ever be up.
        num_envs: number of environments B.
        width: W, how many numbers all agents together send in a round.
    """

    def __init__(self, network: Network, links: Links, num_envs: int, width: int = 0) -> None:
        self.network, self.links, self.num_envs, self.width = network, links, num_envs, width
        self.rules = Rules.of(network)
        self._all = 0, num_envs
        self._all_up, self._all_due = np.ones((len(links), num_envs), np.bool_), np.ones(num_envs, np.bool_)

    def allocate(self) -> ChannelMemory:
        """Memory before the first reset.

        Keys:
            key: (B,) of each environment's randomness.
            round: (B,) the last round, -1 before the first.
            bad: (L, B) whether a link is in the state in which it loses messages.
            lost: (words, L, B) a bit for each of the last rounds, whether its message was lost.
            newest: (L, B) round in which the newest message that has arrived was sent, -1 for none yet.
            heard: (L, B) whether that changed in the last call of `begin_round`.
            sent: (rounds, W, B) what was sent in the last rounds; a round's place is its number modulo their count.
        """
        shape, late = (len(self.links), self.num_envs), self.rules.most_rounds_late
        return {
            "key": np.zeros(self.num_envs, np.uint64),
            "round": np.full(self.num_envs, -1, np.int64),
            "bad": np.zeros(shape, np.bool_),
            "lost": np.zeros((late // WORD + 1, *shape), np.uint64),
            "newest": np.full(shape, -1, np.int64),
            "heard": np.zeros(shape, np.bool_),
            "sent": np.zeros((late + 1, self.width, self.num_envs)),
        }

    def reset(self, memory: ChannelMemory, env_ids: IndexArray, rngs: Sequence[np.random.Generator]) -> None:
        """Start anew in the environments `env_ids` (R,) of `memory`, with a key from a child of each of `rngs` (R,)."""
        env_ids = np.asarray(env_ids, np.intp)
        memory["key"][env_ids] = draw_keys(rngs)
        for name, start in (("round", -1), ("newest", -1), ("heard", False), ("lost", 0), ("sent", 0.0)):
            memory[name][..., env_ids] = start
        start_links(self.rules, memory["key"], env_ids, memory["bad"])

    def due(self, memory: ChannelMemory, t: FloatArray) -> NDArray[np.bool_]:
        """(B,) whether the next round of `memory` has come at the times `t` (B,), in s since reset."""
        return t >= (memory["round"] + (1.0 - 1e-9)) * self.network.period

    def measured(
        self, memory: ChannelMemory, x: FloatArray, out: FloatArray | None = None, part: Range | None = None
    ) -> FloatArray:
        """States `x` (n, B) as agents measure and send them in the next round of `memory`.

        Returns:
            `out` (n, B), new memory if it is left out; without noise `x` itself.
        """
        if self.network.noise == 0.0:
            return x
        out = np.empty(x.shape) if out is None else out
        add_noise(self.network.noise, memory["key"], memory["round"], x, out, *(part or self._all))
        return out

    def exchange(
        self,
        memory: ChannelMemory,
        values: FloatArray,
        up: NDArray[np.bool_] | None = None,
        due: NDArray[np.bool_] | None = None,
    ) -> None:
        """Run one round: everybody sends, and what is due arrives.

        Args:
            memory: of the channel; changed.
            values: (W, B) what agents send.
            up: as for `begin_round`.
            due: as for `begin_round`.

        Raises:
            ValueError: for an array of a wrong shape.
        """
        if np.shape(values) != memory["sent"].shape[1:]:
            raise ValueError(
                f"values (width, environments) have shape {np.shape(values)}; expected {memory['sent'].shape[1:]}"
            )
        self.begin_round(memory, up, due)
        self.send(memory, [values], due)

    def begin_round(
        self,
        memory: ChannelMemory,
        up: NDArray[np.bool_] | None = None,
        due: NDArray[np.bool_] | None = None,
        part: Range | None = None,
    ) -> None:
        """Decide what is lost of the messages of a new round, and what arrives now; `send` has to follow.

        Args:
            memory: of the channel; changed.
            up: (L, B) links that are up now; a message sent over one that is down is lost. None for all.
            due: (B,) environments in which there is a round now; in the others nothing happens. None for all.
            part: see the class.

        Raises:
            ValueError: for an array of a wrong shape.
        """
        up = self._array(up, self._all_up, "up (links, environments)")
        due = self._array(due, self._all_due, "due (environments,)")
        key, number, bad, lost = memory["key"], memory["round"], memory["bad"], memory["lost"]
        newest, heard = memory["newest"], memory["heard"]
        run_round(self.rules, key, number, due, up, bad, lost, newest, heard, *(part or self._all))

    def send(
        self,
        memory: ChannelMemory,
        parts: Sequence[FloatArray],
        due: NDArray[np.bool_] | None = None,
        part: Range | None = None,
    ) -> None:
        """Send the messages of the round that has begun.

        Args:
            memory: of the channel; changed.
            parts: rows of what all agents send, (rows, B) each, W rows in all.
            due: as for `begin_round`.
            part: see the class.
        """
        due = self._array(due, self._all_due, "due (environments,)")
        send(tuple(parts), 0, memory["round"], due, memory["sent"], *(part or self._all))

    def receive(
        self, memory: ChannelMemory, link: IndexArray, row: IndexArray, held: FloatArray, part: Range | None = None
    ) -> None:
        """Copy what is new since the round before; what nothing new came for keeps its last value.

        Args:
            memory: after `exchange`.
            link: (C,) over which each number comes.
            row: (C,) its place in `values`.
            held: (C, B) changed where a newer message came.
            part: see the class.
        """
        take_heard(memory["sent"], memory["newest"], memory["heard"], link, row, held, *(part or self._all))

    def age(self, memory: ChannelMemory) -> NDArray[np.int64]:
        """(L, B) rounds since the newest message that has arrived was sent, -1 where nothing has."""
        return np.where(memory["newest"] < 0, -1, memory["round"] - memory["newest"])

    def _array(self, given: NDArray[np.bool_] | None, default: NDArray[np.bool_], what: str) -> NDArray[np.bool_]:
        if given is None or given is default:
            return default
        if np.shape(given) != default.shape:
            raise ValueError(f"{what} has shape {np.shape(given)}; expected {default.shape}")
        return np.ascontiguousarray(given, np.bool_)
