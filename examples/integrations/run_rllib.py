"""RLlib: an iteration of PPO with one policy for all agents, sampled in this process and then by a worker.

python -m venv .venv-ray
.venv-ray/bin/pip install -c constraints.txt -e '.[ray]' torch
.venv-ray/bin/python examples/integrations/run_rllib.py

An environment of its own, because Ray asks for one version of Gymnasium.
"""

import logging
import os

os.environ.setdefault("RAY_BACKEND_LOG_LEVEL", "fatal")
os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")

import ray
from ray.rllib.algorithms.ppo import PPOConfig
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
from ray.tune.registry import register_env

from khop_env import consensus_v0

STEPS = 200

register_env("consensus", lambda config: ParallelPettingZooEnv(consensus_v0.parallel_env(**config)))
ray.init(num_cpus=2, include_dashboard=False, logging_level=logging.ERROR, log_to_driver=False)
logging.getLogger("ray.rllib").setLevel(logging.ERROR)
agents = consensus_v0.parallel_env().possible_agents
returns = []
for workers in (0, 1):
    config = (
        PPOConfig()
        .environment("consensus", env_config={"max_cycles": 50})
        .env_runners(num_env_runners=workers)
        .multi_agent(policies={"shared"}, policy_mapping_fn=lambda agent, episode, **_: "shared")
        .training(train_batch_size_per_learner=STEPS, minibatch_size=STEPS, num_epochs=1)
    )
    algorithm = config.build_algo()
    result = algorithm.train()
    algorithm.stop()
    sampled = result["env_runners"]
    steps = sampled["num_env_steps_sampled"]
    assert steps >= STEPS, sampled
    assert sampled["num_agent_steps_sampled"] == dict.fromkeys(agents, steps), sampled
    assert set(result["learners"]) == {"__all_modules__", "shared"}, result["learners"]
    returns.append(f"{sampled['episode_return_mean']:.1f}")
ray.shutdown()
print(f"Ray {ray.__version__}: {len(agents)} agents, return {returns[0]} in this process, {returns[1]} by a worker")
