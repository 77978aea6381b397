"""Settings of a training run."""

from __future__ import annotations

import dataclasses
import math
from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any, Literal, get_args

from agents.learning.fingerprint import plain
from agents.learning.residual import make_script
from khop_env.network import Network
from khop_env.registry import Environment, find_task
from khop_env.scenarios import Scenario
from khop_env.simulation import OBSERVE, Observe

Algorithm = Literal["ppo", "sac"]
ALGORITHMS = ("ppo", "sac")
"""Algorithms of `khop train`."""
PolicyNetwork = Literal["mlp", "attention", "recurrent"]
Critic = Literal["local", "state"]
Backend = Literal["torch", "jax"]
_FOR_JAX: Mapping[str, Any] = {"algorithm": "ppo", "policy": "mlp", "per_type": False, "critic": "local"}

NO_LIMIT = 100.0
"""A `log_std_end` above every `log_std`."""

SUITED: Mapping[str, Mapping[str, Any]] = {
    "consensus_v0": {"gamma": 0.8, "learning_rate": 1e-3, "n_steps": 32, "batch_size": 4096},
    "leader_following_v0": {"log_std_end": NO_LIMIT, "reward_memory": 0},
    "navigation_v0": {
        "nearest": True,
        "intervention": 0.5,
        "saturation": 0.5,
        "hidden": (128, 128),
        "learning_rate": 1e-3,
        "gamma": 0.98,
        "gae_lambda": 0.95,
        "n_steps": 16,
        "n_epochs": 5,
        "entropy": 0.003,
        "log_std": -0.5,
        "log_std_end": NO_LIMIT,
        "reward_memory": 0,
        "arguments": {"penalty": 0.1, "goal_radius": 0.1},  # it learns to come nearer than it has to
    },
    "sac": {"learning_rate": 1e-3, "batch_size": 512},
    "attention": {"nearest": False},
    "recurrent": {"n_steps": 16},  # errors go back through memory as far as that
}
"""By environment, algorithm and kind of network: settings where others than the defaults suit it; later ones win."""


@dataclass(frozen=True)
class TrainingConfig:
    """All settings of a training run; `TrainingConfig.suited` has better ones than these defaults for some tasks.

    Attributes:
        environment: name of an environment (khop list), or a task of your own.
        scenario: what `khop_env.scenario` takes, or a `Scenario`; None for the environment's own.
        observe: states of agents beyond the neighbours: "estimate", "oracle" or "local".
        bounds: whether observations hold the guaranteed bounds.
        rates: whether networks get how fast positions change, too, as differences of observations.
        nearest: whether networks get other agents in the order of their distances, and not in that of the slots.
        shield: a safety filter that corrects actions before the environment gets them: its margin, "certified", "none"
            or a number of m, and options after commas, "certified,announce=true"; None for no filter.
        intervention: taken from the training reward for every metre by which the shield changes an agent's way.
        saturation: taken from the training reward per second for the squared excess of actions over [-1, 1], beyond
            which exploration has no effect; 0 for none.
        residual: a scripted policy, with parameters as in `agents.make_policy`, to whose actions the networks add
            theirs; nothing at the beginning. None for networks alone.
        initial: folder of another run, of which policy, value function and exploration are taken on, or a policy's
            file; None for random networks.
        algorithm: learning algorithm, "ppo" or "sac".
        policy: kind of network: "mlp", "attention" over the slots, whose order and number then don't matter, or
            "recurrent", with memory.
        backend: what computes PPO's updates: "torch", or "jax", the same in less time but for rounding; for one network
            of all agents. Episodes and exploration are torch's with both.
        per_type: a network for each type of agent instead of one for all.
        critic: what the value function sees: "local", an agent's features as its policy does, or "state", the true
            global state beside these. Policies that are saved have none.
        timesteps: agent-steps in all, of all copies together.
        seed: seed of networks, episodes and exploration.
        num_envs: copies of the environment, each of N agents.
        hidden: widths of the networks' layers; with policy "recurrent" the last one is that of the LSTM.
        learning_rate: learning rate at the beginning; falls linearly to 0 with "ppo".
        gamma: discount per control period, from 0 to 1.
        gae_lambda: lambda of the generalised advantage estimates, from 0 to 1; PPO.
        n_steps: control periods between updates; PPO.
        batch_size: samples in a gradient step.
        n_epochs: passes over the samples of an update; PPO.
        clip_range: how far an update may change the probability of an action, as a fraction; PPO.
        entropy: weight of the entropy bonus at the beginning; PPO.
        log_std: logarithm of the initial standard deviation of actions; PPO.
        log_std_end: its upper limit at the end, to which the limit falls linearly from `log_std`, and the entropy bonus
            to 0, so that exploration ends; a value above `log_std` for no limit and a constant bonus. PPO.
        explore: fraction of the training after which limit and bonus begin to fall, below 1; PPO.
        reward_memory: number of the latest samples, about, over which the running standard deviation of returns is
            taken that rewards are divided by, so that small errors still count when large ones are over; 0 for all.
        huber: task error, in its unit, from which the training reward is linear in it; evaluation stays quadratic.
        evaluations: how often the policy is evaluated on fixed seeds, and saved.
        evaluate_network: network of these evaluations, as `--network` takes it; None for that of the training.
        arguments: further arguments of the environment by name, e.g. {"control_period": 0.1, "reward": "team"}.

    Raises:
        ValueError: if a value is invalid; the message names the attribute, the value and what is expected.
    """

    environment: Environment
    scenario: str | Path | Scenario | None = None
    observe: Observe = "estimate"
    bounds: bool = False
    rates: bool = True
    nearest: bool = False
    shield: str | float | None = None
    intervention: float = 0.0
    saturation: float = 0.0
    residual: str | None = None
    initial: str | None = None
    algorithm: Algorithm = "ppo"
    policy: PolicyNetwork = "mlp"
    backend: Backend = "torch"
    per_type: bool = False
    critic: Critic = "local"
    timesteps: int = 2_000_000
    seed: int = 0
    num_envs: int = 64
    hidden: tuple[int, ...] = (64, 64)
    learning_rate: float = 2e-3
    gamma: float = 0.95
    gae_lambda: float = 0.9
    n_steps: int = 8
    batch_size: int = 1024
    n_epochs: int = 8
    clip_range: float = 0.2
    entropy: float = 0.02
    log_std: float = 0.5
    log_std_end: float = -3.0
    explore: float = 0.0
    reward_memory: int = 20_000
    huber: float = 1.0
    evaluations: int = 20
    evaluate_network: str | None = None
    arguments: Mapping[str, Any] = field(default_factory=dict, hash=False)

    def __post_init__(self) -> None:
        object.__setattr__(self, "hidden", tuple(self.hidden))
        object.__setattr__(self, "arguments", dict(self.arguments))
        if self.shield is not None:
            from agents.policies import safety_filter  # which itself imports the learned policies

            object.__setattr__(self, "shield", str(self.shield))
            safety_filter(str(self.shield), None)
        if self.residual is not None:
            script = make_script(self.residual)
            if getattr(script, "needs_bounds", False) and not self.bounds:
                raise ValueError(
                    f"residual {self.residual!r} reads the guaranteed bounds: train with them, bounds=True or --bounds"
                )
        for name in ("observe", "bounds", "num_envs", "scenario"):
            if name in self.arguments:
                raise ValueError(f"arguments: {name!r} is a setting of its own, {name}={self.arguments[name]!r}")
        if self.algorithm not in ALGORITHMS:
            raise ValueError(f"algorithm must be 'ppo' or 'sac'; got {self.algorithm!r}")
        if self.policy not in get_args(PolicyNetwork):
            raise ValueError(f"policy must be one of {', '.join(get_args(PolicyNetwork))}; got {self.policy!r}")
        if self.policy == "attention" and (self.per_type or self.nearest):
            name = "per_type" if self.per_type else "nearest"
            raise ValueError(
                f"policy 'attention' doesn't go with {name}: it treats all slots alike, by one network for all agents"
            )
        if self.critic not in get_args(Critic):
            raise ValueError(f"critic must be one of {', '.join(get_args(Critic))}; got {self.critic!r}")
        if self.critic == "state" and self.policy == "recurrent":
            raise ValueError("critic 'state' is for policies 'mlp' and 'attention'; policy is 'recurrent'")
        if self.policy == "recurrent" and (self.algorithm == "sac" or self.per_type):
            what = "per_type" if self.per_type else "algorithm 'sac'"
            raise ValueError(f"policy 'recurrent' is trained by 'ppo', one network for all agents, without {what}")
        if self.observe not in OBSERVE:
            raise ValueError(f"observe must be one of {', '.join(OBSERVE)}; got {self.observe!r}")
        if self.evaluate_network is not None:
            try:
                Network.of(self.evaluate_network)
            except ValueError as error:
                raise ValueError(f"evaluate_network: {error}") from None
        if self.backend not in get_args(Backend):
            raise ValueError(f"backend must be 'torch' or 'jax'; got {self.backend!r}")
        for name, value in _FOR_JAX.items():
            if self.backend == "jax" and getattr(self, name) != value:
                raise ValueError(
                    f"backend 'jax' needs {name}={value!r}; got {getattr(self, name)!r}: choose it or 'torch'"
                )
        if self.per_type and self.algorithm == "sac":
            raise ValueError("per_type is for 'ppo'; 'sac' trains one network for all agents")
        for name in ("timesteps", "num_envs", "n_steps", "batch_size", "n_epochs", "evaluations"):
            value = getattr(self, name)
            if isinstance(value, bool) or not isinstance(value, int) or value < 1:
                raise ValueError(f"{name} must be a positive integer; got {value!r}")
        if isinstance(self.seed, bool) or not isinstance(self.seed, int) or self.seed < 0:
            raise ValueError(f"seed must be a non-negative integer; got {self.seed!r}")
        if not self.hidden or not all(isinstance(width, int) and width > 0 for width in self.hidden):
            raise ValueError(f"hidden must be the positive widths of at least one layer; got {self.hidden!r}")
        for name in ("learning_rate", "clip_range", "huber"):
            if not 0.0 < getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be positive and finite; got {getattr(self, name)!r}")
        for name in ("intervention", "saturation"):
            if not 0.0 <= getattr(self, name) < math.inf:
                raise ValueError(f"{name} must be non-negative and finite; got {getattr(self, name)!r}")
        if not 0.0 <= self.entropy < math.inf:
            raise ValueError(f"entropy must be non-negative and finite; got {self.entropy!r}")
        if not 0.0 <= self.explore < 1.0:
            raise ValueError(f"explore must be at least 0 and below 1; got {self.explore!r}")
        for name in ("log_std", "log_std_end"):
            if not math.isfinite(getattr(self, name)):
                raise ValueError(f"{name} must be finite; got {getattr(self, name)!r}")
        if isinstance(self.reward_memory, bool) or not isinstance(self.reward_memory, int) or self.reward_memory < 0:
            raise ValueError(f"reward_memory must be a non-negative integer; got {self.reward_memory!r}")
        for name in ("gamma", "gae_lambda"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} must be from 0 to 1; got {getattr(self, name)!r}")

    @classmethod
    def suited(cls, environment: Environment, **settings: Any) -> TrainingConfig:
        """Settings with defaults that suit environment, algorithm and kind of network, as `khop train` has them.

        Args:
            environment: as for the class.
            settings: of the class; they win over these defaults.

        Raises:
            ValueError: as the class.
        """
        own = SUITED.get(environment, {}) if isinstance(environment, str) else {}
        algorithm, policy = (SUITED.get(str(settings.get(name)), {}) for name in ("algorithm", "policy"))
        found = {**own, **algorithm, **policy, **settings}
        arguments = {**own.get("arguments", {}), **settings.get("arguments", {})}
        return cls(environment, **{**found, "arguments": arguments})

    def as_dict(self) -> dict[str, Any]:
        """The settings as JSON values; environment and scenario by name."""
        values = {field.name: getattr(self, field.name) for field in dataclasses.fields(self)}
        name = self.scenario.name if isinstance(self.scenario, Scenario) else self.scenario and str(self.scenario)
        environment = self.environment if isinstance(self.environment, str) else find_task(self.environment).name
        changed = {"environment": environment, "scenario": name, "hidden": list(self.hidden)}
        arguments = dict(self.arguments)
        if isinstance(network := arguments.get("network"), Network):  # as a file can say it
            arguments["network"] = {key: value for key, value in vars(network).items() if value is not None}
        return {**values, **changed, "arguments": plain(arguments)}
