"""Agent-steps per second of MPE2's simple_spread with 8 agents, one ParallelEnv; run in an environment with mpe2."""

import json
import os
import sys
import time

import numpy as np

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")

from mpe2 import simple_spread_v3

seconds = float(sys.argv[3])
env = simple_spread_v3.parallel_env(N=8, continuous_actions=True, max_cycles=200)
env.reset(seed=0)
rng = np.random.default_rng(0)
pool = [{agent: rng.random(5, dtype=np.float32) for agent in env.possible_agents} for _ in range(64)]
for actions in pool[:10]:
    env.step(actions)
steps, start = 0, time.perf_counter()
while (elapsed := time.perf_counter() - start) < seconds:
    env.step(pool[steps % 64])
    steps += 1
    if not env.agents:
        env.reset()
print(json.dumps({"agent_steps_per_s": 8 * steps / elapsed}))
