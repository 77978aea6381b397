"""The script of a residual policy: a scripted policy to whose actions a network adds its own."""

from __future__ import annotations

import dataclasses
import inspect
import json
from typing import Any

import numpy as np

from agents.policy import EnvDescription, Policy, policy_seeds
from agents.scripted import LawPolicy
from khop_env.env.layout import Float32Array
from khop_env.observers import IntArray
from khop_env.physics import did_you_mean

AIMLESS = ("random", "bang_bang")  # scripts that aren't meant to solve a task


def make_script(spec: object) -> Policy:
    """A scripted policy of the library by name, with parameters as in `make_policy`: "tanh:gain=2".

    Policies from files are refused: the name may come from a policy's file of somebody else.

    Raises:
        ValueError: if there is no such script, or a parameter is unknown or out of range.
    """
    from agents.policies import POLICIES, make_policy  # which itself imports the learned policies

    known = [name for name in POLICIES if name not in AIMLESS]
    if not isinstance(spec, str):
        raise ValueError(f"residual must be the name of a scripted policy; got {spec!r:.40}")
    name = spec.partition(":")[0]
    if name not in known:
        hint = did_you_mean(name, known)
        raise ValueError(f"residual {spec!r}: there is no scripted policy {name!r} to learn on top of; {hint}")
    try:
        return make_policy(spec)
    except ValueError as error:
        text = str(error).replace(f"policy {spec!r}: ", "")
        raise ValueError(f"residual {spec!r}: {text}") from error


class Script:
    """A script that acts beside a learner, in environments whose episodes end at different times.

    Args:
        spec: as for `make_script`.
        env: as the learner gets it.
        num_envs: number of environments B.

    Attributes:
        name: with all parameters as they are in `env`. Tuned ones depend on scenario and observation mode, and a
            network has to be played on top of those that it was trained with.

    Raises:
        ValueError: if the script can't play the environment; the message says what is missing.
    """

    def __init__(self, spec: str, env: EnvDescription, num_envs: int) -> None:
        self._env, self._num_envs, self._policy = env, num_envs, make_script(spec)
        try:
            self._policy.reset(env, [0] * num_envs)
        except ValueError as error:
            raise ValueError(f"residual {spec!r}: {error}") from error
        parameters = ",".join(f"{name}={json.dumps(value)}" for name, value in _parameters(self._policy).items())
        self.name = ":".join(filter(None, [spec.partition(":")[0], parameters]))
        self._remembers = hasattr(self._policy, "get_state")

    def reset(self, seed: int) -> None:
        """New episodes begin in all environments; the seed is for what the script draws."""
        self._policy.reset(self._env, policy_seeds(range(seed, seed + self._num_envs)))
        self.begin(None)

    def begin(self, env_ids: IntArray | None) -> None:
        """New episodes have begun in these environments; None for all."""
        if self._remembers:
            self._policy.begin(self._num_envs, env_ids)  # type: ignore[attr-defined]

    def act(self, observations: Float32Array) -> Float32Array:
        """Actions (B * N, m) for observations (B * N, D), the agents of an environment side by side."""
        agents = self._env.agents
        by_env = observations.reshape(self._num_envs, len(agents), -1)
        actions = self._policy.act({agent: by_env[:, number] for number, agent in enumerate(agents)})
        return np.stack([actions[agent] for agent in agents], axis=1).reshape(len(observations), -1)

    def get_state(self) -> dict[str, Any]:
        """What the script remembers of the running episodes."""
        return self._policy.get_state() if self._remembers else {}  # type: ignore[attr-defined]

    def set_state(self, state: dict[str, Any]) -> None:
        """Continue from `get_state()`'s result, after a reset."""
        if self._remembers:
            self._policy.set_state(state)  # type: ignore[attr-defined]


def _parameters(script: Policy) -> dict[str, Any]:
    """All parameters of a script after its reset, by name."""
    if isinstance(script, LawPolicy):
        law: Any = script.law
        return {each.name: getattr(law, each.name) for each in dataclasses.fields(law)}
    return {name: getattr(script, name) for name in inspect.signature(type(script)).parameters}
