"""PufferLib's emulation of PettingZoo environments: copies side by side, and in worker processes.

make integration-pufferlib
"""

import numpy as np
import pufferlib
import pufferlib.vector
from pufferlib.emulation import PettingZooPufferEnv

from khop_env import consensus_v0

CYCLES, COPIES, SEED = 20, 2, 3


class Emulated(PettingZooPufferEnv):
    """Without infos: pufferlib-core 3.0.3 averages them by a function that it doesn't have."""

    def reset(self, seed=None):
        return super().reset(seed)[0], []

    def step(self, actions):
        return *super().step(actions)[:-1], []


def made(backend, **arguments):
    env = {"env_creator": consensus_v0.parallel_env, "env_kwargs": {"max_cycles": CYCLES}}
    return pufferlib.vector.make(Emulated, env_kwargs=env, backend=backend, num_envs=COPIES, **arguments)


def check(vec) -> float:
    """Hold rows against the environments themselves, over the end of an episode; mean return of an agent."""
    envs = [consensus_v0.parallel_env(max_cycles=CYCLES) for _ in range(COPIES)]
    agents = envs[0].possible_agents
    assert vec.num_agents == COPIES * len(agents)
    rows, _ = vec.reset(seed=SEED)
    first = rows.copy()  # of its shared memory
    expected = [env.reset(seed=SEED + copy)[0] for copy, env in enumerate(envs)]
    rng, total = np.random.default_rng(0), 0.0
    for cycle in range(CYCLES):
        found = np.concatenate([np.stack(list(observations.values())) for observations in expected])
        assert rows.tobytes() == found.tobytes(), f"observations differ in cycle {cycle}"
        actions = rng.uniform(-1, 1, (len(found), *vec.single_action_space.shape)).astype(np.float32)
        rows, reward, terminated, truncated, _ = vec.step(actions)
        expected, rewards = [], []
        for env, own in zip(envs, np.split(actions, COPIES), strict=True):
            observations, earned, *_ = env.step(dict(zip(agents, own, strict=True)))
            expected.append(observations)
            rewards += earned.values()
        assert np.allclose(reward, rewards, rtol=1e-6)
        assert not terminated.any()
        assert truncated.all() == truncated.any() == (cycle == CYCLES - 1)
        total += reward.mean()
    *_, terminated, truncated, _ = vec.step(actions)  # the step after the end only resets
    assert not terminated.any()
    assert not truncated.any()
    assert not np.array_equal(rows, first), "the second episode is the first one again"
    vec.close()
    return total


if __name__ == "__main__":  # workers may import this file
    alone = check(made(pufferlib.vector.Serial))
    workers = check(made(pufferlib.vector.Multiprocessing, num_workers=COPIES, overwork=True))
    assert alone == workers
    print(
        f"pufferlib-core {pufferlib.__version__}: rows equal the environment's, in this process and in {COPIES} "
        f"workers; truncated, not terminated, after {CYCLES} cycles; mean return of random actions {alone:.1f}"
    )
