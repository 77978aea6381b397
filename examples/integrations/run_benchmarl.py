"""BenchMARL: MAPPO and IPPO on an environment of khop_env, through BenchMARL's PettingZoo task.

make integration-benchmarl

BenchMARL lists the PettingZoo environments that it makes by name; another one is a subclass of its task.
"""

import logging
import os
import tempfile
import warnings

os.environ.setdefault("TQDM_DISABLE", "1")

from importlib.metadata import version

import torch
from benchmarl.algorithms import IppoConfig, MappoConfig
from benchmarl.environments.pettingzoo.common import PettingZooClass
from benchmarl.experiment import Callback, Experiment, ExperimentConfig
from benchmarl.models.mlp import MlpConfig
from torchrl.envs import PettingZooWrapper, RewardScaling

from khop_env import consensus_v0

CYCLES, COPIES, ITERATIONS = 100, 8, 6
SCALE = 0.05  # of rewards while learning, for values of order one


class KHopTask(PettingZooClass):
    """The rest is BenchMARL's own: agents are grouped by type, and the state is that of the environment."""

    def get_env_fun(self, num_envs, continuous_actions, seed, device):
        return lambda: PettingZooWrapper(
            consensus_v0.parallel_env(**self.config), return_state=True, seed=seed, device=device
        )

    def supports_continuous_actions(self):
        return True

    def supports_discrete_actions(self):
        return False

    def has_state(self):
        return True

    def has_render(self, env):
        return False

    def get_env_transforms(self, env):
        return [RewardScaling(loc=0.0, scale=SCALE, in_keys=[(group, "reward") for group in env.group_map])]


class Returns(Callback):
    """Mean return of an agent in each iteration; checks groups, and that the horizon truncates."""

    def __init__(self) -> None:
        super().__init__()
        self.found = []

    def on_batch_collected(self, batch):
        ((group, agents),) = self.experiment.group_map.items()
        assert agents == consensus_v0.parallel_env().possible_agents
        assert all(agent.rpartition("_")[0] == group for agent in agents)
        following = batch["next", group]
        assert following["reward"].shape == (COPIES, CYCLES, len(agents), 1)
        assert following["done"][:, -1].all()
        assert not following["done"][:, :-1].any()
        assert not following["terminated"].any()  # so the value of the last state counts
        self.found.append(following["reward"].sum(dim=1).mean().item() / SCALE)


def train(algorithm) -> list[float]:
    """Mean returns by iteration."""
    config = ExperimentConfig.get_from_yaml()
    config.gamma, config.lr = 0.95, 1e-3
    config.on_policy_n_envs_per_worker = COPIES
    config.on_policy_collected_frames_per_batch = COPIES * CYCLES
    config.on_policy_n_minibatch_iters, config.on_policy_minibatch_size = 10, 400
    config.max_n_frames = ITERATIONS * COPIES * CYCLES
    config.evaluation, config.loggers, config.create_json = False, [], False
    returns, network = Returns(), {"num_cells": [64, 64], "activation_class": torch.nn.Tanh}
    with tempfile.TemporaryDirectory() as folder:
        config.save_folder = folder
        Experiment(
            task=KHopTask("CONSENSUS", {"max_cycles": CYCLES}),
            algorithm_config=algorithm.get_from_yaml(),
            model_config=MlpConfig(layer_class=torch.nn.Linear, **network),
            critic_model_config=MlpConfig(layer_class=torch.nn.Linear, **network),
            seed=0,
            config=config,
            callbacks=[returns],
        ).run()
    assert len(returns.found) == ITERATIONS, returns.found
    assert returns.found[-1] > returns.found[0], f"no progress: {returns.found}"
    return returns.found


logging.getLogger("torchrl").setLevel(logging.ERROR)
warnings.filterwarnings("ignore", message="PettingZoo in TorchRL is tested using")
warnings.filterwarnings("ignore", message="SyncDataCollector has been deprecated")
torch.set_num_threads(1)
mappo, ippo = train(MappoConfig), train(IppoConfig)
print(
    f"BenchMARL {version('benchmarl')} on TorchRL {version('torchrl')}: {ITERATIONS * COPIES * CYCLES} steps, mean "
    f"return of an agent {mappo[0]:.1f} to {mappo[-1]:.1f} by MAPPO, {ippo[0]:.1f} to {ippo[-1]:.1f} by IPPO"
)
