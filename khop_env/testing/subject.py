"""The environment that is checked, how more of it are made, and how it is played."""

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
    """The environment breaks what a check asks of it."""


class Skip(Exception):  # noqa: N818
    """A check doesn't apply."""


class Subject:
    """An environment to check.

    Args:
        env: the environment, or a function that makes one.
        steps: in an episode or a comparison.
        seed: the first seed.

    Raises:
        ValueError: if it is no ParallelEnv, or a function that returns the same object twice.
    """

    def __init__(self, env: Any, steps: int, seed: int) -> None:
        self.steps, self.seed = steps, seed
        self._factory: Callable[[], Any] | None = None
        self._made: list[ParallelEnv] = []
        if not isinstance(env, ParallelEnv) and callable(env):
            self._factory, env = env, env()
        self.env = require_parallel(env)
        if self._factory is not None and self.another() is self.env:
            raise ValueError("the function returned one environment twice; it has to make a fresh one at each call")

    @property
    def name(self) -> str:
        """Its name in the report."""
        return str(self.env) if type(self.env).__str__ is not object.__str__ else type(self.env).__name__

    def another(self) -> ParallelEnv:
        """A fresh environment of the same kind.

        Raises:
            Skip: for an object that can be neither copied nor pickled.
        """
        made = self._copied() if self._factory is None else require_parallel(self._factory())
        self._made.append(made)
        return made

    def any(self) -> ParallelEnv:
        """A fresh environment where there is another one, otherwise the object itself."""
        try:
            return self.another()
        except Skip:
            return self.env

    def own(self) -> KHopEnv:
        """A fresh environment of this library, without its wrappers.

        Raises:
            Skip: for other environments.
        """
        if not isinstance(self.env.unwrapped, KHopEnv):
            raise Skip("only environments of khop_env can be seen as arrays and know who hears whom")
        return self.another().unwrapped

    def close(self) -> None:
        """Close what was made."""
        while self._made:
            self._made.pop().close()

    def require_repeatable(self) -> None:
        """Only an environment that repeats itself, global generators restored, can be compared with a copy of itself.

        Raises:
            Skip: if it doesn't.
        """
        if not self._repeatable:
            raise Skip("two runs with the same seed differ by themselves (same_seed), so that nothing can be compared")

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
        raise Skip(f"needs a second environment; give a function that makes one: {'; '.join(errors)}")


def require_parallel(env: Any) -> ParallelEnv:
    """The ParallelEnv inside what this library's other makers return.

    Raises:
        ValueError: if there is none.
    """
    for inner in (env, getattr(env, "unwrapped", None), getattr(getattr(env, "unwrapped", None), "env", None)):
        if isinstance(inner, ParallelEnv):
            return inner
    raise ValueError(
        f"expected a PettingZoo ParallelEnv, or a function that makes one; got {type(env).__name__}; an AEC "
        "environment becomes one by pettingzoo.utils.aec_to_parallel"
    )


def play(
    env: ParallelEnv, steps: int, seed: int, *, reset_seed: int | None = None, begin: bool = True, choose: Any = None
) -> Iterator[dict[str, Any]]:
    """Play episodes one after the other, of which only the first may be seeded.

    Args:
        env: the environment.
        steps: of all episodes together.
        seed: of the actions, which are drawn from copies of the action spaces.
        reset_seed: of the first reset.
        begin: whether to reset first, or to go on.
        choose: another `Chooser` than sampling.

    Yields:
        What reset and step return, by name.
    """
    spaces: dict[Any, Space] = {}
    for number, agent in enumerate(env.possible_agents):
        spaces[agent] = copy.deepcopy(env.action_space(agent))
        spaces[agent].seed(seed + number)
    masks: dict[str, Any] = {}
    for _ in range(steps):
        if begin or not env.agents:
            seen = _named(("observations", "infos"), env.reset(**({"seed": reset_seed} if begin else {})), "reset")
            begin, masks = False, _masks(seen)
            yield seen
        actions = {agent: (choose or _sample)(agent, spaces[agent], masks.get(agent)) for agent in env.agents}
        names = "observations", "rewards", "terminations", "truncations", "infos"
        seen = _named(names, env.step(actions), "step")
        masks = _masks(seen)
        yield {**seen, "actions": actions}


def record(env: ParallelEnv, steps: int, seed: int, **arguments: Any) -> list[dict[str, Any]]:
    """Copies of all that `play` yields, which nobody writes into."""
    return [copy.deepcopy(seen) for seen in play(env, steps, seed, **arguments)]


def first_difference(run: list[dict[str, Any]], again: list[dict[str, Any]]) -> str | None:
    """The first difference between two recordings of the same play."""
    for number, (first, second) in enumerate(zip(run, again, strict=False)):
        for key in first:
            if found := difference(first[key], second.get(key), key):
                return f"{called(number, first)}: {found}"
    return None


def called(number: int, seen: dict[str, Any]) -> str:
    """A call by its number: "call 3, step()"."""
    return f"call {number}, {'step' if 'rewards' in seen else 'reset'}()"


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
    """NumPy's and Python's global generators in a fixed state, and afterwards as they were."""
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


def _masks(seen: dict[str, Any]) -> dict[str, Any]:
    """Action masks, which PettingZoo has in observations or in infos."""
    masks = {}
    for part in ("infos", "observations"):
        for agent, value in seen[part].items():
            if isinstance(value, dict) and "action_mask" in value:
                masks[agent] = value["action_mask"]
    return masks
