"""Observers in robots' own loops: replay a run through one node per robot, over links that lose and delay messages.

Takes the folder of a `khop run`; without one it makes a short run itself.
"""

import json
import subprocess
import sys
import tempfile
from pathlib import Path

import numpy as np
import polars as pl

from khop_env.network import Network, PlainLink
from khop_env.observers import Message, ObserverNode
from khop_env.registry import scenario

PERIOD = 0.05  # s


def replay(folder):
    """Play a recorded run through the nodes of its robots, and print what one of them knows."""
    run = scenario(json.loads((folder / "summary.json").read_text())["scenario"])
    design, fleet = run.design, run.design.fleet
    table = pl.read_parquet(folder / "states.parquet")
    time = table["time"].unique().sort().to_numpy()
    x, u = (table[column].drop_nulls().to_numpy().reshape(len(time), -1) for column in "xu")

    # What a certified bound rests on: where agents start, and how much they may be disturbed, here also by the errors
    # of the simulator's step. Messages are in float16; that rounding is a part of the bound, up to the largest |x|.
    disturbance = 0.2 + (0.0 if run.disturbance is None else run.disturbance.attach(fleet).bound)
    known = {"center": run.initial.center, "radius": run.initial.radius, "disturbance": disturbance}
    sent = {"dtype": "float16", "largest": np.abs(x).max()}
    nodes = [ObserverNode(design, robot, estimator="relay", period=PERIOD, **known, **sent) for robot in fleet.ids]

    network = Network(PERIOD, loss=0.3, burst=3, latency=0.04)
    links = {ends: PlainLink(network, key=0, number=number) for ends, number in design.links.index.items()}
    newest = dict.fromkeys(links, -1)
    air = []  # what was sent, round by round

    watched = max(nodes, key=lambda node: len(node.targets))
    print(f"{run.name}: {watched.id} hears {', '.join(watched.hears)}; {network.described()}")
    print("    t (s)  target        error (m)  certified (m)  age (s)")
    outside = checked = 0
    for number, t in enumerate(np.arange(0.0, time[-1] + 1e-9, PERIOD).round(9).tolist()):
        sample = time.searchsorted(t - 1e-9)

        # Every robot's own loop: update, send, receive, use.
        for robot, node in enumerate(nodes):
            node.update(t, x[sample, fleet.state_slice(robot)], u[sample, fleet.input_slice(robot)])
        air.append([node.message().pack() for node in nodes])
        for (sender, robot), link in links.items():
            if link.advance() > newest[sender, robot]:
                newest[sender, robot] = link.newest
                nodes[robot].receive(Message.unpack(air[link.newest][sender], design))

        for node in nodes:
            for target, (estimate, bound, age, *_) in node.estimates(t).items():
                error = np.abs(estimate - x[sample, fleet.state_slice(fleet.agent(target))])
                checked, outside = checked + 1, outside + (error > bound).any()
                if node is watched and number in (3, 10, 40):
                    since = f"{age:7.2f}" if np.isfinite(age) else "nothing yet"
                    place = fleet.models[fleet.agent(target)].position_index
                    worst = error[place].max(), bound[place].max()
                    print(f"  {t:7.2f}  {target:12s}  {worst[0]:9.4f}  {worst[1]:13.4f}  {since}")

    print(f"errors beyond the certified bound: {outside} of {checked}")
    for estimator in ("relay", "ppso"):
        sizes = [Message.size(design, watched.id, estimator, dtype) for dtype in ("float16", "float32", "float64")]
        print(f"a message of {watched.id}, {estimator:5s}: {' / '.join(map(str, sizes))} bytes in float16 / 32 / 64")


if len(sys.argv) > 1:
    recorded = Path(sys.argv[1])
    missing = [name for name in ("summary.json", "states.parquet") if not (recorded / name).is_file()]
    if missing:
        sys.exit(f"{recorded} isn't the folder of a khop run: it has no {' and no '.join(missing)}")
    replay(recorded)
else:
    with tempfile.TemporaryDirectory() as folder:
        command = [sys.executable, "-m", "khop_env", "run", "paper", "--duration", "4", "--out", folder]
        subprocess.run(command, check=True, capture_output=True)
        replay(Path(folder))
