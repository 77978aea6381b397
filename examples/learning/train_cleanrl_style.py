"""PPO in one file, in the style of CleanRL: a network for all agents, over `khop_env.make_vec`, to read and to change.

.venv/bin/python -m pip install -c constraints.txt -e . torch
.venv/bin/python examples/learning/train_cleanrl_style.py
.venv/bin/python examples/learning/train_cleanrl_style.py leader_following_v0 --scenario convoy --timesteps 1000000
"""

import argparse
import time
from pathlib import Path

import numpy as np
import torch
from torch import nn
from torch.distributions import Normal

import khop_env
from agents import evaluate, make_policy

STEPS = 16  # control periods between updates
EPOCHS, MINIBATCH = 4, 1024
GAMMA, LAMBDA, CLIP, RATE = 0.95, 0.9, 0.2, 1e-3


class Agent(nn.Module):
    """Actor and critic, which all agents share; as a policy of khop_env it acts without exploration."""

    def __init__(self, observed: int, inputs: int) -> None:
        super().__init__()
        self.actor = nn.Sequential(nn.Linear(observed, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh())
        self.mean = nn.Linear(64, inputs)
        self.log_std = nn.Parameter(torch.full((inputs,), -0.5))
        self.critic = nn.Sequential(
            nn.Linear(observed, 64), nn.Tanh(), nn.Linear(64, 64), nn.Tanh(), nn.Linear(64, 1), nn.Flatten(0)
        )
        nn.init.orthogonal_(self.mean.weight, 0.01)

    def actions(self, observations: torch.Tensor) -> Normal:
        return Normal(self.mean(self.actor(observations)), self.log_std.exp())

    def reset(self, env, seeds) -> None:
        """Called before evaluation; there is no memory to clear."""

    @torch.no_grad()
    def act(self, observations):
        return {
            agent: self.mean(self.actor(torch.as_tensor(row))).numpy().clip(-1, 1)
            for agent, row in observations.items()
        }


def advantages(rewards, values, following, ended) -> torch.Tensor:
    """Generalised advantage estimates; all arguments (steps, rows).

    Args:
        rewards: r of each step.
        values: V of the observation before it.
        following: V of the observation after it, of its own episode: 0 where the episode was terminated, and V of the
            last observation where the horizon truncated it.
        ended: whether the next step belongs to another episode.
    """
    errors = rewards + GAMMA * following - values
    found, later = torch.zeros_like(errors), torch.zeros_like(errors[0])
    for step in reversed(range(len(errors))):
        found[step] = later = errors[step] + GAMMA * LAMBDA * later * ~ended[step]
    return found


@torch.no_grad()
def collect(envs, agent: Agent, observations: np.ndarray) -> tuple[np.ndarray, list[torch.Tensor]]:
    """Play STEPS control periods; the next observations, and those, actions, log-probabilities, values, advantages."""
    steps = []
    for _ in range(STEPS):
        now = torch.as_tensor(observations)
        action = (distribution := agent.actions(now)).sample()
        # the environment clips; the probability is of what the network drew
        observations, reward, terminated, truncated, infos = envs.step(action.numpy().clip(-1, 1))
        following = agent.critic(torch.as_tensor(observations))
        if truncated.any():  # `observations` has the next episode's first rows there
            last = np.stack(infos["final_obs"][truncated])
            following[torch.as_tensor(truncated)] = agent.critic(torch.as_tensor(last))
        following[torch.as_tensor(terminated)] = 0.0
        ended = torch.as_tensor(terminated | truncated)
        reward = torch.as_tensor(reward, dtype=torch.float32)
        steps.append((now, action, distribution.log_prob(action).sum(1), agent.critic(now), reward, following, ended))
    now, action, log_prob, value, reward, following, ended = map(torch.stack, zip(*steps, strict=True))
    advantage = advantages(reward, value, following, ended)
    return observations, [part.flatten(0, 1) for part in (now, action, log_prob, value, advantage)]


def update(agent: Agent, optimiser: torch.optim.Optimizer, parts: list[torch.Tensor]) -> None:
    """PPO's clipped loss, and the squared error of the critic."""
    for _ in range(EPOCHS):
        for rows in torch.randperm(len(parts[0])).split(MINIBATCH):
            observation, action, log_prob, value, advantage = (part[rows] for part in parts)
            ratio = (agent.actions(observation).log_prob(action).sum(1) - log_prob).exp()
            scaled = (advantage - advantage.mean()) / (advantage.std() + 1e-8)
            policy_loss = -torch.minimum(ratio * scaled, ratio.clamp(1 - CLIP, 1 + CLIP) * scaled).mean()
            value_loss = (agent.critic(observation) - value - advantage).square().mean()
            optimiser.zero_grad()
            (policy_loss + 0.5 * value_loss).backward()
            nn.utils.clip_grad_norm_(agent.parameters(), 0.5)
            optimiser.step()


def main() -> None:
    parser = argparse.ArgumentParser(description="PPO in one file")
    parser.add_argument("environment", nargs="?", default="consensus_v0", choices=khop_env.environments())
    parser.add_argument("--scenario", help="default: the environment's own")
    parser.add_argument("--observe", default="estimate", choices=("estimate", "oracle", "local"))
    parser.add_argument("--timesteps", type=int, default=500_000, help="agent-steps")
    parser.add_argument("--num-envs", type=int, default=64)
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument("--out", type=Path, default=Path("runs/cleanrl_style.pt"))
    options = parser.parse_args()

    torch.set_num_threads(1)  # small networks: more threads wait for each other
    torch.manual_seed(options.seed)
    where = {"observe": options.observe} | ({"scenario": options.scenario} if options.scenario else {})
    envs = khop_env.make_vec(options.environment, num_envs=options.num_envs, autoreset_mode="same_step", **where)
    held_out = khop_env.make_batched(options.environment, num_envs=25, **where)
    agent = Agent(envs.single_observation_space.shape[0], envs.single_action_space.shape[0])
    optimiser = torch.optim.Adam(agent.parameters(), lr=RATE, eps=1e-5)

    def mean_return() -> float:
        return evaluate(held_out, {"ppo": agent}, seeds=range(50))["return"].mean()

    observations, _ = envs.reset(seed=options.seed)
    untrained, begun = mean_return(), time.perf_counter()
    updates = max(1, options.timesteps // (STEPS * envs.num_envs))
    for number in range(updates):
        optimiser.param_groups[0]["lr"] = RATE * (1 - number / updates)
        observations, parts = collect(envs, agent, observations)
        update(agent, optimiser, parts)
        if number % 10 == 9:
            played = (number + 1) * STEPS * envs.num_envs
            speed = played / (time.perf_counter() - begun)
            print(f"{played} agent-steps, {speed:.0f}/s: mean return {mean_return():.2f}", flush=True)
    trained, zero = mean_return(), evaluate(held_out, {"zero": make_policy("zero")}, seeds=range(50))["return"].mean()
    options.out.parent.mkdir(parents=True, exist_ok=True)
    torch.save(agent.state_dict(), options.out)
    assert trained > untrained, f"no progress: return {untrained:.2f} before, {trained:.2f} after"
    agents = len(held_out.agents)
    print(
        f"PyTorch {torch.__version__}: {agents} agents, mean return of 50 episodes {untrained:.2f} to {trained:.2f} "
        f"(doing nothing: {zero:.2f}); network in {options.out}"
    )


if __name__ == "__main__":
    main()
