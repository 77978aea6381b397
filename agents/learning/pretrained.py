"""The policies that come with the library: by name, or chosen by environment, scenario and network."""

from __future__ import annotations

import hashlib
import tomllib
import warnings
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from datetime import date
from pathlib import Path
from typing import Any

from agents.learning.learned import LearnedPolicy
from agents.learning.policy_file import PolicyFileError
from agents.policy import EnvDescription, Observations, Policy, require_description, require_reset
from khop_env.env.layout import Float32Array
from khop_env.network import Network
from khop_env.physics import did_you_mean
from khop_env.scenarios import Scenario

PRETRAINED = Path(__file__).with_name("pretrained")
"""Folder of the policies that come with the library: NAME.npz each, index.toml, and README.md with their cards."""


@dataclass(frozen=True)
class Shipped:
    """What `index.toml` says of a policy that comes with the library.

    Attributes:
        name: of the file, without its suffix.
        environment: that it was trained for.
        scenario: that it was trained on, by name.
        network: over which it was trained, as `Network.of` takes it; None for the scenario's own, if it has one.
        estimator: under this network; None for the scenario's own.
        train: the `khop train` commands that make it, the last one's best policy.
        trained: date of the training.
        fails: where it fails, in sentences.
    """

    name: str
    environment: str
    scenario: str
    train: tuple[str, ...]
    trained: date
    fails: str
    network: str | None = None
    estimator: str | None = None

    @property
    def path(self) -> Path:
        """The policy's file."""
        return PRETRAINED / f"{self.name}.npz"

    @property
    def words(self) -> str:
        """For a list of what there is: "consensus_paper (consensus_v0 on paper)"."""
        over = "" if self.network is None else f" over {self.network}"
        return f"{self.name} ({self.environment} on {self.scenario}{over})"

    def over(self, scenario: Scenario) -> tuple[Network | None, str | None]:
        """Network and estimator in its training; `scenario` is the one that it was trained on."""
        return over_in(scenario, {"network": self.network, "estimator": self.estimator})


def over_in(scenario: Scenario, arguments: Mapping[str, Any]) -> tuple[Network | None, str | None]:
    """Network and estimator's name of an environment on a scenario; None for continuous exchange.

    Args:
        scenario: of the environment.
        arguments: of the environment.

    Raises:
        ValueError: for a network that there isn't.
    """
    chosen = arguments.get("network")
    network = Network.of(scenario.network if chosen is None else chosen)
    if network is None:
        return None, None
    estimator = arguments.get("estimator") or scenario.estimator
    return network, estimator if isinstance(estimator, str) else estimator.name


def shipped() -> dict[str, Shipped]:
    """The policies that come with the library, by name, in alphabetical order."""
    found = tomllib.loads((PRETRAINED / "index.toml").read_text(encoding="utf-8"))
    return {name: Shipped(name, **{**found[name], "train": tuple(found[name]["train"])}) for name in sorted(found)}


def digest(name: str) -> str:
    """The first 16 hexadecimal digits of the SHA-256 of a shipped policy's file."""
    return hashlib.sha256((PRETRAINED / f"{name}.npz").read_bytes()).hexdigest()[:16]


def load_pretrained(name: str) -> LearnedPolicy:
    """The shipped policy with this name.

    Raises:
        PolicyFileError: if there is none; the message lists those that there are.
    """
    found = shipped()
    if name not in found:
        raise PolicyFileError(f"no pretrained policy {name!r}; {did_you_mean(name, found)}; {_available(found)}")
    return LearnedPolicy.load(found[name].path)


class PretrainedPolicy:
    """The shipped policy for an environment, its scenario and its network, loaded at reset, when they are known.

    Over a network for which none was trained, the one that was trained over another network on the same scenario is
    played, with a warning that names both.
    """

    def reset(self, env: EnvDescription, seeds: Sequence[int]) -> None:
        """Choose and load the policy.

        Raises:
            PolicyFileError: if none is shipped for the environment, several might be meant, or it doesn't fit.

        Warns:
            UserWarning: if it was trained over another network.
        """
        self._policy = self.chosen(env)
        self._policy.reset(env, seeds)

    def act(self, observations: Observations) -> dict[str, Float32Array]:
        """Actions (..., m) in [-1, 1] by agent."""
        require_reset(self, "_policy")
        return self._policy.act(observations)

    def chosen(self, env: EnvDescription) -> LearnedPolicy:
        """The policy for an environment, not reset.

        Raises:
            PolicyFileError: if none is shipped for it, or several might be meant.
        """
        require_description(env)
        return LearnedPolicy.load(_choice(env.environment, env.scenario, (env.network, env.estimator)).path)


def resolved(policy: Policy, environment: str, scenario: Scenario, arguments: Mapping[str, Any]) -> Policy:
    """A policy, with `ppo:pretrained` replaced by the policy that it means, in safety filters, too.

    Args:
        policy: any.
        environment: name of the environment in which it is going to act.
        scenario: of the environment.
        arguments: of the environment.

    Raises:
        PolicyFileError: as `PretrainedPolicy.reset`.
    """
    from agents.safety import SafetyFilter  # which itself imports learned policies

    if isinstance(policy, SafetyFilter):
        policy.policy = resolved(policy.policy, environment, scenario, arguments)
    if isinstance(policy, PretrainedPolicy):
        return LearnedPolicy.load(_choice(environment, scenario.name, over_in(scenario, arguments)).path)
    return policy


def environments_of(scenario: str) -> list[str]:
    """The environments for which policies are shipped that were trained on a scenario.

    Raises:
        PolicyFileError: if there are none.
    """
    found = shipped()
    names = sorted({each.environment for each in found.values() if each.scenario == scenario})
    if not names:
        raise PolicyFileError(f"no pretrained policy for {scenario}; {_available(found)}")
    return names


def _choice(environment: str, scenario: str, over: tuple[Network | None, str | None]) -> Shipped:
    """The shipped policy that "ppo:pretrained" means; never by the order of files or names."""
    from khop_env.registry import scenario as load_scenario

    every = shipped()
    network, _ = over
    found = [each for each in every.values() if (each.environment, each.scenario) == (environment, scenario)]
    where = f"{environment} on {scenario}"
    train = f"To train one: khop train {environment} --scenario {scenario}"
    if not found:
        raise PolicyFileError(f"no pretrained policy for {where}; {_available(every)}. {train}")
    trained = {each.name: each.over(load_scenario(each.scenario)) for each in found}
    fitting = [each for each in found if (trained[each.name][0] is None) == (network is None)]
    if not fitting:
        without, there = ("without a network", "over one") if network is None else ("over a network", "without one")
        raise PolicyFileError(
            f"no pretrained policy for {where} {without}: {_names(found)} was trained {there}. {train}"
            + (" --network NETWORK" if network is not None else "")
        )
    exact = [each for each in fitting if trained[each.name] == over]
    candidates = exact or fitting
    if len(candidates) > 1:
        raise PolicyFileError(
            f"there are {len(candidates)} pretrained policies for {where}: choose {_names(candidates)}"
        )
    (choice,) = candidates
    if not exact:
        warnings.warn(
            f"ppo:pretrained is {choice.name}, which was trained over a network with {_words(trained[choice.name])}, "
            f"and is played over one with {_words(over)}",
            stacklevel=1,  # this line, so that it is said once
        )
    return choice


def _words(over: tuple[Network | None, str | None]) -> str:
    network, estimator = over
    return f"{network.described()} (estimator {estimator})" if network is not None else "no messages"


def _names(found: Sequence[Shipped]) -> str:
    return " or ".join(f"ppo:pretrained/{each.name}" for each in found)


def _available(found: Mapping[str, Shipped]) -> str:
    return f"available: {', '.join(each.words for each in found.values())}"
