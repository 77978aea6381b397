"""Tianshou: episodes of the AEC environment, and an update by its multi-agent PPO, one network for all agents.

python -m venv .venv-tianshou
.venv-tianshou/bin/pip install -c constraints.txt -e . 'tianshou>=2.0'
.venv-tianshou/bin/python examples/integrations/run_tianshou.py
"""

import logging

import tianshou
import torch
from tianshou.algorithm import PPO
from tianshou.algorithm.modelfree.reinforce import ProbabilisticActorPolicy
from tianshou.algorithm.multiagent.marl import MultiAgentOnPolicyAlgorithm, MultiAgentPolicy
from tianshou.algorithm.optim import AdamOptimizerFactory
from tianshou.data import Batch, Collector, VectorReplayBuffer
from tianshou.env import DummyVectorEnv, PettingZooEnv
from tianshou.utils.net.common import Net
from tianshou.utils.net.continuous import ContinuousActorProbabilistic, ContinuousCritic
from tianshou.utils.torch_utils import policy_within_training_step
from torch.distributions import Independent, Normal

from khop_env import consensus_v0

CYCLES, COPIES = 20, 2


class TeamPolicy(MultiAgentPolicy):
    """Tianshou 2.0 looks for `obs_next` where there is no action mask, and while collecting there is none."""

    def forward(self, batch, state=None, **rest):
        return super().forward(Batch(batch, obs_next=Batch()), state, **rest)


def make() -> PettingZooEnv:
    return PettingZooEnv(consensus_v0.env(max_cycles=CYCLES))


def net() -> Net:
    return Net(state_shape=env.observation_space.shape, hidden_sizes=(64, 64))


logging.getLogger("tianshou").setLevel(logging.ERROR)
torch.manual_seed(0)
env = make()
actor = ContinuousActorProbabilistic(preprocess_net=net(), action_shape=env.action_space.shape, unbounded=True)
policy = ProbabilisticActorPolicy(
    actor=actor,
    dist_fn=lambda parameters: Independent(Normal(*parameters), 1),
    action_space=env.action_space,
    action_scaling=False,  # the environment clips
    action_bound_method=None,
)
ppo = PPO(policy=policy, critic=ContinuousCritic(preprocess_net=net()), optim=AdamOptimizerFactory())
team = MultiAgentOnPolicyAlgorithm(algorithms=[ppo] * len(env.agents), env=env)

envs = DummyVectorEnv([make] * COPIES)
envs.seed(0)
collector = Collector(TeamPolicy(team.policy.policies), envs, VectorReplayBuffer(10_000, COPIES))
collected = collector.collect(n_episode=COPIES, reset_before_collect=True)
assert collected.n_collected_steps == COPIES * CYCLES * len(env.agents), collected
assert collected.returns.shape == (COPIES, len(env.agents)), collected

before = torch.cat([weight.detach().ravel() for weight in actor.parameters()])
with policy_within_training_step(team.policy):
    team.update(collector.buffer, batch_size=64, repeat=1)
after = torch.cat([weight.detach().ravel() for weight in actor.parameters()])
assert after.isfinite().all()
assert (after != before).any()
print(
    f"Tianshou {tianshou.__version__}: {collected.n_collected_steps} turns of {len(env.agents)} agents, "
    f"a team's return of {collected.returns.sum(axis=1).mean():.1f}, and an update"
)
