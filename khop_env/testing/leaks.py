"""Check that no agent's observation depends on information that it has no access to."""

from __future__ import annotations

from collections.abc import Callable, Iterable
from typing import Any

import networkx as nx
import numpy as np

from khop_env.env import EnvState, KHopEnv
from khop_env.testing.equality import difference
from khop_env.testing.subject import Fault, Subject, called, play

_VISIBLE = ("t", "x", "estimate")  # the parts of the simulator's state that observations may depend on


def leak(subject: Subject) -> None:
    """Observations depend on accessible information only."""
    env = subject.own()
    for number, step in enumerate(play(env, 4, subject.seed, reset_seed=subject.seed)):
        for agent, observation in step["observations"].items():
            if found := difference(observation, env.observe(agent), f"observations[{agent!r}]"):
                raise Fault(f"{called(number, step)} and observe() differ: {found}")
    fleet, design, mode = env.batched.fleet, env.batched.simulator.design, env.batched.settings.observe
    hops = dict(nx.all_pairs_shortest_path_length(design.communication))
    reach = design.k if mode == "oracle" else 1
    for j, agent in enumerate(fleet.ids):
        near = {i for i in range(len(fleet)) if hops[j].get(i, np.inf) <= reach}
        _require(env, near, f"the true state of {agent!r}", lambda state: state.simulator.x, [fleet.state_slice(j)])
        _require(env, {j}, f"the input in force of {agent!r}", lambda state: state.inputs, [fleet.input_slice(j)])
        made = [
            slice(start, start + fleet.models[target].n)
            for (observer, target), start in design.states.layout.slot.items()
            if observer == j
        ]
        seen_by = {j} if mode == "estimate" else set()
        _require(env, seen_by, f"an estimate that {agent!r} makes", _array("estimate"), made)
    for name in env.get_state().simulator.arrays():
        if name not in _VISIBLE:
            _require(env, set(), f"the simulator's {name}", _array(name), [...])


def _array(name: str) -> Callable[[EnvState], Any]:
    return lambda state: state.simulator.arrays()[name]


def changed_by(env: KHopEnv, write: Callable[[EnvState], None]) -> dict[int, int]:
    """Agents whose observation changes if the environment's state is edited.

    Args:
        env: an environment in mid-episode; its state is restored.
        write: edits the state returned by `get_state`.

    Returns:
        The first changed column, by the agent's index in the fleet.
    """
    saved, fleet = env.get_state(), env.batched.fleet
    before = {agent: env.observe(agent) for agent in env.possible_agents}
    edited = env.get_state()
    write(edited)
    env.set_state(edited)
    after = {agent: env.observe(agent) for agent in env.possible_agents}
    env.set_state(saved)
    changed = {}
    for agent, observation in before.items():
        if observation.tobytes() != after[agent].tobytes():
            bits = observation.view(np.uint32) != after[agent].view(np.uint32)
            changed[fleet.agent(agent)] = int(np.flatnonzero(bits)[0])
    return changed


def _require(env: KHopEnv, allowed: set[int], text: str, read: Callable[[EnvState], Any], parts: Iterable[Any]) -> None:
    """Check that edits in parts of an array of the saved state change observations of allowed agents only."""

    def write(state: EnvState) -> None:
        for part in parts:
            array = read(state)[part]
            change = 0.7 + 0.1 * np.arange(array.size).reshape(array.shape)  # far from all estimates
            array += change if array.dtype.kind == "f" else (10.0 * change).astype(array.dtype)

    ids = env.batched.fleet.ids
    for i, column in changed_by(env, write).items():
        if i not in allowed:
            names = env.layout(ids[i]).names
            column_name = names[column] if column < len(names) else "beyond its layout"
            known = ", ".join(ids[j] for j in sorted(allowed)) or "none"
            raise Fault(
                f"{text} changes the observation of {ids[i]!r}, entry {column} ({column_name}); allowed: {known}"
            )
