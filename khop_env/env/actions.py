"""From actions to commanded inputs: the agents' entries in a flat action, checks and clipping."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np
from numpy.typing import ArrayLike

from khop_env.compiled import compiled
from khop_env.observers import FloatArray, IntArray
from khop_env.physics import Fleet

_TILE = 32  # environments whose actions are read together


class ActionReader:
    """Reads the actions of all acting agents, side by side.

    Args:
        fleet: all agents.
        members: indices of those that act.
        uniform: whether all have as many entries, padded.
        num_envs: number of environments B.
        message_size: entries at the end of each agent's action that are data for its messages.

    Attributes:
        offset: (N + 1,) where each agent's entries begin in the flat action.
        shapes: that actions may have, the usual one first.

    Raises:
        ValueError: for an acting agent whose inputs have no limit.
    """

    def __init__(
        self, fleet: Fleet, members: Sequence[int], uniform: bool, num_envs: int, message_size: int = 0
    ) -> None:
        self._agents, self._num_envs = [fleet.ids[i] for i in members], num_envs
        models = [fleet.models[i] for i in members]
        unlimited = [
            name for name, model in zip(self._agents, models, strict=True) if not np.isfinite(model.input_limit).all()
        ]
        if unlimited:
            raise ValueError(
                f"actions are fractions of the input limits, and {', '.join(unlimited[:4])} "
                + ("has none: give its model" if len(unlimited) == 1 else "have none: give their models")
                + " an input_limit"
            )
        sizes = np.array([model.m for model in models])
        entries = (np.full(len(sizes), sizes.max()) if uniform else sizes) + message_size
        self.offset: IntArray = np.concatenate([[0], np.cumsum(entries)])
        parts = [(number, c) for number, size in enumerate(sizes) for c in range(size)]
        first = fleet.input_offset[list(members)]
        words = [(number, c) for number in range(len(sizes)) for c in range(message_size)]
        self._owner = np.array([number for number, _ in (*parts, *words)], np.int64)
        self._entry = np.array(
            [self.offset[number] + c for number, c in parts]
            + [self.offset[number + 1] - message_size + c for number, c in words],
            np.int64,
        )
        self._column = np.array([first[number] + c for number, c in parts], np.int64)
        self._said = np.array([members[number] * message_size + c for number, c in words], np.int64)
        width = int(self.offset[-1])
        flat: list[tuple[int, ...]] = [(num_envs, width)]
        self.shapes = [(num_envs, len(members), width // len(members)), *flat] if uniform else flat

    def read(self, actions: ArrayLike, command: FloatArray, said: FloatArray) -> IntArray:
        """Write actions into `command` (m, B) as fractions of the limits, clipped to [-1, 1], and data into `said`.

        Args:
            actions: (B, N, m) or (B, A).
            command: (m, B) overwritten in the rows of acting agents; unchanged if this raises.
            said: (agents of the fleet * message_size, B) likewise; clipped to [-1, 1].

        Returns:
            (B, N) number of clipped entries of each agent's action.

        Raises:
            ValueError: for actions of a wrong shape or not finite.
        """
        array = np.asarray(actions)
        if array.shape not in self.shapes or array.dtype.kind not in "fiu":
            raise ValueError(
                f"actions must be numbers of shape {self.shapes[0]}; got {array.dtype} of shape {array.shape}"
            )
        flat = np.ascontiguousarray(array.reshape(self._num_envs, -1), np.float64)
        clipped = np.zeros((self._num_envs, len(self._agents)), np.int64)
        bad = read_actions(flat, self._entry, self._column, self._said, self._owner, command, said, clipped)
        if bad >= 0:
            env, number = divmod(bad, len(self._entry))
            owner = self._owner[number]
            where = f" in environment {env}" if self._num_envs > 1 else ""
            raise ValueError(
                f"the action of {self._agents[owner]!r}{where} isn't finite: entry "
                f"{self._entry[number] - self.offset[owner]} is {flat[env, self._entry[number]]}"
            )
        return clipped


@compiled
def read_actions(
    actions: FloatArray,
    entry: IntArray,
    column: IntArray,
    row: IntArray,
    owner: IntArray,
    command: FloatArray,
    said: FloatArray,
    clipped: IntArray,
) -> int:
    """Clip actions to [-1, 1] and write them into `command` (m, B) and `said`; count the clipped entries.

    Args:
        actions: (B, A) all agents' actions of each environment, side by side.
        entry: (C + D,) which entry of an environment's actions is read.
        column: (C,) the inputs that the first C become.
        row: (D,) the rows of `said` that the others become.
        owner: (C + D,) number of the agent that it belongs to.
        command: (m, B) overwritten at `column`.
        said: (S, B) overwritten at `row`.
        clipped: (B, N) added to.

    Returns:
        -1, or environment * C + index in `entry` of the first action that isn't finite; nothing is written then.
    """
    for env in range(actions.shape[0]):
        for q in range(entry.size):
            if not np.isfinite(actions[env, entry[q]]):
                return env * entry.size + q
    for first in range(0, actions.shape[0], _TILE):
        last = min(first + _TILE, actions.shape[0])
        for q in range(entry.size):
            for env in range(first, last):
                value = actions[env, entry[q]]
                inside = min(max(value, -1.0), 1.0)
                clipped[env, owner[q]] += inside != value
                if q < column.size:
                    command[column[q], env] = inside
                else:
                    said[row[q - column.size], env] = inside
    return -1
