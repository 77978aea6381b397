"""Growth of time and memory per pair (observer, target) with the number of agents of `random_geometric`.

Each is measured of the simulator alone, of the environment with its observations, and of that under `wifi`.
"""

from __future__ import annotations

import gc
import subprocess
import sys
import time
import types
from collections.abc import Callable, Iterable
from pathlib import Path
from typing import Any, NamedTuple

import numpy as np

from agents import make_law
from khop_env import consensus_v0
from khop_env.env import BatchedEnv
from khop_env.observers import Proximal
from khop_env.scenarios import Scenario, random_geometric
from khop_env.simulation import Simulator

DT = 0.01  # s, of the simulator alone
LONGEST = 20.0  # s, of making the largest environment
ROOT = Path(__file__).resolve().parents[1]


class _Kind(NamedTuple):
    """What is measured: beginning of its rows' names, how it is made and stepped, and whether `LONGEST` is for it."""

    prefix: str
    make: Callable[[Scenario], Any]
    step: Callable[[Any], object]
    timed: bool = True


def _simulator(scenario: Scenario) -> Simulator:
    return scenario.build(law=make_law(scenario.law), observers=Proximal(2))


def _simulator_in(subject: Simulator | BatchedEnv) -> Simulator:
    return subject if isinstance(subject, Simulator) else subject.simulator


def _step(env: BatchedEnv) -> object:
    if env.over.any():
        env.reset(seed=0)
    return env.step(np.zeros((1, len(env.agents), int(env.action_offset[1]))))


KINDS = (
    _Kind("", _simulator, lambda simulator: simulator.step(DT), timed=False),
    _Kind("environment_", lambda scenario: consensus_v0.batched_env(scenario, num_envs=1), _step),
    _Kind("wifi_", lambda scenario: consensus_v0.batched_env(scenario, num_envs=1, network="wifi"), _step),
)


def growth_rows(add: Callable[..., None], quick: bool, say: Callable[[str], None]) -> None:
    """Add the rows of all kinds; sizes alternate, and times are the best of several."""
    sizes = (100, 1000) if quick else (100, 1000, 10_000)
    for kind in KINDS:
        say(f"growth: {kind.prefix.rstrip('_') or 'simulator'} of {', '.join(map(str, sizes))} agents")
        _growth_of(kind, sizes, add, rounds=3 if quick else 15)
    say(f"memory of a process with {sizes[-1]} agents")
    script = f"from benchmarks.growth import peak_memory; print(peak_memory({sizes[-1]}))"
    done = subprocess.run([sys.executable, "-c", script], cwd=ROOT, capture_output=True, text=True, check=True)
    add(f"peak_{sizes[-1]}", float(done.stdout.split()[-1]) / 2**20, "MiB", most=1024.0)


def _growth_of(kind: _Kind, sizes: tuple[int, ...], add: Callable[..., None], rounds: int) -> None:
    small = random_geometric(agents=30)
    compiled = kind.make(small)  # and all that every environment shares
    _simulator_in(compiled).warm_up(long=True)
    kind.step(compiled)
    made, pairs, held, making = [], [], [], 0.0
    for agents in sizes:
        start = time.perf_counter()
        scenario = random_geometric(agents=agents, k=2, seed=0)
        subject = kind.make(scenario)
        making = time.perf_counter() - start
        results = kind.step(subject)
        pairs.append(_simulator_in(subject).observers.layout.pairs)
        held.append(held_memory([subject, results], besides=[scenario, small, compiled]))
        made.append(subject)
    seconds = np.full(len(sizes), np.inf)
    for _ in range(rounds):
        for index, (agents, subject) in enumerate(zip(sizes, made, strict=True)):
            steps = max(2, 10_000 // agents)
            start = time.perf_counter()
            for _ in range(steps):
                kind.step(subject)
            seconds[index] = min(seconds[index], (time.perf_counter() - start) / steps)
    for index, agents in enumerate(sizes):
        add(f"{kind.prefix}step_{agents}", seconds[index] / pairs[index] * 1e9, "ns per pair and step")
        add(f"{kind.prefix}memory_{agents}", held[index] / pairs[index], "bytes per pair")
    for name, values in (("time", seconds), ("memory", held)):
        per_pair = np.array(values) / pairs
        add(f"{kind.prefix}growth_{name}", per_pair.max() / per_pair.min(), most=1.5)
    if kind.timed:
        add(f"{kind.prefix}making_{sizes[-1]}", making, "s", most=LONGEST)


_PROGRAM = types.ModuleType, type, types.FunctionType
"""Types of objects that belong to the program, through which everything is reached."""


def held_memory(roots: Iterable[object], besides: Iterable[object]) -> int:
    """Bytes of all objects that `roots` lead to, arrays included, without those that `besides` lead to.

    Modules, classes and functions aren't followed.
    """
    seen = {id(each): each for each in _reached(besides, {})}
    return sum(sys.getsizeof(each) for each in _reached(roots, seen))


def _reached(roots: Iterable[object], seen: dict[int, object]) -> Iterable[object]:
    """The objects that `roots` lead to and that aren't `seen`; they are seen then."""
    waiting = list(roots)
    while waiting:
        each = waiting.pop()
        if id(each) in seen or issubclass(type(each), _PROGRAM):  # isinstance would ask proxies what they stand for
            continue
        seen[id(each)] = each
        yield each
        if isinstance(each, np.ndarray):
            waiting.append(each.base)  # which the collector doesn't list
            if each.dtype != object:
                continue
        waiting.extend(gc.get_referents(each))


def peak_memory(agents: int) -> int:
    """Peak memory in bytes of this whole process, Python and graph included, once `random_geometric` has stepped."""
    simulator = _simulator(random_geometric(agents=agents, k=2, seed=0))
    for _ in range(3):
        simulator.step(DT)
    status = Path("/proc/self/status")  # Linux, where the other way reports a larger parent's memory, too
    if status.exists():
        return next(int(line.split()[1]) for line in status.read_text().splitlines() if line.startswith("VmHWM")) * 1024
    import resource

    return resource.getrusage(resource.RUSAGE_SELF).ru_maxrss * (1 if sys.platform == "darwin" else 1024)
