"""Learned policies: networks in plain NumPy, evaluated without torch and Stable-Baselines3."""

from __future__ import annotations

import warnings
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass, field, fields
from pathlib import Path
from typing import Any

import numpy as np

from agents.learning.forward import Memory, Network
from agents.learning.policy_file import PolicyFileError, read_policy, write_policy
from agents.learning.residual import make_script
from agents.learning.scaling import RATE, ObservationScaler
from agents.learning.slots import SlotScaler, one_slot
from agents.policy import EnvDescription, Observations, Policy, require_description
from khop_env.env.layout import Float32Array
from khop_env.observers import IntArray


@dataclass(eq=False)
class LearnedPolicy:
    """Networks from features of observations to actions; deterministic.

    It remembers the previous observation, and what its networks remember.

    What was trained on top of a script (`about["residual"]`) adds its outputs to the script's actions, and clips the
    sum to [-1, 1]; the script may remember more and draw random numbers.

    `reset` drops what it remembers. Where episodes of a batch end at different times, as with autoreset, `begin` does
    so for those that are over; `evaluate` and the commands have no need of it.

    Attributes:
        environment: name of the environment it was trained for.
        columns: names of the columns of an observation; with attention those of one with one slot.
        action_size: number of entries of an action.
        squash: whether outputs pass through tanh (SAC); otherwise they are clipped to [-1, 1] (PPO).
        networks: by agent type, or under "" for all types.
        scaler: computes the features of observations.
        about: settings and versions of the training run.
    """

    environment: str
    columns: tuple[str, ...]
    action_size: int
    squash: bool
    networks: Mapping[str, Network]
    scaler: ObservationScaler | SlotScaler
    about: Mapping[str, Any]
    _types: dict[str, str] = field(default_factory=dict, init=False, repr=False)
    _before: Float32Array | None = field(default=None, init=False, repr=False)
    _memories: dict[str, Memory] = field(default_factory=dict, init=False, repr=False)  # of networks, or by agent
    _script: Policy | None = field(default=None, init=False, repr=False)

    def __post_init__(self) -> None:
        spec = self.about.get("residual")
        self._script = None if spec is None else make_script(spec)

    def reset(self, env: EnvDescription, seeds: Sequence[int]) -> None:
        """Check that the policy fits the environment's observations and actions.

        Raises:
            PolicyFileError: if it doesn't; the message says what differs.

        Warns:
            UserWarning: if it was trained in a safety filter and is played without one.
        """
        require_description(env)
        if env.environment != self.environment:
            raise PolicyFileError(f"it was trained for {self.environment}, not for {env.environment}")
        sizes, columns = sorted(set(env.action_sizes.values())), self._columns(env)
        where = self.about.get("scenario", "another scenario")
        if len({len(layout) for layout in env.layouts.values()}) > 1:
            raise PolicyFileError("it needs uniform observations: create the environment with uniform=True")
        if sizes != [self.action_size]:
            raise PolicyFileError(
                f"it was trained on {where} with {self.action_size} entries per action; this environment has {sizes}; "
                f"train a policy for {env.scenario}"
            )
        period = RATE / self.scaler.rate
        if abs(env.control_period - period) > 1e-9:
            raise PolicyFileError(
                f"it was trained with a control period of {period:g} s; this environment has {env.control_period:g} s"
            )
        if columns != self.columns:
            pairs = enumerate(zip(self.columns, columns, strict=False))
            differs = next(
                (f"column {q} is {own!r} there and {name!r} here" for q, (own, name) in pairs if own != name),
                "the common columns agree",
            )
            raise PolicyFileError(
                f"it was trained on {where} with {len(self.columns)} observation columns; this environment has "
                f"{len(columns)}: {differs}; {_advice(self.columns, columns)}"
            )
        types = {model.type for model in env.models.values()}
        if "" not in self.networks and (missing := types - set(self.networks)):
            raise PolicyFileError(f"it has no network for agents of type {', '.join(sorted(missing))}")
        margin = self.about.get("shield")
        if margin is not None and not env.shielded:
            warnings.warn(
                f"a policy trained inside the safety filter is played outside of it, where agents may collide: put "
                f"filter:margin={margin}: before its name, or use --shield {margin}",
                stacklevel=1,  # this line, so that it is said once
            )
        self._types = {agent: model.type for agent, model in env.models.items()}
        self._before, self._memories = None, {}
        if self._script is not None:
            self._script.reset(env, seeds)

    def act(self, observations: Observations) -> dict[str, Float32Array]:
        """Actions (..., action_size) in [-1, 1] by agent."""
        stacked = np.stack([observations[agent] for agent in observations])
        before = self._before
        if before is not None and before.shape != stacked.shape:
            raise ValueError(
                f"the batch of observations changed from {before.shape[1:-1]} to {stacked.shape[1:-1]}: call reset() "
                "first"
            )
        if before is not None:
            before = np.where(np.isnan(before), stacked, before)  # of a new episode: no change yet
        features = self.scaler(stacked, before)
        self._before = stacked
        if not self._types and (self._script is not None or "" not in self.networks):
            raise ValueError("LearnedPolicy knows no environment yet: call reset(describe(env), seeds) first")
        outputs: Iterable[Float32Array]
        if "" in self.networks:
            outputs = self._outputs("", "", features)
        else:
            rows = zip(observations, features, strict=True)
            outputs = [self._outputs(self._types[agent], agent, row) for agent, row in rows]
        script = {} if self._script is None else self._script.act(observations)
        return {
            agent: np.clip(output + script[agent] if script else output, -1.0, 1.0)
            for agent, output in zip(observations, outputs, strict=True)
        }

    def begin(self, batch: int, env_ids: IntArray | None = None) -> None:
        """New episodes have begun in these of `batch` environments; None for all: nothing is remembered of them."""
        if env_ids is None or self._before is None:
            self._before, self._memories = None, {}
        else:
            self._before = _filled(self._before, batch, env_ids, np.nan)
            for whose, memory in self._memories.items():
                self._memories[whose] = memory and tuple(_filled(each, batch, env_ids, 0.0) for each in memory)
        script: Any = self._script
        if hasattr(script, "begin"):
            script.begin(batch, env_ids)

    def get_state(self) -> dict[str, Any]:
        """What it remembers between actions."""
        script: Any = self._script
        remembered = script.get_state() if hasattr(script, "get_state") else None
        return {"before": self._before, "memories": dict(self._memories), "script": remembered}

    def set_state(self, state: Mapping[str, Any]) -> None:
        """Continue from `get_state()`'s result, after a reset in the same environment."""
        self._before, self._memories = state["before"], dict(state["memories"])
        script: Any = self._script
        if hasattr(script, "set_state"):
            script.set_state(state["script"])

    def _columns(self, env: EnvDescription) -> tuple[str, ...]:
        return columns_of(env, isinstance(self.scaler, SlotScaler))

    def _outputs(self, kind: str, whose: str, features: Float32Array) -> Float32Array:
        values, self._memories[whose] = self.networks[kind](features, self._memories.get(whose))
        return np.tanh(values) if self.squash else values

    def save(self, path: Path) -> None:
        """Write the policy into one .npz file."""
        write_policy(path, {each.name: getattr(self, each.name) for each in fields(self) if each.init})

    @classmethod
    def load(cls, path: str | Path) -> LearnedPolicy:
        """Read a policy written by `save`.

        Args:
            path: the file, or the folder of a training run, of which the best policy is read.

        Raises:
            PolicyFileError: if there is no such file, or it isn't a policy.
        """
        path = Path(path)
        if path.is_dir():
            path = path / "best.npz"
        if not path.exists():
            raise PolicyFileError(f"no policy file {path}; khop train writes a folder with best.npz and last.npz")
        fields = read_policy(path)
        try:
            return cls(**fields)
        except ValueError as error:
            raise PolicyFileError(f"{path} can't be played: {error}") from error


def _filled(memory: Float32Array, batch: int, env_ids: IntArray, value: float) -> Float32Array:
    """A copy of (..., width), of which the last axes before the width are the batch, with a value in some of it."""
    rows = memory.reshape(-1, batch, memory.shape[-1]).copy()
    rows[:, env_ids] = value
    return rows.reshape(memory.shape)


def columns_of(env: EnvDescription, by_slot: bool = False) -> tuple[str, ...]:
    """Column names of uniform observations, from the agent with most slots; `by_slot` as if there were one slot."""
    if by_slot:
        return one_slot(list(env.layouts.values()))[0]
    return max(env.layouts.values(), key=lambda layout: len(layout.slots)).names


def _advice(own: Sequence[str], here: Sequence[str]) -> str:
    """What to do about other columns; ages are observed under a network only."""
    networked, here_too = ("slot0.age" in names for names in (own, here))
    if networked != here_too:
        return f"train a policy for it, or create it with{'' if networked else 'out'} a network"
    return "train a policy for it, or create it with the same scenario and bounds"
