"""The setup of an agent's process, and the objects that are made from it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from typing import Any

from khop_env.deploy.control import Control, LawControl
from khop_env.deploy.transport import UdpTransport, ZenohTransport
from khop_env.network import Network
from khop_env.objects import load_object
from khop_env.scenarios import LawChoice, Scenario


@dataclass(frozen=True)
class Setup:
    """All that an agent's process has to know, as JSON has it.

    Attributes:
        scenario: name of the scenario, as commands take it.
        agent: index of the agent.
        network: fields of `Network`.
        network_key: of its randomness.
        estimator: "ppso" or "relay".
        steps: of the plant, in each of which the law acts, per round.
        last_step: with which the run ends.
        law: place of a function that makes a law of a `LawChoice`, "agents.laws:make_law"; not used with a policy.
        law_name: which law.
        law_parameters: its parameters.
        policy: keyword arguments of a policy's control in place of a law, `make` its place, and `memory` by name the
            task's own arrays for this agent; None for a law.
        x: the agent's state, at `first_step`.
        first_step: step that `x` is of. Until its process begins its input is 0.
        drawn: random numbers of the disturbance.
        offset: of this agent's clock, in s, at most `skew`.
        skew: bound on the difference of any two clocks, in s.
        run: 4 bytes in hexadecimal digits.
        key: secret of the run, likewise.
        folder: of the records.
        start: number of processes that the agent has had before.
        transport: "udp" or "zenoh".
        port: to bind; 0 for a free one.
    """

    scenario: str
    agent: int
    network: Mapping[str, Any]
    network_key: int
    estimator: Any
    steps: int
    last_step: int
    law: str
    law_name: str
    law_parameters: Mapping[str, Any]
    x: list[float]
    drawn: list[float]
    run: str
    key: str
    folder: str
    first_step: int = 0
    offset: float = 0.0
    skew: float = 0.0
    start: int = 0
    policy: Mapping[str, Any] | None = None
    transport: str = "udp"
    port: int = 0

    def to_json(self) -> dict[str, Any]:
        """As JSON has it."""
        return asdict(self)


def network_of(setup: Setup) -> Network:
    """The network of a setup."""
    found = Network.of({name: tuple(each) if isinstance(each, list) else each for name, each in setup.network.items()})
    assert found is not None
    return found


def transport_of(setup: Setup) -> UdpTransport | ZenohTransport:
    """The transport of a setup, which still has to meet the others."""
    if setup.transport == "zenoh":
        return ZenohTransport(setup.agent, setup.run, setup.port)
    return UdpTransport(setup.port)


def control_of(setup: Setup, scenario: Scenario) -> Control:
    """The law or policy of a setup."""
    if setup.policy is not None:
        arguments = dict(setup.policy)
        make = load_object(arguments.pop("make"))
        control: Control = make(
            scenario, setup.agent, network=network_of(setup), estimator=setup.estimator, **arguments
        )
        return control
    law = load_object(setup.law)(LawChoice(setup.law_name, setup.law_parameters))
    return LawControl(law, scenario.fleet, setup.agent, scenario.task)
