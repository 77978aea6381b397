"""Ratios to other libraries, each in a virtual environment of its own."""

from __future__ import annotations

import json
import os
import statistics
import subprocess
from collections.abc import Callable
from pathlib import Path

from benchmarks.report import Report, reason

SCRIPTS = Path(__file__).parent / "peers"
NAMES = ("mpe2", "vmas", "jaxmarl")  # of the virtual environments


def left_out(peers: Path | None) -> list[str]:
    """Peers that aren't installed, one line per peer.

    Args:
        peers: folder with one virtual environment per peer; None for no ratios.

    Raises:
        ValueError: if no peer is installed.
    """
    if peers is None:
        return []
    missing = [peer for peer in NAMES if not _python(peers, peer).exists()]
    if len(missing) == len(NAMES):
        raise ValueError(
            f"--peers {peers}: expected virtual environments named {', '.join(NAMES)} in it, as created "
            "by `make bench PEERS=1` in .peers; found none"
        )
    return [f"ratios to {peer} ({_not_installed(peers, peer)})" for peer in missing]


def compare(
    report: Report,
    name: str,
    unit: str,
    ours: Callable[[], float],
    theirs: Callable[[Path], float],
    peer: tuple[Path | None, str],
    ratio: tuple[str, float | None],
    turns: int,
) -> None:
    """Add the row `name`, the median of `ours`, and `name`_ratio where ratios were asked for.

    Args:
        report: takes the rows.
        name: name of the row.
        unit: unit of both rates.
        ours: measures this library once.
        theirs: measures the peer once, with the Python of its virtual environment.
        peer: folder of the virtual environments, or None for no ratios; and the peer's name.
        ratio: unit of the ratio, and its target: at least so much, or None.
        turns: number of alternating measurements of both sides, so that the load of the machine affects both; 1 without
            a peer.
    """
    folder, peer_name = peer
    python = None if folder is None else _python(folder, peer_name)
    missing = None
    if folder is not None and python is not None and not python.exists():
        python, missing = None, _not_installed(folder, peer_name)
    own, others = [], []
    for _ in range(turns if python is not None else 1):
        own.append(ours())
        if python is not None and missing is None:
            try:
                others.append(theirs(python))
            except (OSError, subprocess.CalledProcessError, LookupError, ValueError) as error:
                missing = f"{peer_name} failed: {reason(error)}"
    report.add(name, statistics.median(own), unit)
    if missing is not None:
        report.skip(f"{name}_ratio", missing)
    elif others:
        report.add(f"{name}_ratio", statistics.median(own) / statistics.median(others), ratio[0], least=ratio[1])


def run_peer(python: Path, script: str, *arguments: float, threads: int = 1) -> float:
    """Agent-steps per second that a script of `peers/` prints.

    Args:
        python: Python of the peer's virtual environment.
        script: file name of the script.
        arguments: arguments of the script.
        threads: number of threads of the peer's libraries.
    """
    command = [str(python), str(SCRIPTS / script), *map(str, arguments)]
    environment = {**os.environ, "OMP_NUM_THREADS": str(threads)}
    done = subprocess.run(command, capture_output=True, text=True, check=True, env=environment)
    return float(json.loads(done.stdout.splitlines()[-1])["agent_steps_per_s"])


def _python(peers: Path, peer: str) -> Path:
    return peers / peer / "bin" / "python"


def _not_installed(peers: Path, peer: str) -> str:
    return f"no {_python(peers, peer)}: `make bench PEERS=1` installs it"
