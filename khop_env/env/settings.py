"""The arguments that all environments share, checked."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Literal, TypedDict

import numpy as np

from khop_env.env.actuators import Actuator, Direct, Hold, as_actuator
from khop_env.network import NO_NETWORK, Network
from khop_env.observers import Estimator, as_estimator
from khop_env.observers.proximal import MOST_THREADS
from khop_env.physics import or_did_you_mean
from khop_env.simulation import OBSERVE, Observe
from khop_env.threads import processors

FEWEST = 64  # environments for each thread of threads="auto"
MOST_DATA = 1000  # numbers of a policy in a message
NUMBER = (int, float, np.integer, np.floating)


@dataclass(frozen=True)
class Settings:
    """Arguments of an environment beside its scenario and its task.

    Attributes:
        observe: content of the slots of k-hop targets: their "estimate", their true states ("oracle"), or zeros
            ("local"). Under a network neighbours are estimated, too, except with "oracle".
        bounds: whether slots also hold the guaranteed bound on the estimate's error.
        uniform: True for one padded Box for all agents, False for a Box without padding for each agent.
        max_cycles: control periods after which an episode is truncated; None for the scenario's duration.
        control_period: time between actions in s.
        dt: the simulator's step in s; the control period by default.
        order: of the simulator's step, 1, 2 or 3. Actions are held over a control period, so that the closed loop is of
            order 1 in it anyway; 2 integrates the motion between actions more accurately, at twice the time. Under a
            network 1.
        actuator: "direct", "lag", "slew", "hold", or an `Actuator`.
        limit: bound on positions and other states in observations, in their own units, and on ages in s; values beyond
            are clipped.
        threads: that share the environments of a batch in a step, or "auto": as many as there are processors for this
            process, with at least 64 environments for each. Results don't depend on them.
        network: how messages are exchanged: a profile's name, also with other values as in "lossy:period=0.1,loss=0.3",
            a `Network` or a mapping of its values; "none" for exchange in continuous time, without messages; None for
            the scenario's own, which by default is that, too.
        estimator: from messages to estimates under a network: "ppso" for the paper's observers, "relay" for stamped
            states that are passed on, or an `Estimator`; None for the scenario's own, "ppso" by default.
        message_size: numbers that a policy adds to its agent's messages: the last entries of its action. They are
            passed on with the agent's state, and arrive in the slots of others. Needs a network.

    Raises:
        ValueError: for an argument out of range; the message names it, its value and the valid range.
    """

    observe: Observe = "estimate"
    bounds: bool = False
    uniform: bool = True
    max_cycles: int | None = 200
    control_period: float = 0.05
    dt: float | None = None
    order: int = 1
    actuator: str | Actuator = "direct"
    limit: float = 100.0
    threads: int | Literal["auto"] = 1
    network: str | Network | Mapping[str, object] | None = None
    estimator: str | Estimator | None = None
    message_size: int = 0

    def __post_init__(self) -> None:
        if self.observe not in OBSERVE:
            raise ValueError(
                f"observe must be one of {', '.join(OBSERVE)}; got {self.observe!r}"
                f"{or_did_you_mean(self.observe, OBSERVE)}"
            )
        for name in ("bounds", "uniform"):
            if not isinstance(getattr(self, name), bool):
                raise ValueError(f"{name} must be True or False; got {getattr(self, name)!r}")
        for name in ("max_cycles", "order", "threads"):
            value = getattr(self, name)
            if (value is None and name == "max_cycles") or (name == "threads" and value == "auto"):
                continue
            if isinstance(value, bool) or not isinstance(value, int | np.integer) or value < 1:
                other = " or 'auto'" if name == "threads" else ""
                raise ValueError(f"{name} must be a positive integer{other}; got {value!r}")
        if isinstance(self.threads, int | np.integer) and self.threads > MOST_THREADS:
            raise ValueError(f"threads must be at most {MOST_THREADS}; got {self.threads!r}")
        size = self.message_size
        if isinstance(size, bool) or not isinstance(size, int | np.integer) or not 0 <= size <= MOST_DATA:
            raise ValueError(f"message_size must be an integer from 0 to {MOST_DATA}; got {size!r}")
        for name in ("control_period", "dt", "limit"):
            value = getattr(self, name)
            if value is None and name == "dt":
                continue
            if not isinstance(value, NUMBER) or not 0.0 < value <= 1e30:  # float32 ends at 3e38
                raise ValueError(f"{name} must be a positive, finite number of at most 1e30; got {value!r}")
        if not 1e-9 <= self.control_period <= 1e9 or (self.dt is not None and self.dt < 1e-6 * self.control_period):
            raise ValueError(
                "control_period must be from 1e-9 to 1e9 s, and at most a million simulator steps; got "
                f"control_period = {self.control_period:g} s" + ("" if self.dt is None else f" and dt = {self.dt:g} s")
            )
        if self.network != NO_NETWORK:  # which isn't the scenario's own
            object.__setattr__(self, "network", Network.of(self.network))
        if self.estimator is not None:
            as_estimator(self.estimator)  # raises for an unknown name
        object.__setattr__(self, "actuator", as_actuator(self.actuator))
        substeps = self.substeps  # refuses a period that isn't a whole number of steps
        if isinstance(self.actuator, Hold) and substeps == 1:
            raise ValueError(
                "actuator='hold' draws a line over several simulator steps, and here a control period is one: "
                f"give dt below control_period = {self.control_period:g} s"
            )

    @property
    def horizon(self) -> int:
        """Control periods in an episode.

        Raises:
            ValueError: if it depends on a scenario, which isn't known here.
        """
        if self.max_cycles is None:
            raise ValueError("max_cycles=None is the scenario's duration: make the environment with khop_env.make")
        return self.max_cycles

    @property
    def substeps(self) -> int:
        """Simulator steps in a control period.

        Raises:
            ValueError: if the period isn't a whole number of steps.
        """
        if self.dt is None:
            return 1
        steps = round(self.control_period / self.dt)
        if steps < 1 or abs(steps * self.dt - self.control_period) > 1e-9 * self.control_period:
            near = self.control_period / max(1, steps)
            raise ValueError(
                f"control_period = {self.control_period:g} s isn't a whole number of simulator steps dt = {self.dt:g} "
                f"s; dt = {near:.6g} would make it {max(1, steps)}"
            )
        return steps

    def threads_for(self, num_envs: int) -> int:
        """Number of threads for a batch of so many environments: `threads`, or what "auto" means for it."""
        if self.threads == "auto":
            return max(1, min(processors(), num_envs // FEWEST, MOST_THREADS))
        return int(self.threads)

    @property
    def inputs_are_states(self) -> bool:
        """True if the actuator remembers its input, which agents then observe."""
        return not isinstance(self.actuator, Direct)


class SettingsArguments(TypedDict, total=False):
    """`Settings` as keyword arguments, for type checkers."""

    observe: Observe
    bounds: bool
    uniform: bool
    max_cycles: int | None
    control_period: float
    dt: float | None
    order: int
    actuator: str | Actuator
    limit: float
    threads: int | Literal["auto"]
    network: str | Network | Mapping[str, object] | None
    estimator: str | Estimator | None
    message_size: int
