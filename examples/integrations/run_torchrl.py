"""TorchRL: specs, agents grouped by type, and seeded rollouts to the horizon.

python -m venv .venv-torchrl
.venv-torchrl/bin/pip install -c constraints.txt -e . 'torchrl>=0.7'
.venv-torchrl/bin/python examples/integrations/run_torchrl.py
"""

import logging
import warnings

import torch
import torchrl
from torchrl.envs import MarlGroupMapType, PettingZooWrapper, check_env_specs

from khop_env import consensus_v0

CYCLES = 20

logging.getLogger("torchrl").setLevel(logging.ERROR)
warnings.filterwarnings("ignore", message="PettingZoo in TorchRL is tested using")


def wrapped(group_map=None, **arguments) -> PettingZooWrapper:
    env = consensus_v0.parallel_env("mixed_fleet", max_cycles=CYCLES, **arguments)
    env = PettingZooWrapper(env, return_state=True, group_map=group_map)
    check_env_specs(env)
    return env


def rollout(env):
    env.set_seed(0)
    torch.manual_seed(0)
    return env.rollout(2 * CYCLES)


env = wrapped()  # a group is a type of agent: what stands before the number in an id
assert all(agent.rpartition("_")[0] == group for group, agents in env.group_map.items() for agent in agents)
data = rollout(env)
assert data.batch_size == (CYCLES,)
assert data["next", "truncated"].squeeze().tolist() == [False] * (CYCLES - 1) + [True]
assert not data["next", "terminated"].any()
assert (data == rollout(env)).all(), "the same seed gave another episode"

ragged = wrapped(MarlGroupMapType.ONE_GROUP_PER_AGENT, uniform=False)  # exactly what each agent has
data = rollout(ragged)
widths = sorted(data[agent, "observation"].shape[-1] for agent in ragged.possible_agents)
groups = ", ".join(f"{len(agents)} {group}" for group, agents in env.group_map.items())
print(f"TorchRL {torchrl.__version__}: rollouts of {groups}; with observations of {widths[0]} to {widths[-1]} numbers")
