"""Agent-steps per second of JaxMARL's simple_spread with 8 agents, one compiled step of the batch per call.

Run in an environment with jaxmarl; XLA chooses its number of threads.
"""

import json
import os
import sys
import time

os.environ["JAX_PLATFORMS"] = "cpu"

import jax
import jaxmarl

batch, seconds = int(sys.argv[1]), float(sys.argv[3])
env = jaxmarl.make("MPE_simple_spread_v3", num_agents=8, action_type="Continuous")
keys = jax.random.split(jax.random.PRNGKey(0), batch)
step = jax.jit(jax.vmap(env.step))
_, state = jax.jit(jax.vmap(env.reset))(keys)


def sample(key: jax.Array) -> dict[str, jax.Array]:
    """Random actions of one environment."""
    several = jax.random.split(key, env.num_agents)
    return {agent: env.action_space(agent).sample(key) for agent, key in zip(env.agents, several, strict=True)}


pool = [jax.jit(jax.vmap(sample))(jax.random.split(jax.random.PRNGKey(seed), batch)) for seed in range(8)]
for actions in pool:
    observations, state, *_ = step(keys, state, actions)
jax.block_until_ready(observations)
steps, start = 0, time.perf_counter()
while (elapsed := time.perf_counter() - start) < seconds or steps == 0:
    observations, state, *_ = step(keys, state, pool[steps % 8])
    jax.block_until_ready(observations)
    steps += 1
print(json.dumps({"agent_steps_per_s": 8 * batch * steps / elapsed}))
