"""Agent-steps per second of VMAS's simple_spread with 8 agents, a batch of copies; run in an environment with vmas."""

import json
import sys
import time

import torch
import vmas

batch, threads, seconds = int(sys.argv[1]), int(sys.argv[2]), float(sys.argv[3])
torch.set_num_threads(threads)
env = vmas.make_env(
    scenario="simple_spread", num_envs=batch, device="cpu", continuous_actions=True, seed=0, max_steps=None, n_agents=8
)
env.reset()
pool = [[env.get_random_action(agent) for agent in env.agents] for _ in range(8)]
with torch.no_grad():
    for actions in pool:
        env.step(actions)
    steps, start = 0, time.perf_counter()
    while (elapsed := time.perf_counter() - start) < seconds or steps == 0:
        env.step(pool[steps % 8])
        steps += 1
        if steps % 200 == 0:
            env.reset()
print(json.dumps({"agent_steps_per_s": 8 * batch * steps / elapsed}))
