"""The environment under test: copies of it, and episodes with random actions."""

from __future__ import annotations

import copy
import functools
import pickle
import random
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from typing import Any

import numpy as np
from gymnasium.spaces import Box, Space
from pettingzoo import ParallelEnv

from khop_env.env import KHopEnv
from khop_env.objects import described
from khop_env.testing.equality import difference

Chooser = Callable[[str, Space, Any], Any]
"""An action from an agent, its action space and its action mask (or None)."""


class Fault(Exception):  # noqa: N818  # a result, which never leaves this package
    """The environment violates the checked property."""


class Skip(Exception):  # noqa: N818
    """The check doesn't apply."""


class Subject:
    """An environment to check.

    Args:
        env: the environment, or a function that returns a new one.
        steps: number of steps of an episode or a comparison.
        seed: the first seed.

    Raises:
        ValueError: if `env` isn't a ParallelEnv, or is a function that returns the same object twice.
    """

    def __init__(self, env: Any, steps: int, seed: int) -> None:
        self.steps, self.seed = steps, seed
        self._factory: Callable[[], Any] | None = None
        self._made: list[ParallelEnv] = []
        if not isinstance(env, ParallelEnv) and callable(env):
            self._factory, env = env, env()
        self.env = require_parallel(env)
        if self._factory is not None and self.another() is self.env:
            raise ValueError("the function returned the same environment twice; it must return a new one at each call")

    @property
    def name(self) -> str:
        """The environment's name in the report."""
        return str(self.env) if type(self.env).__str__ is not object.__str__ else type(self.env).__name__

    def another(self) -> ParallelEnv:
        """A new environment of the same kind.

        Raises:
            Skip: if the object can be neither copied nor pickled.
        """
        made = self._copied() if self._factory is None else require_parallel(self._factory())
        self._made.append(made)
        return made

    def any(self) -> ParallelEnv:
        """A new environment if possible, else the object itself."""
        try:
            return self.another()
        except Skip:
            return self.env

    def own(self) -> KHopEnv:
        """A new environment of this library, without wrappers.

        Raises:
            Skip: if it isn't an environment of this library.
        """
        if not isinstance(self.env.unwrapped, KHopEnv):
            raise Skip("only environments of khop_env have an array form and a communication graph")
        return self.another().unwrapped

    def close(self) -> None:
        """Close all environments created here."""
        while self._made:
            self._made.pop().close()

    def require_repeatable(self) -> None:
        """Require that two runs with the same seed are equal, as comparisons of copies need it.

        Raises:
            Skip: if they differ.
        """
        if not self._repeatable:
            raise Skip("two runs with the same seed differ (see same_seed), so copies can't be compared")

    @functools.cached_property
    def _repeatable(self) -> bool:
        runs = []
        for _ in range(2):
            with global_generators_seeded():
                runs.append(record(self.any(), self.steps, self.seed, reset_seed=self.seed))
        return first_difference(*runs) is None

    def _copied(self) -> ParallelEnv:
        errors = []
        for how, method in (("deepcopy", copy.deepcopy), ("pickle", lambda env: pickle.loads(pickle.dumps(env)))):
            try:
                made = method(self.env)
            except Exception as error:
                errors.append(f"{how} raised {described(error)}")
            else:
                if made is not self.env:
                    return made
                errors.append(f"{how} returned the object itself")
        raise Skip(f"needs a second environment; pass a function that returns a new one: {'; '.join(errors)}")


def require_parallel(env: Any) -> ParallelEnv:
    """The ParallelEnv itself, or the one inside a wrapper of this library.

    Raises:
        ValueError: if there is none.
    """
    for inner in (env, getattr(env, "unwrapped", None), getattr(getattr(env, "unwrapped", None), "env", None)):
        if isinstance(inner, ParallelEnv):
            return inner
    raise ValueError(
        f"expected a PettingZoo ParallelEnv, or a function that returns one; got {type(env).__name__}; convert an "
        "AEC environment by pettingzoo.utils.aec_to_parallel"
    )


def play(
    env: ParallelEnv, steps: int, seed: int, *, reset_seed: int | None = None, begin: bool = True, choose: Any = None
) -> Iterator[dict[str, Any]]:
    """Run consecutive episodes, of which only the first may be seeded.

    Args:
        env: the environment.
        steps: total number of steps.
        seed: seed of the actions, which are drawn from copies of the action spaces.
        reset_seed: seed of the first reset.
        begin: whether to reset first; otherwise the current episode continues.
        choose: a `Chooser`; by default actions are sampled.

    Yields:
        The return values of reset and step by name, with the actions.
    """
    spaces: dict[Any, Space] = {}
    for number, agent in enumerate(env.possible_agents):
        spaces[agent] = copy.deepcopy(env.action_space(agent))
        spaces[agent].seed(seed + number)
    masks: dict[str, Any] = {}
    for _ in range(steps):
        if begin or not env.agents:
            step = _named(("observations", "infos"), env.reset(**({"seed": reset_seed} if begin else {})), "reset")
            begin, masks = False, _masks(step)
            yield step
        actions = {agent: (choose or _sample)(agent, spaces[agent], masks.get(agent)) for agent in env.agents}
        names = "observations", "rewards", "terminations", "truncations", "infos"
        step = _named(names, env.step(actions), "step")
        masks = _masks(step)
        yield {**step, "actions": actions}


def record(env: ParallelEnv, steps: int, seed: int, **arguments: Any) -> list[dict[str, Any]]:
    """Deep copies of everything that `play` yields."""
    return [copy.deepcopy(step) for step in play(env, steps, seed, **arguments)]


def first_difference(run: list[dict[str, Any]], again: list[dict[str, Any]]) -> str | None:
    """The first difference between two recordings of the same episodes."""
    for number, (first, second) in enumerate(zip(run, again, strict=False)):
        for key in first:
            if found := difference(first[key], second.get(key), key):
                return f"{called(number, first)}: {found}"
    return None


def called(number: int, step: dict[str, Any]) -> str:
    """A call by its number: "call 3, step()"."""
    return f"call {number}, {'step' if 'rewards' in step else 'reset'}()"


def at_bound(end: str) -> Chooser:
    """Chooses the "low" or "high" bounds of boxes where they are finite, and samples otherwise."""

    def choose(agent: str, space: Space, mask: Any) -> Any:
        action = _sample(agent, space, mask)
        if isinstance(space, Box):
            bound = getattr(space, end)
            action = np.where(np.isfinite(bound), bound, action).astype(space.dtype)
        return action

    return choose


@contextmanager
def global_generators_seeded() -> Iterator[None]:
    """Seed NumPy's and Python's global generators, and restore their states afterwards."""
    before = np.random.get_state(), random.getstate()  # noqa: NPY002
    np.random.seed(0)  # noqa: NPY002
    random.seed(0)
    try:
        yield
    finally:
        np.random.set_state(before[0])  # noqa: NPY002
        random.setstate(before[1])


def _sample(agent: str, space: Space, mask: Any) -> Any:
    return space.sample() if mask is None else space.sample(mask)


def _named(names: tuple[str, ...], returned: Any, method: str) -> dict[str, Any]:
    if not isinstance(returned, tuple) or len(returned) != len(names) or not all(isinstance(r, dict) for r in returned):
        raise Fault(f"{method}() must return {len(names)} dictionaries ({', '.join(names)}); got {returned!r:.200}")
    return dict(zip(names, returned, strict=True))


def _masks(step: dict[str, Any]) -> dict[str, Any]:
    """Action masks, which PettingZoo environments put into observations or infos."""
    masks = {}
    for part in ("infos", "observations"):
        for agent, value in step[part].items():
            if isinstance(value, dict) and "action_mask" in value:
                masks[agent] = value["action_mask"]
    return masks
