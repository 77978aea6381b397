"""Check that no agent's observation depends on information that it has no access to."""

from __future__ import annotations

import copy
from collections.abc import Callable
from dataclasses import replace
from typing import Any

import networkx as nx
import numpy as np
from numpy.typing import NDArray

from khop_env.env import EnvState, KHopEnv
from khop_env.observers import IntArray, Networked, PairLayout
from khop_env.simulation.received import links_up
from khop_env.testing.equality import difference
from khop_env.testing.subject import Fault, Subject, called, play
from khop_env.testing.views import copies

_VISIBLE = ("t", "x", "estimate")  # the parts of the simulator's state that observations may depend on
_OF_PAIRS = (
    "bound",
    "stamp",
    "hops",
    "arrived",
    "data",
)  # and under a network what an agent knows of its own estimates
_LOSS = 0.5  # of messages, so that about half of an agent's neighbours don't get its next one


def leak(subject: Subject) -> str | None:
    """Observations depend on accessible information only."""
    env = subject.own()
    for number, step in enumerate(play(env, 4, subject.seed, reset_seed=subject.seed)):
        for agent, observation in step["observations"].items():
            if found := difference(observation, env.observe(agent), f"observations[{agent!r}]"):
                raise Fault(f"{called(number, step)} and observe() differ: {found}")
    settings, design = env.batched.settings, env.batched.simulator.design
    fleet, observers, mode = env.batched.fleet, env.batched.simulator.observers, settings.observe
    hops = dict(nx.all_pairs_shortest_path_length(design.communication))
    by_links = design.schedule is not None and not observers.by_messages  # which come and go
    direct = 0 if observers.by_messages else 1
    reach = design.k if mode == "oracle" else direct
    for j, agent in enumerate(fleet.ids):
        near = {i for i in range(len(fleet)) if hops[j].get(i, np.inf) <= reach}
        move = _edit(lambda state: state.simulator.x, fleet.state_slice(j))
        if by_links and mode != "oracle":
            near = {j, *_receivers(env, move, j)}
        _require(env, near, f"the true state of {agent!r}", move, bounds=not by_links)
        edit = _edit(lambda state: state.inputs, fleet.input_slice(j))
        _require(env, {j}, f"the input in force of {agent!r}", edit)
        made = _rows_of(observers.layout, j)
        seen_by = set() if mode == "oracle" or (mode == "local" and not observers.by_messages) else {j}
        _require(env, seen_by, f"an estimate that {agent!r} makes", _edit(_array("estimate"), made[0]))
        for name in _OF_PAIRS if observers.by_messages else ():
            rows = made[0] if name == "bound" else made[1]
            if name == "data":
                size = settings.message_size
                rows = (rows[:, None] * size + np.arange(size)).ravel()
            edit = _edit(_array(name), rows)
            _require(env, {j}, f"{agent!r}'s {name}", edit)
    for name in env.get_state().simulator.arrays():
        edit = _edit(_array(name), ...)
        if by_links and name == "key":
            cut = set() if mode == "oracle" else _receivers(env, edit, None)
            _require(env, cut, "the draw of links to other agents", edit, bounds=False)
        elif name not in (*_VISIBLE, *(_OF_PAIRS if observers.by_messages else ())):
            _require(env, set(), f"the simulator's {name}", edit)
    if isinstance(observers, Networked) and mode != "oracle":
        _lost_messages(env, observers, subject.seed)
    if by_links and settings.bounds:
        return "but for guaranteed bounds, which follow from all links that are up: agents can't know them"
    return None


def _receivers(env: KHopEnv, write: Callable[[EnvState], None], sender: int | None) -> set[int]:
    """Receivers of the links from an agent that are up before or after an edit; None: of links that it changes."""
    simulator, saved, edited = env.batched.simulator, env.get_state(), env.get_state()
    write(edited)
    up = []
    for state in (edited, saved):
        env.set_state(state)
        up.append(links_up(simulator.design, simulator.observers, simulator.state)[:, 0].copy())
    links = simulator.design.links
    concerned = up[0] != up[1] if sender is None else (up[0] | up[1]) & (links.sender == sender)
    return set(links.receiver[concerned].tolist())


def _rows_of(layout: PairLayout, observer: int) -> tuple[IntArray, IntArray]:
    """Rows of the estimates that an agent makes, and its pairs."""
    pairs = np.flatnonzero(layout.observer == observer)
    return np.flatnonzero(np.isin(layout.column_pair, pairs)), pairs


def _lost_messages(env: KHopEnv, observers: Networked, seed: int) -> None:
    """Check that a state that is different for one control period changes observations of those who heard of it only.

    In an environment with many losses, and without disturbances, which may couple agents; what an agent sends gets one
    hop further a round at most.
    """
    lossy = copy.copy(observers)
    lossy.network = replace(observers.network, loss=_LOSS, burst=None)
    env = KHopEnv(copies(env, 1, observers=lossy, disturbance=None), name="")
    for _ in play(env, 4, seed, reset_seed=seed):
        pass
    if not env.agents:
        env.reset()
    fleet, links, saved = env.batched.fleet, env.batched.simulator.design.links, env.get_state()
    actions = {agent: np.zeros(env.action_space(agent).shape, np.float32) for agent in env.agents}

    def after(state: EnvState) -> tuple[dict[str, Any], NDArray[np.bool_], int]:
        """The next observations, over which links something has arrived by then, and the rounds in between."""
        env.set_state(state)
        observations = env.step(actions)[0]
        memory = env.get_state().simulator.memory
        first, last = int(state.simulator.memory["channel.round"][0]), int(memory["channel.round"][0])
        return observations, memory["channel.newest"][:, 0] > first, last - first

    expected, arrived, rounds = after(saved)
    for j, agent in enumerate(fleet.ids):
        edited = copy.deepcopy(saved)
        edited.simulator.x[fleet.state_slice(j)] += 0.1
        found, arrived_now, _ = after(edited)
        over = np.flatnonzero(arrived | arrived_now)  # whether links are up may depend on where agents are
        reached = {j}
        for _ in range(rounds):
            reached |= {int(links.receiver[link]) for link in over if int(links.sender[link]) in reached}
        for other, observation in found.items():
            if fleet.agent(other) not in reached and (text := difference(expected[other], observation, "entry")):
                raise Fault(
                    f"the true state of {agent!r} changes the next observation of {other!r}, although no message of "
                    f"it has arrived: {text}"
                )


def _array(name: str) -> Callable[[EnvState], Any]:
    return lambda state: state.simulator.arrays()[name]


def _other(values: NDArray[Any]) -> NDArray[Any]:
    """Values that differ everywhere, far from all estimates."""
    if values.dtype.kind == "f":
        return values + 0.7 + 0.1 * np.arange(values.size).reshape(values.shape)
    return ~values if values.dtype.kind == "b" else values + values.dtype.type(1)


def _edit(read: Callable[[EnvState], Any], part: Any) -> Callable[[EnvState], None]:
    """An edit of a part of an array of the saved state."""

    def write(state: EnvState) -> None:
        array = read(state)
        array[part] = _other(array[part])

    return write


def changed_by(env: KHopEnv, write: Callable[[EnvState], None], bounds: bool = True) -> dict[int, int]:
    """Agents whose observation changes if the environment's state is edited.

    Args:
        env: an environment in mid-episode; its state is restored.
        write: edits the state returned by `get_state`.
        bounds: whether guaranteed bounds in slots count.

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
        bits = observation.view(np.uint32) != after[agent].view(np.uint32)
        if not bounds:
            bits[[column for column, name in enumerate(env.layout(agent).names) if ".bound." in name]] = False
        if bits.any():
            changed[fleet.agent(agent)] = int(np.flatnonzero(bits)[0])
    return changed


def _require(
    env: KHopEnv, allowed: set[int], text: str, write: Callable[[EnvState], None], bounds: bool = True
) -> None:
    """Check that an edit of the saved state changes observations of allowed agents only."""
    ids = env.batched.fleet.ids
    for i, column in changed_by(env, write, bounds).items():
        if i not in allowed:
            names = env.layout(ids[i]).names
            column_name = names[column] if column < len(names) else "beyond its layout"
            known = f"only {', '.join(ids[j] for j in sorted(allowed))}" if allowed else "nobody"
            raise Fault(
                f"{text} changes the observation of {ids[i]!r}, entry {column} ({column_name}); {known} may see it"
            )
