"""A small environment that fulfils the contract, and variants that each violate it in one way."""

from __future__ import annotations

import copy
from typing import Any

import numpy as np
from gymnasium.spaces import Box
from pettingzoo import ParallelEnv

HORIZON = 12


class Walkers(ParallelEnv):
    """Two walkers on a line with noise; each observes its own position and the distance to the other."""

    metadata = {"name": "walkers", "is_parallelizable": True, "render_modes": []}  # noqa: RUF012
    decay = 0.9

    def __init__(self) -> None:
        self.render_mode = None
        self.possible_agents = ["walker_0", "walker_1"]
        self.agents: list[str] = []
        self.observation_spaces = {agent: Box(-20.0, 20.0, (2,), np.float32) for agent in self.possible_agents}
        self.action_spaces = {agent: Box(-1.0, 1.0, (1,), np.float32) for agent in self.possible_agents}
        self.state_space = Box(-10.0, 10.0, (2,), np.float32)
        self.rng: np.random.Generator | None = None
        self.seeded = False

    def observation_space(self, agent):
        return self.observation_spaces[agent]

    def action_space(self, agent):
        return self.action_spaces[agent]

    def state(self):
        return self.x.astype(np.float32)

    def generator(self, seed) -> np.random.Generator:
        if seed is not None or not self.seeded or self.rng is None:
            self.seeded |= seed is not None
            return np.random.default_rng(seed)
        return self.rng

    def reset(self, seed=None, options=None):
        self.rng, self.agents, self.t = self.generator(seed), list(self.possible_agents), 0
        self.x = self.rng.uniform(-1.0, 1.0, 2)
        return self.observe_all(), {agent: {} for agent in self.agents}

    def noise(self) -> Any:
        return 0.1 * self.rng.uniform(-1.0, 1.0, 2)

    def pushes(self, actions) -> np.ndarray:
        push = np.array([float(actions[agent][0]) for agent in self.possible_agents])
        if not np.isfinite(push).all():
            raise ValueError("an action isn't finite")
        return push

    def step(self, actions):
        self.t += 1
        self.x = self.decay * self.x + 0.3 * self.pushes(actions) + self.noise()
        seen, agents = self.observe_all(), self.agents
        terminated, truncated = self.over()
        if terminated or truncated:
            self.agents = []
        return (
            seen,
            {agent: -float(abs(self.x[0] - self.x[1])) for agent in agents},
            dict.fromkeys(agents, terminated),
            dict.fromkeys(agents, truncated),
            {agent: {} for agent in agents},
        )

    def over(self) -> tuple[Any, Any]:
        return False, self.t >= HORIZON

    def observe_all(self):
        difference = self.x[1] - self.x[0]
        return {agent: np.array([self.x[i], difference], np.float32) for i, agent in enumerate(self.possible_agents)}


class Drifting(Walkers):
    """Leaves its Box, but only under constant actions over a long time."""

    decay = 1.0

    def __init__(self) -> None:
        super().__init__()
        self.state_space = Box(-30.0, 30.0, (2,), np.float32)
        self.observation_spaces = {agent: Box(-4.0, 4.0, (2,), np.float32) for agent in self.possible_agents}


class DriftingState(Walkers):
    """state() leaves its Box under the same condition."""

    decay = 1.0

    def __init__(self) -> None:
        super().__init__()
        self.state_space = Box(-4.0, 4.0, (2,), np.float32)


class InfiniteReward(Walkers):
    def step(self, actions):
        observations, rewards, *others = super().step(actions)
        return observations, dict.fromkeys(rewards, -np.inf), *others


class Shaken(Walkers):
    """Observations with noise of its own entropy, too small for PettingZoo's test, which compares roughly."""

    def observe_all(self):
        noise = np.random.default_rng().uniform(0.0, 1e-6, 2).astype(np.float32)
        return {agent: observation + noise for agent, observation in super().observe_all().items()}


class Globally(Walkers):
    """Advances NumPy's global generator without need."""

    def noise(self):
        np.random.random()  # noqa: NPY002
        return super().noise()


class DeafToSeeds(Walkers):
    def generator(self, seed):
        return super().generator(None if seed is None else 0)


class BornSeeded(Walkers):
    """Draws from a generator created in the constructor until it is seeded."""

    def __init__(self) -> None:
        super().__init__()
        self.rng, self.seeded = np.random.default_rng(0), True


class Buffered(Walkers):
    """Writes every observation into the same array."""

    def __init__(self) -> None:
        super().__init__()
        self.buffers = {agent: np.zeros(2, np.float32) for agent in self.possible_agents}

    def observe_all(self):
        for agent, observation in super().observe_all().items():
            self.buffers[agent][...] = observation
        return dict(self.buffers)


class OneArray(Walkers):
    """Observations of both are parts of one array."""

    def observe_all(self):
        whole = np.concatenate(list(super().observe_all().values())).astype(np.float32)
        overlapping = whole[:3]
        return {"walker_0": overlapping[:2], "walker_1": overlapping[1:]}


class Lent(Walkers):
    """Returns its internal array."""

    def state(self):
        return self.x

    def __init__(self) -> None:
        super().__init__()
        self.state_space = Box(-10.0, 10.0, (2,), np.float64)


class KeepsActions(Walkers):
    """Uses the previous action's own array one step later."""

    def reset(self, seed=None, options=None):
        self.last = {agent: np.zeros(1, np.float32) for agent in self.possible_agents}
        return super().reset(seed, options)

    def pushes(self, actions):
        now = super().pushes(actions)
        before = np.array([float(self.last[agent][0]) for agent in self.possible_agents])
        self.last = {agent: actions[agent] for agent in self.possible_agents}
        return 0.5 * (now + np.nan_to_num(before))


class Forgetful(Walkers):
    """A pickled copy is built from the constructor's arguments alone, without state."""

    def __reduce__(self):
        return type(self), ()

    def __deepcopy__(self, memo):
        twin = type(self)()
        vars(twin).update(copy.deepcopy(vars(self), memo))
        return twin


class Siamese(Walkers):
    """A deep copy shares the generator."""

    def __deepcopy__(self, memo):
        twin = type(self)()
        vars(twin).update({key: copy.copy(value) for key, value in vars(self).items() if key != "rng"})
        twin.rng = self.rng
        return twin


class Terminating(Walkers):
    """Calls its time limit a termination."""

    def over(self):
        return self.t >= HORIZON, False


class Undecided(Walkers):
    """Both at once."""

    def over(self):
        return (self.t >= HORIZON,) * 2


class SwallowsNan(Walkers):
    def pushes(self, actions):
        return np.array([float(actions[agent][0]) for agent in self.possible_agents])


class NewSpaces(Walkers):
    """A new space at every call, whose seed is lost."""

    def observation_space(self, agent):
        return copy.deepcopy(self.observation_spaces[agent])


class LikeMpe2(Walkers):
    """Faults that MPE2 and PettingZoo's tests let pass: noise of NumPy's generator, nan outside the Box."""

    def noise(self):
        return 0.1 * np.random.uniform(-1.0, 1.0, 2)  # noqa: NPY002

    def observe_all(self):
        seen = super().observe_all()
        if self.agents and self.t == HORIZON:
            seen["walker_1"][1] = np.nan
        return seen


COPIED = r"copied after 4 steps, original and copy differ: call 0"
FAULTS = {
    Drifting: ("spaces", r"call \d+, step\(\), all actions at their lower bound: the observation of 'walker_"),
    DriftingState: (
        "spaces",
        r".* at their lower bound: state\(\) is outside its Box: entry \d is -4\..* -4.0 and 4.0",
    ),
    InfiniteReward: ("spaces", r"call 1, step\(\): the reward of 'walker_0' must be a finite number; got -inf"),
    # which entries differ is up to chance: some are rounded to the same number
    Shaken: (
        "same_seed",
        r"call \d+, \w+\(\): observations\['walker_\d'\]\[[01]\]: -?\d\.\d+(e-\d+)?, then -?\d\.\d+(e-\d+)?$",
    ),
    Globally: ("global_random", r"call 1, step\(\) moves NumPy's global generator"),
    DeafToSeeds: ("other_seed", r"seeds 0 and 1 give the same 20 steps"),
    BornSeeded: ("unseeded", r"two environments that were never seeded play the same 20 steps"),
    Buffered: ("memory", r"the return value of call 0, reset\(\) is written to later: returned\['observations'\]"),
    OneArray: ("memory", r"call 0, reset\(\): the observations of 'walker_0' and 'walker_1' share memory"),
    Lent: ("memory", r"state\(\), first call and state\(\), second call return the same memory"),
    KeepsActions: ("memory", r"writing into returned values or actions changes later steps: call 2"),
    Forgetful: ("pickle", COPIED),
    Siamese: ("deepcopy", COPIED),
    Terminating: ("episode_end", r"3 episodes of different seeds and actions all end after 12 steps, by termination"),
    Undecided: ("episode_end", r"call 12, step\(\): 'walker_0' is terminated and truncated at once"),
    SwallowsNan: ("nan_action", r"nan in the action of 'walker_0' isn't refused: the observation of 'walker_0' isn't"),
    NewSpaces: ("pettingzoo", r"AssertionError: observation_space should return the exact same space object"),
}
"""The only check that fails for each, and its message."""
