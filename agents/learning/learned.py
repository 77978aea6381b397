"""A learned policy: networks in plain NumPy, so that acting needs neither torch nor Stable-Baselines3."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from agents.learning.policy_file import Layers, PolicyFileError, read_policy, write_policy
from agents.learning.scaling import RATE, ObservationScaler
from agents.policy import EnvDescription, Observations
from khop_env.env.layout import Float32Array

PRETRAINED = Path(__file__).with_name("pretrained")


@dataclass(eq=False)
class LearnedPolicy:
    """Networks that map features of observations to actions; deterministic, with a memory of one observation at most.

    Where episodes of a batch end at different times, as with autoreset, the first features after an end hold a change
    that spans both episodes; `reset` forgets the observation before.

    Attributes:
        environment: what it was trained for.
        columns: names of the observation's columns.
        action_size: entries of an action.
        squash: whether the outputs pass through tanh (SAC) or are cut off at 1 (PPO).
        networks: layers by agent type; the same under "" for all types.
        scaler: applied first.
        about: how it was trained.
    """

    environment: str
    columns: tuple[str, ...]
    action_size: int
    squash: bool
    networks: Mapping[str, Layers]
    scaler: ObservationScaler
    about: Mapping[str, Any]
    _types: dict[str, str] = field(default_factory=dict, init=False, repr=False)
    _before: Float32Array | None = field(default=None, init=False, repr=False)

    def reset(self, env: EnvDescription, seeds: Sequence[int]) -> None:
        """Check that it was trained for this environment's observations and actions.

        Raises:
            PolicyFileError: saying what differs.
        """
        if env.environment != self.environment:
            raise PolicyFileError(f"it was trained for {self.environment}, not for {env.environment}")
        sizes, columns = sorted(set(env.action_sizes.values())), columns_of(env)
        where = self.about.get("scenario", "another scenario")
        if len({len(layout) for layout in env.layouts.values()}) > 1:
            raise PolicyFileError("it needs uniform observations: make the environment with uniform=True")
        if sizes != [self.action_size]:
            raise PolicyFileError(
                f"it was trained on {where} with {self.action_size} entries per action, here are {sizes}; train one "
                f"for {env.scenario}"
            )
        period = RATE / self.scaler.rate
        if abs(env.control_period - period) > 1e-9:
            raise PolicyFileError(
                f"it was trained to act every {period:g} s, here agents act every {env.control_period:g} s"
            )
        if columns != self.columns:
            pairs = enumerate(zip(self.columns, columns, strict=False))
            differs = next(
                (f"column {q} is {mine!r} there and {its!r} here" for q, (mine, its) in pairs if mine != its),
                "the first columns agree",
            )
            raise PolicyFileError(
                f"it was trained on {where} with {len(self.columns)} columns of observations, here are {len(columns)}: "
                f"{differs}; train one for this environment, or make it with the same scenario and bounds"
            )
        types = {model.type for model in env.models.values()}
        if "" not in self.networks and (missing := types - set(self.networks)):
            raise PolicyFileError(f"it has no network for agents of type {', '.join(sorted(missing))}")
        self._types, self._before = {agent: model.type for agent, model in env.models.items()}, None

    def act(self, observations: Observations) -> dict[str, Float32Array]:
        """The networks' outputs, in [-1, 1]."""
        seen = np.stack([observations[agent] for agent in observations])
        before = self._before
        if before is not None and before.shape != seen.shape:
            raise ValueError(
                f"observations of another batch, {seen.shape[1:-1]} after {before.shape[1:-1]}: call reset() first"
            )
        features = self.scaler(seen, before)
        self._before = seen
        if "" in self.networks:
            return dict(zip(observations, self._forward(features, self.networks[""]), strict=True))
        return {
            agent: self._forward(mine, self.networks[self._types[agent]])
            for agent, mine in zip(observations, features, strict=True)
        }

    def _forward(self, values: Float32Array, layers: Layers) -> Float32Array:
        for number, (weight, bias) in enumerate(layers):
            values = values @ weight.T + bias
            if number < len(layers) - 1:
                np.maximum(values, 0.0, out=values)
        return np.tanh(values) if self.squash else np.clip(values, -1.0, 1.0)

    def save(self, path: Path) -> None:
        """Write everything into one .npz file."""
        write_policy(path, {one.name: getattr(self, one.name) for one in fields(self) if one.init})

    @classmethod
    def load(cls, path: str | Path) -> LearnedPolicy:
        """Read a policy that `save` wrote.

        Args:
            path: the file, or the folder of a training run, whose best policy is meant then.

        Raises:
            PolicyFileError: if there is none, or it isn't one.
        """
        path = Path(path)
        if path.is_dir():
            path = path / "best.npz"
        if not path.exists():
            raise PolicyFileError(f"there is no policy {path}; khop train writes a folder with best.npz and last.npz")
        return cls(**read_policy(path))


class PretrainedPolicy:
    """The shipped policy for an environment and scenario, found when it is known which these are.

    Args:
        environment: what it was trained for; None for wherever it plays.
    """

    def __init__(self, environment: str | None = None) -> None:
        self.environment = environment

    def reset(self, env: EnvDescription, seeds: Sequence[int]) -> None:
        """Load it.

        Raises:
            PolicyFileError: if none is shipped for this environment and scenario, or it doesn't fit.
        """
        if self.environment not in (None, env.environment):
            raise PolicyFileError(f"the policy for {self.environment} was asked for, and this is {env.environment}")
        path = PRETRAINED / f"{pretrained_name(env.environment, env.scenario)}.npz"
        if not path.exists():
            raise PolicyFileError(
                f"no pretrained policy for {env.environment} on {env.scenario}; there are: {_shipped()}. "
                f"Train one: khop train {env.environment} --scenario {env.scenario}"
            )
        self._policy = LearnedPolicy.load(path)
        self._policy.reset(env, seeds)

    def act(self, observations: Observations) -> dict[str, Float32Array]:
        """Its actions."""
        return self._policy.act(observations)

    def about_for(self, scenario: str) -> Mapping[str, Any]:
        """How the policy for a scenario, by name, was trained.

        Raises:
            PolicyFileError: if none is shipped for it, or several are and no environment was named.
        """
        ending = pretrained_name(self.environment or "", scenario)
        found = sorted(path for path in PRETRAINED.glob("*.npz") if path.stem.endswith(ending))
        if not found:
            wanted = f"{self.environment} on {scenario}" if self.environment else scenario
            raise PolicyFileError(f"no pretrained policy for {wanted}; there are: {_shipped()}")
        if len(found) > 1:
            names = " or ".join(f"ppo:pretrained/{path.stem.removesuffix(ending)}" for path in found)
            raise PolicyFileError(f"there are {len(found)} pretrained policies for {scenario}: choose {names}")
        return LearnedPolicy.load(found[0]).about


def pretrained_name(environment: str, scenario: str) -> str:
    """File name, without ending, of the shipped policy for an environment on a scenario, both by name."""
    return f"{environment}@{scenario.replace(':', '-').replace(',', '-').replace('=', '')}"


def _shipped() -> str:
    return ", ".join(sorted(one.stem.replace("@", " on ") for one in PRETRAINED.glob("*.npz"))) or "none"


def columns_of(env: EnvDescription) -> tuple[str, ...]:
    """Names of the columns of uniform observations: those of the agent with most slots."""
    return max(env.layouts.values(), key=lambda layout: len(layout.slots)).names
