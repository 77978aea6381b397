"""AgileRL: IPPO with a network for each type of agent, over copies of the environment in processes of their own.

make integration-agilerl
"""

from importlib.metadata import version

import numpy as np
import torch
from agilerl.algorithms import IPPO
from agilerl.training.train_multi_agent_on_policy import train_multi_agent_on_policy
from agilerl.vector import AsyncPettingZooVecEnv
from pettingzoo.utils import BaseParallelWrapper

from agents import evaluate
from khop_env import consensus_v0

CYCLES, COPIES, UPDATES = 100, 4, 12
SCALE = 0.05  # of rewards while learning, for values of order one


class Scaled(BaseParallelWrapper):
    def step(self, actions):
        observations, rewards, *rest = super().step(actions)
        return observations, {agent: SCALE * reward for agent, reward in rewards.items()}, *rest


class Played:
    """The trained networks as a policy of khop_env."""

    def __init__(self, learner: IPPO) -> None:
        self.learner = learner

    def reset(self, env, seeds) -> None:
        self.learner.set_training_mode(False)  # no exploration, and actions are clipped

    def act(self, observations):
        return self.learner.get_action(observations)[0]


def make():
    return Scaled(consensus_v0.parallel_env(max_cycles=CYCLES))


def ippo(env) -> IPPO:
    """IPPO that learns from whole episodes: AgileRL 2.58.0 forgets an end of an episode inside an update."""
    return IPPO(
        observation_spaces=[env.observation_space(agent) for agent in env.possible_agents],
        action_spaces=[env.action_space(agent) for agent in env.possible_agents],
        agent_ids=list(env.possible_agents),
        learn_step=CYCLES * COPIES,
        batch_size=400,
        lr=1e-3,
        gamma=0.95,
        net_config={"encoder_config": {"hidden_size": [64, 64]}, "head_config": {"hidden_size": [64]}},
    )


def weights(learner: IPPO) -> torch.Tensor:
    """All parameters of the networks that act."""
    return torch.cat(
        [part.detach().ravel().clone() for actor in learner.actors.values() for part in actor.parameters()]
    )


def mean_return(learner: IPPO) -> float:
    env = consensus_v0.batched_env(num_envs=25, max_cycles=CYCLES)
    return evaluate(env, {"ippo": Played(learner)}, seeds=range(50))["return"].mean()


if __name__ == "__main__":
    torch.set_num_threads(1)
    torch.manual_seed(0)
    fleet = consensus_v0.parallel_env("mixed_fleet")
    groups = set(ippo(fleet).actors)
    assert groups == {agent.rpartition("_")[0] for agent in fleet.possible_agents}, groups

    vec = AsyncPettingZooVecEnv([make] * COPIES)
    learner = ippo(make())
    untrained, before = mean_return(learner), weights(learner)
    steps = UPDATES * CYCLES * COPIES
    (learner,), _ = train_multi_agent_on_policy(
        vec, "consensus_v0", "IPPO", [learner], max_steps=steps, evo_steps=steps, verbose=False
    )
    trained = mean_return(learner)
    after = weights(learner)
    assert after.isfinite().all()
    assert (after != before).any(), "nothing was learned"  # so short a training doesn't always raise the return
    assert np.isfinite(trained)
    print(
        f"AgileRL {version('agilerl')}: IPPO of {len(learner.agent_ids)} agents, mean return {untrained:.1f} to "
        f"{trained:.1f} in {steps} steps; a network each for {', '.join(sorted(groups))}"
    )
