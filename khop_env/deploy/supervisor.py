"""Starts one process per agent, says when they begin, kills and restarts some if asked to, and ends them all.

Processes are talked to in lines of JSON over their stdin and stdout. A process ends when its stdin does, so that none
is left when this one is killed.
"""

from __future__ import annotations

import json
import os
import selectors
import subprocess
import sys
import time
from collections import Counter
from collections.abc import Callable, Iterator
from contextlib import suppress
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from khop_env import deploy
from khop_env.compiled import PLAIN
from khop_env.deploy.record import Columns, rows_of
from khop_env.deploy.setup import Setup
from khop_env.scenarios import Scenario

START = 120.0  # s until a process must have answered
STUCK = 60.0  # s that a round in step may take
END = 1.0  # s that processes have to end by themselves
_TICK = 0.5  # s between two looks at the clock, and at the table
_LEAD = 0.3  # s from the last agent's answer to time 0

Watch = Callable[[float, "Supervisor"], None]
"""Called about twice a second with the fraction of the run that is over."""


@dataclass(frozen=True)
class Kill:
    """A process that is killed at a time, and may be started again.

    Attributes:
        agent: index.
        at: in s.
        restart: in s; None for never.
    """

    agent: int
    at: float
    restart: float | None = None


class Process:
    """One agent's process.

    Attributes:
        setup: as it was started.
        port: that it has bound; 0 until it has said so.
        counts: what it said last of its messages.
        ended: whether it has nothing to do any more.
        away: whether that is so before its rounds were over.
        error: what it stopped with, or "".
    """

    def __init__(self, setup: Setup, folder: Path, name: str) -> None:
        self.setup, self.port, self.counts, self.ended, self.error = setup, 0, {}, False, ""
        self.round, self.away = -1, False
        self._errors = folder / f"{name}.{setup.start}.stderr"
        root = str(Path(deploy.__file__).parents[2])
        path = os.pathsep.join([root, *filter(None, [os.environ.get("PYTHONPATH")])])
        threads = dict.fromkeys(("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"), "1")
        plain = {PLAIN: "1"} if setup.policy is None else {}  # a safety filter's kernels are slow without a compiler
        with open(self._errors, "wb") as errors:
            self.popen = subprocess.Popen(
                [sys.executable, "-m", "khop_env.deploy.agent"],
                stdin=subprocess.PIPE,
                stdout=subprocess.PIPE,
                stderr=errors,
                env={**os.environ, "PYTHONPATH": path, **plain, **threads},
                process_group=0,  # Ctrl-C is for the supervisor; a stopped one is woken when it is orphaned
            )
        self._text = b""
        self.say(setup.to_json())

    counts: dict[str, Any]

    @property
    def state(self) -> str:
        """In a word: "" while all is well."""
        return "away" if self.away else "starting" if not self.port else "done" if self.ended else ""

    @property
    def alive(self) -> bool:
        """Whether it still has something to do."""
        return not self.ended and self.popen.poll() is None

    def say(self, what: Any) -> None:
        """A line on its stdin; one that has ended doesn't read it."""
        assert self.popen.stdin is not None
        with suppress(OSError):
            self.popen.stdin.write(json.dumps(what).encode() + b"\n")
            self.popen.stdin.flush()

    def lines(self) -> Iterator[dict[str, Any]]:
        """What it has said; nothing more, and an `error`, once it is gone without having ended."""
        assert self.popen.stdout is not None
        data = os.read(self.popen.stdout.fileno(), 1 << 16)
        *complete, self._text = (self._text + data).split(b"\n")
        for line in complete:
            yield json.loads(line)
        if not data:
            self.popen.wait()
            if not self.ended and not self.error:
                said = self._errors.read_text(errors="replace").strip().splitlines()
                self.error = said[-1] if said else f"ended with status {self.popen.returncode}"
            self.ended = True

    def close(self) -> None:
        """End its stdin, upon which it ends."""
        assert self.popen.stdin is not None
        with suppress(OSError):
            self.popen.stdin.close()

    def kill(self) -> None:
        """SIGKILL, and wait until it is gone."""
        assert self.popen.stdout is not None
        self.ended = True
        self.close()
        self.popen.kill()
        self.popen.wait()
        self.popen.stdout.close()


class Supervisor:
    """A run of all agents' processes.

    Args:
        scenario: that setups name.
        setups: one per agent.
        in_step: whether each round waits for everybody; else rounds keep time.
        kills: processes to kill, and to start again.
        watch: called about twice a second.

    Attributes:
        processes: the last one of each agent.
        errors: what went wrong, in a line each; the others went on.
        killed: by agent the times, in s, at which its process was gone.
        interrupted: whether Ctrl-C ended the run.
        wall_time: of the run, in s.
    """

    def __init__(
        self,
        scenario: Scenario,
        setups: list[Setup],
        *,
        in_step: bool = False,
        kills: tuple[Kill, ...] = (),
        watch: Watch | None = None,
    ) -> None:
        self.scenario, self._setups, self._in_step, self._watch = scenario, setups, in_step, watch
        self.folder = Path(setups[0].folder)
        self.period = float(setups[0].network["period"])
        self.duration = setups[0].last_step // setups[0].steps * self.period
        self._events = sorted(
            [(kill.at, "kill", kill.agent) for kill in kills]
            + [(kill.restart, "restart", kill.agent) for kill in kills if kill.restart is not None]
        )
        self.processes: list[Process] = []
        self.errors: list[str] = []
        self.killed: list[list[float]] = [[] for _ in setups]
        self.interrupted, self.wall_time = False, 0.0
        self._selector = selectors.DefaultSelector()
        self._begin, self._gone = 0.0, list[Process]()

    def run(self) -> None:
        """Start, run and end all processes; what is on record stays, however it ends."""
        began = time.monotonic()
        try:
            self._start()
            self._begin = began = time.monotonic() + _LEAD
            if self._in_step:
                self._rounds_in_step()
            else:
                self._rounds_in_time()
        except KeyboardInterrupt:
            self.interrupted = True
        finally:
            self._end()
            self.wall_time = max(0.0, time.monotonic() - began)

    def now(self) -> float:
        """Seconds since time 0 of the run."""
        return time.monotonic() - self._begin

    def counts(self) -> list[dict[str, Any]]:
        """Each agent's numbers of messages by what became of them, of all its processes until their last report."""
        found = []
        for agent in range(len(self._setups)):
            said = [each.counts for each in [*self._gone, *self.processes] if each.setup.agent == agent and each.counts]
            whole: dict[str, Any] = {"refused": Counter()}
            for counts in said:
                whole |= {name: whole.get(name, 0) + counts[name] for name in ("sent", "received", "lost")}
                whole["refused"] += Counter(counts["refused"])
                whole["message_bytes"] = counts["message_bytes"]
            found.append(whole | {"refused": dict(whole["refused"])})
        return found

    # -- parts ---------------------------------------------------------------------------------------------------

    def _start(self) -> None:
        for setup in self._setups:
            self.processes.append(self._launched(setup))
        until = time.monotonic() + START
        while not all(process.port for process in self.processes):
            self._listen(until - time.monotonic(), f"starting processes took more than {START:g} s")
            self._require_all()

    def _launched(self, setup: Setup) -> Process:
        process = Process(setup, self.folder, self.scenario.fleet.ids[setup.agent])
        assert process.popen.stdout is not None
        self._selector.register(process.popen.stdout, selectors.EVENT_READ, process)
        return process

    def _ports(self) -> dict[str, int]:
        return {str(process.setup.agent): process.port for process in self.processes}

    def _rounds_in_step(self) -> None:
        for process in self.processes:
            process.say({"ports": self._ports()})
        for number in range(self._setups[0].last_step // self._setups[0].steps + 1):
            for process in self.processes:
                process.say(number)
            until = time.monotonic() + STUCK
            while any(process.round < number for process in self.processes):
                self._listen(until - time.monotonic(), f"round {number} took more than {STUCK:g} s")
                self._require_all()
            if self._watch is not None:
                self._watch(number * self.period / self.duration if self.duration else 1.0, self)

    def _rounds_in_time(self) -> None:
        for process in self.processes:
            process.say({"ports": self._ports(), "begin": self._begin})
        events, looked = list(self._events), 0.0
        while events or any(process.alive for process in self.processes):
            now = self.now()
            while events and events[0][0] <= now:
                _, what, agent = events.pop(0)
                if what == "kill":
                    self._kill(agent)
                else:
                    self._restart(agent)
            if self._watch is not None and now - looked > _TICK:
                looked = now
                self._watch(min(1.0, max(0.0, now / self.duration)) if self.duration else 1.0, self)
            wait = min([_TICK, *(at - now for at, _, _ in events[:1])])
            self._listen(max(0.0, wait), None)
            if now > self.duration + STUCK:
                raise TimeoutError(f"processes didn't end within {STUCK:g} s after their last round")

    def _kill(self, agent: int) -> None:
        process = self.processes[agent]
        if process.alive:
            self._forget(process)
            process.kill()
            process.away = True
            self.killed[agent].append(self.now())

    def _restart(self, agent: int) -> None:
        """A new process, whose plant goes on from where the old one's was on record, with the input at 0."""
        old = self.processes[agent]
        fleet, columns = self.scenario.fleet, Columns.of(self.scenario.design, agent)
        rows = rows_of(self.folder, fleet, agent, "states", columns.state_width)
        setup = replace(old.setup, start=old.setup.start + 1, port=old.port)
        if len(rows):
            setup = replace(setup, first_step=int(rows[-1, 0]), x=rows[-1, 1 : 1 + columns.n].tolist())
        self._gone.append(old)
        self.processes[agent] = self._launched(setup)

    def _listen(self, wait: float, late: str | None) -> None:
        """Read what processes say for at most `wait` s; `late` is said when nothing comes and time is over."""
        if late is not None and wait <= 0.0:
            raise TimeoutError(late)
        for key, _ in self._selector.select(wait):
            process: Process = key.data
            for line in process.lines():
                self._heard(process, line)
            if process.ended:
                self._forget(process)
                if process.error:
                    process.away = True
                    name = self.scenario.fleet.ids[process.setup.agent]
                    self.errors.append(f"the process of {name} stopped: {process.error}")
                    self.killed[process.setup.agent].append(self.now())

    def _heard(self, process: Process, line: dict[str, Any]) -> None:
        if "ready" in line:
            process.port = line["ready"]
            if process.setup.start:  # the others are under way
                process.say({"ports": self._ports(), "begin": self._begin})
        elif "done" in line:
            process.round, process.counts = line.pop("done"), line
        elif "error" in line:
            process.error, process.ended = line["error"], True
        process.counts = line.get("status") or line.get("ended") or process.counts
        if "ended" in line:
            process.ended = True

    def _require_all(self) -> None:
        """Raise if a process has stopped that all others wait for."""
        if self.errors:
            raise ChildProcessError(self.errors[0])

    def _forget(self, process: Process) -> None:
        with suppress(KeyError, ValueError):
            self._selector.unregister(process.popen.stdout)  # type: ignore[arg-type]

    def _end(self) -> None:
        """End all processes: by themselves, or after a second by force."""
        for process in self.processes:
            process.close()
        until = time.monotonic() + END
        for process in self.processes:
            with suppress(subprocess.TimeoutExpired):
                process.popen.wait(max(0.0, until - time.monotonic()))
            process.kill()
        self._selector.close()
