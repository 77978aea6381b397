"""One agent: its plant, its controller, its observers and its messages, round by round; and its process.

    python -m khop_env.deploy.agent           # started by the supervisor, which it talks to in lines of JSON

A round: the plant moves on, the node predicts, what came late is taken in, the message is sent, what is on time is
taken in, and the controller acts on the estimates. This is the order of `ObserverNode`, and of the simulator.
"""

from __future__ import annotations

import gc
import json
import math
import os
import signal
import sys
import threading
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any, TextIO

import numpy as np

from khop_env.deploy.control import Control
from khop_env.deploy.envelope import OVERHEAD, Opener, seal
from khop_env.deploy.receiver import Receiver
from khop_env.deploy.record import Columns, Writer
from khop_env.deploy.robot import Robot
from khop_env.deploy.setup import Setup, control_of, network_of, transport_of
from khop_env.deploy.transport import Transport, ZenohTransport
from khop_env.network import plain_noise
from khop_env.observers import Estimate, Message, ObserverNode
from khop_env.own_agents import claim_agents
from khop_env.scenarios import Scenario
from khop_env.scenarios.named import scenario as scenario_of

PATIENCE = 30.0  # s that a round in step waits for the others' messages
_STATUS = 0.4  # s between two reports
_POLL = 2e-4  # s


class Agent:
    """An agent whose rounds are run one by one from outside.

    Args:
        setup: what it has to know.
        scenario: the scenario that `setup` names.
        control: its law or policy.
        transport: for its messages.

    Attributes:
        round: the last one, by this agent's clock; -1 before the first.
        clock: the round that it is now, which is later if this process is.
        sent: number of messages sent, one per receiver.
        estimates: what it knows, since the last step.
        receiver: its messages.
        robot: its plant.
    """

    def __init__(self, setup: Setup, scenario: Scenario, control: Control, transport: Transport) -> None:
        design, agent = scenario.design, setup.agent
        self.setup, self._control, self.transport = setup, control, transport
        self.network = network_of(setup)
        fleet, period = design.fleet, self.network.period
        h, attached = period / setup.steps, None if scenario.disturbance is None else scenario.disturbance.attach(fleet)
        assumed: dict[str, Any] = {
            "center": scenario.initial.center,
            "radius": scenario.initial.radius,
            "disturbance": 0.0 if attached is None else attached.bound,
            "noise": self.network.noise,
        }
        exact = setup.skew > 0.0
        self.robot = Robot(
            fleet, agent, h, np.array(setup.x), scenario.disturbance, np.array(setup.drawn, float), exact
        )
        self.robot.step = setup.first_step
        self.node = ObserverNode(
            design,
            agent,
            estimator=setup.estimator,
            period=period,
            step=h,
            skew=setup.skew,
            sampled=not exact,
            **assumed,
        )
        run, key = bytes.fromhex(setup.run), bytes.fromhex(setup.key)
        sizes = {p: Message.size(design, p, setup.estimator, "float64") for p in design.links.senders[agent]}
        ahead = 2 + math.ceil(setup.skew / period)
        self.receiver = Receiver(
            design, agent, self.network, setup.network_key, Opener(design, sizes, run, key, period, ahead)
        )
        self._run, self._key = run, key
        self._to = [a for p, a in design.links.index if p == agent]
        self._rows = range(fleet.n)[fleet.state_slice(agent)]
        self.writer = Writer(Path(setup.folder), fleet, Columns.of(design, agent), agent, setup.start)
        self.message_size = Message.size(design, agent, setup.estimator, "float64") + OVERHEAD
        self.round, self.sent = -1, 0
        self.clock: Callable[[], int] = lambda: self.round
        if setup.start == 0:
            self.writer.state(self.robot.step, self.robot.x, self.robot.u)
        self.estimates: dict[str, Estimate] = {}

    def catch_up(self, step: int) -> None:
        """Let the plant move on to a step under the input in force, and take no part: after a start, or a stop."""
        while self.robot.step < step:
            self._move()

    def begin(self, in_step: bool = False, first: bool = False) -> None:
        """The first half of a step: the plant moves, and if a round is due the message is sent.

        Args:
            in_step: whether all other agents are in this step, too.
            first: of this process: the plant stays where it is.
        """
        robot = self.robot
        if first:
            self.receiver.opener.start(self._local_round())
        else:
            self._move()
        x = robot.x
        if self.network.noise:
            number = -(-robot.step // self.setup.steps)  # of the round that is due now or next
            x = x + [plain_noise(self.network, self.setup.network_key, number, row) for row in self._rows]
        self.node.update(self._local_time(), x, robot.u)
        if not self._due():
            return
        self.round = self._local_round()
        self._take(self.receiver.late(self.round) if in_step else self._drained(late=True))
        sealed = seal(self.node.message().pack(), self._run, self._key)
        for to in self._to:
            self.transport.send(sealed, to)
        self.sent += len(self._to)

    def end(self, in_step: bool = False) -> None:
        """The second half: what is on time is taken in, and the controller acts.

        Raises:
            TimeoutError: in step, if a message doesn't come.
        """
        robot = self.robot
        if self._due():
            if in_step:
                self._wait()
            self._take(self.receiver.on_time(self.round) if in_step else self._drained(late=False))
        self.estimates = self.node.estimates(self._local_time())
        robot.hold(self._control(robot.t, robot.x, self.estimates))

    def write(self, timing: tuple[float, float, float] = (0.0, 0.0, 0.0)) -> None:
        """Put on record what is known now; `timing` is of the round."""
        self.writer.knowledge(self.robot.step, timing, self.robot.u, self.receiver.newest, self.estimates)

    def counts(self) -> dict[str, Any]:
        """Numbers of messages so far, by what became of them."""
        receiver = self.receiver
        return {
            "sent": self.sent,
            "received": receiver.received,
            "lost": receiver.lost,
            "refused": dict(receiver.opener.refused),
            "message_bytes": self.message_size,
        }

    def _due(self) -> bool:
        return self.robot.step % self.setup.steps == 0

    def _local_time(self) -> float:
        """Time in s by this agent's clock."""
        return self.robot.t + self.setup.offset

    def _local_round(self) -> int:
        return math.floor(self._local_time() / self.network.period + 1e-6)

    def _move(self) -> None:
        self.robot.advance()
        self.writer.state(self.robot.step, self.robot.x, self.robot.u)

    def _drained(self, late: bool) -> list[Message]:
        self.receiver.take(self.transport.receive(), self.clock())
        return self.receiver.late(self.round) if late else self.receiver.on_time(self.round)

    def _wait(self) -> None:
        until = time.monotonic() + PATIENCE
        self.receiver.take(self.transport.receive(), self.round)
        while not self.receiver.complete(self.round):
            if time.monotonic() > until:
                raise TimeoutError(
                    f"no message of round {self.round} from agents {self.receiver.missing(self.round)} within "
                    f"{PATIENCE:g} s; are datagrams on 127.0.0.1 filtered?"
                )
            time.sleep(_POLL)
            self.receiver.take(self.transport.receive(), self.round)

    def _take(self, messages: list[Message]) -> None:
        for message in messages:
            try:
                self.node.receive(message)
            except ValueError:
                self.receiver.opener.refused["refused by the node"] += 1


# -- the process ---------------------------------------------------------------------------------------------------


def main() -> None:
    """Run one agent, as the lines on stdin say; ends as soon as stdin does."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # the supervisor ends its agents, by closing their stdin
    claim_agents()
    out = os.fdopen(os.dup(1), "w")
    os.dup2(2, 1)  # what a user's own scenario prints isn't for the supervisor
    try:
        _run(out)
    except (ValueError, OSError, ModuleNotFoundError) as error:
        say(out, error=str(error))
        sys.exit(2)


def _run(out: TextIO) -> None:
    setup = Setup(**json.loads(sys.stdin.readline()))
    scenario = scenario_of(setup.scenario)
    transport = transport_of(setup)
    agent = Agent(setup, scenario, control_of(setup, scenario), transport)
    gc.freeze()  # what is there now stays: collecting it again and again takes tens of milliseconds
    say(out, ready=transport.port)
    order = json.loads(sys.stdin.readline() or "null")
    if order is None:
        return
    transport.meet({int(number): port for number, port in order["ports"].items()})
    if "begin" in order:
        threading.Thread(target=_end_with_stdin, daemon=True).start()
        in_time(agent, order["begin"], out)
    else:
        if isinstance(transport, ZenohTransport):
            transport.wait()
        in_step(agent, out)
    say(out, ended=agent.counts())
    agent.writer.close()
    transport.close()


def in_step(agent: Agent, out: TextIO) -> None:
    """Rounds as the supervisor calls them, one for each line on stdin."""
    steps, first = agent.setup.steps, True
    for _ in sys.stdin:
        began = time.process_time()
        for _ in range(1 if first else steps):
            agent.begin(in_step=True, first=first)
            agent.end(in_step=True)
            agent.write((0.0, 0.0, time.process_time() - began))
            first = False
        say(out, done=agent.round, **agent.counts())
        if agent.robot.step >= agent.setup.last_step:
            return


def in_time(agent: Agent, begin: float, out: TextIO) -> None:
    """Rounds at multiples of the period, by the system's monotonic clock.

    Args:
        agent: runs them.
        begin: time 0 of the run, by that clock.
        out: to the supervisor.
    """
    setup, period = agent.setup, agent.network.period
    last = setup.last_step // setup.steps
    first, reported, cpu = True, 0.0, time.process_time()
    agent.clock = lambda: math.floor((time.monotonic() - begin + setup.offset) / period)
    number = 0 if setup.first_step == 0 else setup.first_step // setup.steps + 1
    while number <= last:
        ahead = begin + number * period - time.monotonic()
        if ahead > 0.0:
            time.sleep(ahead)
        now = time.monotonic() - begin
        number = min(last, max(number, math.floor(now / period)))  # rounds that were missed stay missed
        step = number * setup.steps
        agent.catch_up(step if first else step - setup.steps)
        while first or agent.robot.step < step:
            agent.begin(first=first)
            agent.end()
            first = False
            if agent.robot.step < step:
                agent.write()
        due, used = number * period, time.process_time()
        agent.write((now - due, time.monotonic() - begin - due, used - cpu))
        cpu, number = used, number + 1
        if now - reported > _STATUS:
            reported = now
            say(out, status=agent.counts())


def say(stream: TextIO, **what: Any) -> None:
    """A line for the supervisor."""
    stream.write(json.dumps(what) + "\n")
    stream.flush()


def _end_with_stdin() -> None:
    """End this process with its stdin, which the system closes if the supervisor is killed."""
    while os.read(0, 1024):
        pass
    os._exit(0)


if __name__ == "__main__":
    main()
