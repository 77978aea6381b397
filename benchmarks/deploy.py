"""Long runs of one process per agent: the period kept under load, a soak, and a fuzz of what nodes receive.

python -m benchmarks.deploy real_time     # 32 processes at 50 Hz for a minute, 30 % lost in bursts, three kills
python -m benchmarks.deploy soak          # 8 processes at 20 Hz for ten minutes; memory
python -m benchmarks.deploy fuzz          # 100 000 datagrams to each of 8 nodes
"""

from __future__ import annotations

import argparse
import json
import os
import resource
import struct
import subprocess
import sys
import tempfile
import time
import zlib
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np

from khop_env.deploy.envelope import Opener, seal
from khop_env.deploy.receiver import Receiver
from khop_env.deploy.transport import UdpTransport
from khop_env.network import Network
from khop_env.observers import FloatArray, Message, ObserverNode
from khop_env.registry import scenario
from khop_env.scenarios import Scenario

PERIOD = 0.05  # s, of the fuzz
_JUNK = 100  # datagrams a round
_STATE = 16  # place of the first state in a packed message
_RUN, _KEY = b"fuzz", b"k" * 32


def main() -> None:
    """Run one of the three."""
    parser = argparse.ArgumentParser(description=__doc__, formatter_class=argparse.RawDescriptionHelpFormatter)
    parser.add_argument("what", choices=("real_time", "soak", "fuzz"))
    parser.add_argument("--duration", type=float, help="seconds of real_time (60) and soak (600)")
    parser.add_argument("--agents", type=int, default=32, help="of real_time")
    parser.add_argument("--count", type=int, default=100_000, help="datagrams per node of fuzz")
    arguments = parser.parse_args()
    if arguments.what == "fuzz":
        chosen = scenario("paper")
        for agent in range(len(chosen.fleet)):
            print(json.dumps({"node": chosen.fleet.ids[agent], **fuzz(chosen, agent, arguments.count, seed=agent)}))
    elif arguments.what == "soak":
        duration = arguments.duration or 600.0
        deployed("paper", duration, ["--network", "lossy:loss=0.3,burst=5", "--estimator", "relay"])
    else:
        duration, agents = arguments.duration or 60.0, arguments.agents
        kills = [f"{agent}@{share * duration:g}:{(share + 0.1) * duration:g}" for agent, share in KILLS]
        options = ["--network", "ideal:period=0.02,loss=0.3,burst=5", "--estimator", "relay"]
        options += [word for kill in kills for word in ("--kill", kill)]
        deployed(f"random_geometric:agents={agents},k=2", duration, options)


KILLS = ((0, 0.2), (5, 0.4), (9, 0.6))  # agents, and when they are killed; all are back a tenth of the run later


def deployed(name: str, duration: float, options: list[str]) -> None:
    """Run `khop deploy`, and print what became of periods, bounds, messages, CPU time and memory."""
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "khop_env", "deploy", name, "--duration", f"{duration:g}", *options]
        out = str(Path(folder) / "run")
        print(f"khop deploy {' '.join(command[4:])}; {os.cpu_count()} cores, load {os.getloadavg()[0]:.1f}")
        run = subprocess.Popen([*command, "--out", out, "--json"], stdout=subprocess.PIPE, text=True)
        memory: list[tuple[float, float]] = []
        began = time.monotonic()
        while run.poll() is None and time.monotonic() - began < duration:
            time.sleep(1.0)
            if used := _memory_of_children(run.pid):
                memory.append((time.monotonic() - began, max(used)))
        printed, _ = run.communicate()
        summary = json.loads(printed)
    measured = summary["deploy"]
    measured.pop("agents")
    print(json.dumps(measured))
    print(
        f"violations {summary['violations']} of {summary['pair_samples']}; largest error over bound "
        f"{summary['max_error_to_bound']:.3f}; load at the end {os.getloadavg()[0]:.1f}"
    )
    third = max(1, len(memory) // 3)
    print(f"largest process: {memory[third][1]:.1f} MB after a third of the run, {memory[-1][1]:.1f} MB at its end")


def _memory_of_children(parent: int) -> list[float]:
    """MB that the children of a process have in memory."""
    found = []
    for entry in Path("/proc").iterdir():
        if not entry.name.isdecimal():
            continue
        try:
            if int((entry / "stat").read_text().rpartition(")")[2].split()[1]) == parent:
                pages = int((entry / "statm").read_text().split()[1])
                found.append(pages * resource.getpagesize() / 1e6)
        except OSError:
            continue
    return found


def fuzz(chosen: Scenario, agent: int, count: int, seed: int) -> dict[str, Any]:
    """Send a node `count` datagrams that are of no use between messages that are, over real sockets.

    Returns:
        junk: datagrams sent that should be refused, and refused, by kind.
        good: messages sent that should be taken, and taken.
        wrong: messages handed out that weren't sent, byte by byte.
        memory_mb: what the largest memory has grown by after the first tenth.
    """
    rng, design = np.random.default_rng(seed), chosen.design
    senders = sorted(design.links.senders[agent])
    sizes = {p: Message.size(design, p, "relay", "float64") for p in senders}
    receiver = Receiver(design, agent, Network(PERIOD), 0, Opener(design, sizes, _RUN, _KEY, PERIOD, 2))
    node = ObserverNode(design, agent, estimator="relay", period=PERIOD, radius=2.0)
    sockets = {p: UdpTransport() for p in (-1, *senders)}  # -1: a stranger
    own = UdpTransport()
    own.meet({p: sockets[p].port for p in senders})
    for each in sockets.values():
        each.meet({agent: own.port})
    own_state, own_input = np.zeros(chosen.fleet.models[agent].n), np.zeros(chosen.fleet.models[agent].m)
    junk = good = wrong = number = 0
    early = 0
    while junk < count:
        node.update(number * PERIOD, own_state, own_input)
        sent = {p: _packed(chosen, p, number, rng) for p in senders}
        datagrams = [(p, seal(data, _RUN, _KEY)) for p, data in sent.items()]
        for _ in range(_JUNK):
            p = int(rng.choice(senders))
            datagrams.append(_bent(rng, chosen, p, number, sent[p]))
        for place in rng.permutation(len(datagrams)):
            p, data = datagrams[place]
            sockets[p].send(data, agent)
        receiver.take(own.receive(), number)
        for message in receiver.on_time(number):
            wrong += message.pack() != sent[message.sender]
            node.receive(message)
        if not all(np.isfinite(each.estimate).all() for each in node.estimates(number * PERIOD).values()):
            raise AssertionError(f"round {number}: an estimate isn't finite")
        good, junk, number = good + len(sent), junk + _JUNK, number + 1
        if junk <= 0.1 * count:
            early = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss
    for each in (own, *sockets.values()):
        each.close()
    grown = resource.getrusage(resource.RUSAGE_SELF).ru_maxrss - early
    refused = dict(receiver.opener.refused)
    return {
        "junk": [junk, sum(refused.values())],
        "good": [good, receiver.received],
        "wrong": wrong,
        "refused": refused,
        "memory_mb": round(grown / 1024.0, 1),
    }


def _packed(chosen: Scenario, sender: int, number: int, rng: np.random.Generator) -> bytes:
    state: FloatArray = rng.uniform(-1.0, 1.0, chosen.fleet.models[sender].n)
    return Message(chosen.design, sender, number * PERIOD, state, {}).pack()


def _bent(rng: np.random.Generator, chosen: Scenario, p: int, number: int, data: bytes) -> tuple[int, bytes]:
    """(socket, datagram) that must not be taken in round `number`; `data` is the packed message of `p`."""
    sealed = seal(data, _RUN, _KEY)

    def flipped() -> bytes:
        found = bytearray(sealed)
        for _ in range(int(rng.integers(1, 6))):
            found[int(rng.integers(len(found)))] ^= 1 << int(rng.integers(8))
        return bytes(found) if bytes(found) != sealed else sealed[:-1]

    def renumbered(place: int, value: float) -> bytes:
        body = data[:place] + struct.pack("<d", value) + data[place + 8 : -4]
        return seal(body + struct.pack("<I", zlib.crc32(body)), _RUN, _KEY)

    makers: list[Callable[[], tuple[int, bytes]]] = [
        lambda: (p, rng.bytes(int(rng.integers(0, 400)))),
        lambda: (p, sealed[: int(rng.integers(len(sealed)))]),
        lambda: (p, sealed + rng.bytes(int(rng.integers(1, 400)))),
        lambda: (p, flipped()),
        lambda: (-1, sealed),
        lambda: (p, seal(data, b"last", _KEY)),
        lambda: (p, seal(data, _RUN, rng.bytes(32))),
        lambda: (p, seal(_packed(chosen, p, number + int(rng.integers(3, 10_000)), rng), _RUN, _KEY)),
        lambda: (p, renumbered(_STATE, float(rng.choice([np.nan, np.inf, -np.inf])))),
        lambda: (p, renumbered(8, float(rng.choice([np.nan, np.inf, -np.inf, -1.0, 1e300])))),
    ]
    if number:  # a round that has come before
        earlier = max(0, number - int(rng.integers(1, 200)))
        makers.append(lambda: (p, seal(_packed(chosen, p, earlier, rng), _RUN, _KEY)))
    return makers[int(rng.integers(len(makers)))]()


if __name__ == "__main__":
    main()
