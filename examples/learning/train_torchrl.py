"""TorchRL: MAPPO, with a shared actor and a critic on all observations; IPPO by a flag.

python -m venv .venv-torchrl
.venv-torchrl/bin/pip install -c constraints.txt -e . 'torchrl>=0.14'
.venv-torchrl/bin/python examples/learning/train_torchrl.py
.venv-torchrl/bin/python examples/learning/train_torchrl.py --ippo
"""

import argparse
import logging
import warnings
from importlib import import_module

import torch
import torchrl
from tensordict.nn import NormalParamExtractor, TensorDictModule
from torchrl.collectors import Collector
from torchrl.envs import MarlGroupMapType, PettingZooWrapper, RewardScaling, TransformedEnv
from torchrl.modules import MultiAgentMLP, ProbabilisticActor, TanhNormal
from torchrl.objectives import ClipPPOLoss

from khop_env import environments

CYCLES, EPISODES = 100, 16  # control periods in an episode; episodes in an iteration
EPOCHS, MINIBATCH = 10, 400  # passes over an iteration's steps; steps in a minibatch
SCALE = 0.05  # of rewards while learning, for values of order one
GAMMA = 0.95

parser = argparse.ArgumentParser(description="MAPPO or IPPO by TorchRL")
parser.add_argument("environment", nargs="?", default="consensus_v0", choices=environments())
parser.add_argument("--scenario", help="default: the environment's own")
parser.add_argument("--observe", default="estimate", choices=("estimate", "oracle", "local"))
parser.add_argument("--ippo", action="store_true", help="a critic on the own observation only")
parser.add_argument("--iterations", type=int, default=12)
options = parser.parse_args()

logging.getLogger("torchrl").setLevel(logging.ERROR)
warnings.filterwarnings("ignore", message="PettingZoo in TorchRL is tested using")
warnings.filterwarnings("ignore", message="The env passed to Collector is missing")
warnings.filterwarnings(
    "ignore", message="You requested advantage normalization"
)  # over agents, too: they share an actor
torch.set_num_threads(1)
torch.manual_seed(0)

arguments = {"observe": options.observe, "max_cycles": CYCLES}
if options.scenario:
    arguments["scenario"] = options.scenario
raw = import_module(f"khop_env.{options.environment}").parallel_env(**arguments)
env = PettingZooWrapper(raw, group_map=MarlGroupMapType.ALL_IN_ONE_GROUP)
env = TransformedEnv(env, RewardScaling(loc=0.0, scale=SCALE, in_keys=[("agents", "reward")]))
env.set_seed(0)
agents, observed = env.observation_spec["agents", "observation"].shape
inputs = env.full_action_spec[env.action_key].shape[-1]


def network(outputs: int, centralized: bool) -> MultiAgentMLP:
    shape = {"n_agent_inputs": observed, "n_agent_outputs": outputs, "n_agents": agents}
    return MultiAgentMLP(**shape, centralized=centralized, share_params=True, depth=2, num_cells=64)


actor = ProbabilisticActor(
    TensorDictModule(
        torch.nn.Sequential(network(2 * inputs, centralized=False), NormalParamExtractor()),
        in_keys=[("agents", "observation")],
        out_keys=[("agents", "loc"), ("agents", "scale")],
    ),
    in_keys=[("agents", "loc"), ("agents", "scale")],
    out_keys=[env.action_key],
    distribution_class=TanhNormal,  # inputs are in [-1, 1]
    return_log_prob=True,
)
critic = TensorDictModule(
    network(1, centralized=not options.ippo), in_keys=[("agents", "observation")], out_keys=[("agents", "state_value")]
)
loss = ClipPPOLoss(actor, critic, entropy_coeff=1e-3, normalize_advantage=True)
loss.set_keys(
    reward=env.reward_key,
    action=env.action_key,
    value=("agents", "state_value"),
    done=("agents", "done"),  # where an episode ends
    terminated=("agents", "terminated"),  # where nothing follows; at the horizon the value of the next state counts
    sample_log_prob=("agents", "action_log_prob"),
)
loss.make_value_estimator(gamma=GAMMA, lmbda=0.95)
optimiser = torch.optim.Adam(loss.parameters(), lr=1e-3)
steps = CYCLES * EPISODES
collector = Collector(env, actor, frames_per_batch=steps, total_frames=steps * options.iterations)

returns = []
for data in collector:
    returns.append(data["next", "agents", "reward"].sum().item() / SCALE / EPISODES / agents)
    print(
        f"iteration {len(returns)}: {steps * len(returns)} steps, mean return of an agent {returns[-1]:.1f}", flush=True
    )
    with torch.no_grad():
        loss.value_estimator(data, params=loss.critic_network_params, target_params=loss.target_critic_network_params)
    ahead, now = data["next", "agents"], data["agents"]
    last = ahead["truncated"]
    assert last.sum() == EPISODES * agents
    assert not ahead["terminated"].any()
    bootstrapped = ahead["reward"] + GAMMA * ahead["state_value"]
    torch.testing.assert_close(data["value_target"][last], bootstrapped[last])
    for _ in range(EPOCHS):
        for rows in torch.randperm(steps).split(MINIBATCH):
            losses = loss(data[rows])
            optimiser.zero_grad()
            sum(value for name, value in losses.items() if name.startswith("loss_")).backward()
            torch.nn.utils.clip_grad_norm_(loss.parameters(), 1.0)
            optimiser.step()
collector.shutdown()
assert options.iterations == 1 or returns[-1] > returns[0], "no progress"
name = "IPPO" if options.ippo else "MAPPO"
print(f"TorchRL {torchrl.__version__}: {name} of {agents} agents, mean return {returns[0]:.1f} to {returns[-1]:.1f}")
