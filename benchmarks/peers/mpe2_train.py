"""Agent-steps per second inside PPO.learn on MPE2's simple_spread, 64 environments of 8 agents, through SuperSuit.

Run in an environment with mpe2, supersuit and stable-baselines3. The hyper-parameters are those of
`benchmarks.training`.
"""

import json
import os
import sys
import time

os.environ.setdefault("SDL_VIDEODRIVER", "dummy")

import supersuit
import torch
from mpe2 import simple_spread_v3
from stable_baselines3 import PPO
from stable_baselines3.common.vec_env import VecNormalize
from torch import nn

timesteps = int(sys.argv[1])
torch.set_num_threads(1)
single = supersuit.pettingzoo_env_to_vec_env_v1(
    simple_spread_v3.parallel_env(N=8, continuous_actions=True, max_cycles=200)
)
env = VecNormalize(
    supersuit.concat_vec_envs_v1(single, 64, num_cpus=0, base_class="stable_baselines3"), norm_obs=False, gamma=0.95
)
model = PPO(
    "MlpPolicy",
    env,
    learning_rate=lambda remaining: 2e-3 * remaining,
    ent_coef=0.02,
    n_steps=8,
    batch_size=1024,
    n_epochs=8,
    gamma=0.95,
    gae_lambda=0.9,
    policy_kwargs={"net_arch": {"pi": [64, 64], "vf": [64, 64]}, "activation_fn": nn.ReLU, "log_std_init": 0.5},
    device="cpu",
)
model.learn(4_096)
before, start = model.num_timesteps, time.perf_counter()
model.learn(timesteps, reset_num_timesteps=False)
print(json.dumps({"agent_steps_per_s": (model.num_timesteps - before) / (time.perf_counter() - start)}))
