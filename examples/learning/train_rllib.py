"""RLlib: PPO on several env runners, with one policy for all agents or one per type; a checkpoint that continues.

python -m venv .venv-ray
.venv-ray/bin/pip install -c constraints.txt -e '.[ray]' torch
.venv-ray/bin/python examples/learning/train_rllib.py
.venv-ray/bin/python examples/learning/train_rllib.py --per-type

An environment of its own, because Ray asks for one version of Gymnasium.
"""

import argparse
import logging
import os
from importlib import import_module
from pathlib import Path

os.environ.setdefault("RAY_BACKEND_LOG_LEVEL", "fatal")
os.environ.setdefault("RAY_ACCEL_ENV_VAR_OVERRIDE_ON_ZERO", "0")

import numpy as np
import ray
import torch
from pettingzoo.utils import BaseParallelWrapper
from ray.rllib.algorithms.ppo import PPO, PPOConfig
from ray.rllib.env.wrappers.pettingzoo_env import ParallelPettingZooEnv
from ray.tune.registry import register_env

from khop_env import environments

CYCLES, EPISODES = 100, 16  # control periods in an episode; episodes in an iteration, by all env runners together
SCALE = 0.05  # of rewards while learning, for values of order one

parser = argparse.ArgumentParser(description="PPO by RLlib")
parser.add_argument("environment", nargs="?", default="consensus_v0", choices=environments())
parser.add_argument("--scenario", help="default: mixed_fleet with --per-type, else the environment's own")
parser.add_argument("--observe", default="estimate", choices=("estimate", "oracle", "local"))
parser.add_argument("--per-type", action="store_true", help="one policy for each type of agent, not one for all")
parser.add_argument("--iterations", type=int, default=5)
parser.add_argument("--env-runners", type=int, default=2)
parser.add_argument("--out", type=Path, default=Path("runs/rllib"), help="folder of the checkpoint")
options = parser.parse_args()


class Scaled(BaseParallelWrapper):
    def step(self, actions):
        observations, rewards, *rest = super().step(actions)
        return observations, {agent: SCALE * reward for agent, reward in rewards.items()}, *rest


def make(config) -> ParallelPettingZooEnv:
    return ParallelPettingZooEnv(Scaled(import_module(f"khop_env.{options.environment}").parallel_env(**config)))


def policy_of(agent, episode=None, **_) -> str:
    return agent.rpartition("_")[0] if options.per_type else "shared"  # an id is a type and a number


def rows(part) -> dict[str, np.ndarray]:
    """All parameters of each policy as one vector, of a learner or an env runner."""
    parameters = {name: part.module[name].parameters() for name in policies}
    return {
        name: np.concatenate([each.detach().numpy().ravel() for each in group]) for name, group in parameters.items()
    }


def weights(algorithm) -> list[dict[str, np.ndarray]]:
    """Parameters of the learner, and of each env runner."""
    learner = [result.get() for result in algorithm.learner_group.foreach_learner(rows)]
    return learner + algorithm.env_runner_group.foreach_env_runner(rows)


def train(algorithm) -> dict:
    result = algorithm.train()
    sampled = result["env_runners"]
    returns = {name: value / SCALE for name, value in sampled["module_episode_returns_mean"].items()}
    steps = sampled["num_env_steps_sampled_lifetime"]
    each = ", ".join(f"{name} {returns[name]:.0f}" for name in policies)
    print(f"iteration {result['training_iteration']}: {steps:.0f} steps, return {sum(returns.values()):.0f} ({each})")
    return result


arguments = {"observe": options.observe, "max_cycles": CYCLES}
if scenario := options.scenario or ("mixed_fleet" if options.per_type else None):
    arguments["scenario"] = scenario
policies = sorted({policy_of(agent) for agent in make(arguments).possible_agents})
register_env("khop", make)
torch.set_num_threads(1)
ray.init(num_cpus=1 + options.env_runners, include_dashboard=False, logging_level=logging.ERROR, log_to_driver=False)
logging.getLogger("ray.rllib").setLevel(logging.ERROR)
config = (
    PPOConfig()
    .environment("khop", env_config=arguments)
    # An env runner with this many open requests (default: 1) gets no new weights; on a busy machine a restored
    # algorithm would sample with random weights.
    .env_runners(num_env_runners=options.env_runners, max_requests_in_flight_per_env_runner=10)
    .multi_agent(policies=set(policies), policy_mapping_fn=policy_of)
    .rl_module(model_config={"fcnet_hiddens": [64, 64]})
    .training(train_batch_size_per_learner=EPISODES * CYCLES, minibatch_size=1024, num_epochs=10)
    .training(gamma=0.95, lr=1e-3, use_kl_loss=False)  # a checkpoint lacks the coefficient of the KL loss
    .reporting(metrics_num_episodes_for_smoothing=EPISODES)
    .debugging(seed=0)
)
algorithm = config.build_algo()
fresh = weights(algorithm)[0]
for _ in range(options.iterations):
    train(algorithm)
trained = weights(algorithm)
assert all((trained[0][name] != fresh[name]).any() for name in policies), "a policy didn't learn"

# each env runner has episodes of its own
runners = algorithm.env_runner_group
states = runners.foreach_env_runner(lambda runner: runner.env.envs[0].unwrapped.par_env.state(), local_env_runner=False)
assert len(states) == len({state.tobytes() for state in states}) == options.env_runners, states

checkpoint = algorithm.save_to_path(options.out.resolve())
algorithm.stop()
restored = PPO.from_checkpoint(checkpoint)
for found, saved in zip(weights(restored), trained, strict=True):
    assert all((found[name] == saved[name]).all() for name in policies), "the restored weights differ"
result = train(restored)
assert result["training_iteration"] == options.iterations + 1, result["training_iteration"]
assert result["env_runners"]["num_env_steps_sampled_lifetime"] >= (options.iterations + 1) * EPISODES * CYCLES
restored.stop()
ray.shutdown()
print(
    f"Ray {ray.__version__}: {len(policies)} policies, {options.env_runners} env runners; checkpoint in {options.out}"
)
