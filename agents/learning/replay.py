"""The replay buffer of SAC as arrays of a checkpoint."""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import numpy as np
from stable_baselines3 import SAC
from stable_baselines3.common.buffers import ReplayBuffer

_ROWS = ("observations", "actions", "rewards", "dones", "timeouts")


def replay_state(model: SAC) -> dict[str, Any]:
    """What a model's buffer holds, as views where possible, and the generator of its first, random actions.

    A transition's next observation is the observation of the next transition, unless an episode ended or there is no
    next one yet: only these are in "ends" and "last", which halves the size.
    """
    buffer = _buffer(model)
    rows = {name: getattr(buffer, name)[: buffer.size()] for name in _ROWS}
    return {
        **rows,
        "ends": buffer.next_observations[: buffer.size()][rows["dones"] > 0.0],
        "last": buffer.next_observations[buffer.pos - 1],
        "pos": buffer.pos,
        "full": buffer.full,
        "generator": model.action_space.np_random,
    }


def restore_replay(model: SAC, stored: Mapping[str, Any]) -> None:
    """Fill the buffer of a new model with the same settings.

    Raises:
        ValueError: if `stored` doesn't fit.
    """
    buffer, pos, full = _buffer(model), stored["pos"], stored["full"]
    if type(pos) is not int or type(full) is not bool or not 0 <= pos < buffer.buffer_size:
        raise ValueError(f"the replay buffer can't be at {pos!r} of {buffer.buffer_size}, full: {full!r}")
    steps = buffer.buffer_size if full else pos
    for name in _ROWS:
        _fill(getattr(buffer, name)[:steps], stored[name], name)
    following = buffer.next_observations[:steps]
    if steps:
        following[:-1], following[-1] = buffer.observations[1:steps], buffer.observations[0]
        _fill(following[pos - 1], stored["last"], "last")
    ended = buffer.dones[:steps] > 0.0
    _fill(ends := following[ended], stored["ends"], "ends")
    following[ended] = ends
    buffer.pos, buffer.full = pos, full
    model.action_space.np_random.bit_generator.state = stored["generator"]["state"]


def _buffer(model: SAC) -> ReplayBuffer:
    assert isinstance(model.replay_buffer, ReplayBuffer)
    return model.replay_buffer


def _fill(target: np.ndarray, values: object, name: str) -> None:
    if not isinstance(values, np.ndarray) or (values.shape, values.dtype) != (target.shape, target.dtype):
        kind = f"{values.dtype} {values.shape}" if isinstance(values, np.ndarray) else type(values).__name__
        raise ValueError(f"{name} of the replay buffer is {kind}, not {target.dtype} {target.shape}")
    target[...] = values
