"""Real processes that keep time: killed, restarted, frozen, and none of them left behind."""

import json
import os
import signal
import subprocess
import sys
import time
from pathlib import Path
from types import SimpleNamespace

import numpy as np
import pytest

from khop_env.commands.deploying import collected_of, setups_of, simulated_part
from khop_env.deploy.supervisor import Kill, Supervisor
from khop_env.network import Network
from khop_env.registry import scenario
from tests.deploy.running import simulator_of

NAME = "random_geometric:agents=4,k=2"
ROOT = Path(__file__).parents[2]
pytestmark = pytest.mark.skipif(not Path("/proc/self").exists(), reason="looks for processes in /proc")


def test_killed_restarted_and_frozen(tmp_path):
    """In real time: no bound is false, and who was away is back."""
    chosen, network = scenario(NAME), Network(0.05, loss=0.2)
    simulator = simulator_of(chosen, network, "relay", 0)
    episode = SimpleNamespace(simulator=simulator, observers=simulator.observers)
    common = simulated_part(NAME, chosen, episode, chosen.law, 1, 80)
    setups = setups_of(chosen, common, seed=0, skew=0.0, transport="udp", records=tmp_path)
    seen = []

    def watch(fraction, supervisor):
        seen.append([process.popen.pid for process in supervisor.processes])
        frozen = supervisor.processes[2].popen
        if 0.3 < fraction < 0.5:
            os.kill(frozen.pid, signal.SIGSTOP)
        elif fraction >= 0.5 and frozen.poll() is None:
            os.kill(frozen.pid, signal.SIGCONT)

    supervisor = Supervisor(chosen, setups, kills=(Kill(3, 0.5, 0.6), Kill(1, 2.0)), watch=watch)
    supervisor.run()
    assert supervisor.errors == []
    assert not any(Path(f"/proc/{pid}").exists() for pids in seen for pid in pids)
    over = simulator.observers
    collected, found = collected_of(supervisor, chosen, over, setups, lockstep=False)
    assert collected.violations == 0
    assert collected.pair_steps == 81 * chosen.design.knowledge.pairs
    away = [each.away for each in collected.rounds]
    assert not away[0].any()
    assert not away[2].any()
    assert 0 < away[3].sum() < 80
    assert away[1].sum() >= 38
    assert found["agents"]["integrator_2"]["missed"] > 5
    assert found["messages"]["refused"] == {}
    assert found["messages"]["lost"] > 0
    states = collected.recording.states
    mine = np.flatnonzero(states.layout.observer == 0)
    assert (states.age[-1][mine[states.layout.pair_target[mine] != 1]] < 1.5).all()


def agents_in(folder: Path) -> set[int]:
    """The processes of agents that were started in a folder."""
    found = set()
    for entry in Path("/proc").iterdir():
        if entry.name.isdecimal():
            try:
                command = (entry / "cmdline").read_bytes()
                state = (entry / "stat").read_text().rpartition(")")[2].split()[0]
                if b"khop_env.deploy.agent" in command and state != "Z" and (entry / "cwd").resolve() == folder:
                    found.add(int(entry.name))
            except OSError:
                continue
    return found


@pytest.mark.parametrize("how", [signal.SIGINT, signal.SIGKILL])
def test_no_process_is_left_behind(how, tmp_path):
    """After Ctrl-C results up to then are written; nothing can be when the supervisor itself is killed."""
    options = ("--duration", "60", "--network", "ideal:period=0.05", "--out", "run", "--json")
    command = subprocess.Popen(
        [sys.executable, "-m", "khop_env", "deploy", NAME, *options],
        cwd=tmp_path,
        env={**os.environ, "PYTHONPATH": str(ROOT)},
        stdout=subprocess.PIPE,
        stderr=subprocess.DEVNULL,
    )
    until = time.monotonic() + 100.0
    while len([path for path in tmp_path.glob("run/records-*/*.known") if path.stat().st_size]) < 4:
        assert time.monotonic() < until
        time.sleep(0.05)
    assert len(agents_in(tmp_path)) == 4
    command.send_signal(how)
    until = time.monotonic() + 10.0
    while left := agents_in(tmp_path):
        assert time.monotonic() < until, left
        time.sleep(0.05)
    out, _ = command.communicate(timeout=60)
    if how == signal.SIGINT:
        assert command.returncode == 130
        summary = json.loads(out)
        assert summary["error"] == "ended by Ctrl-C"
        assert summary["violations"] == 0
        assert (tmp_path / "run" / "estimates.parquet").exists()
    else:
        assert command.returncode == -signal.SIGKILL
