"""A task of your own: agents go to goals of their own and keep apart. It works everywhere a built-in task does."""

from dataclasses import dataclass

import numpy as np

import khop_env
from agents import describe, evaluate, make_policy
from khop_env.tasks import Column, Outcome, Task


@dataclass(eq=False, kw_only=True)
class KeepApart(Task):
    """Reward: minus the distance to the own goal, and minus `penalty` while another agent is nearer than `radius`."""

    radius: float = 0.5  # m
    penalty: float = 1.0
    arena: float = 3.0  # m: goals are drawn from the square within +-arena

    def bind(self, world):
        """Make room for the goals, (N, 2, B): saved and restored with the environment."""
        self.memory = {"goal": np.zeros((len(world.fleet), 2, world.num_envs))}

    def reset(self, world, env_ids, rngs):
        """Draw a goal for every agent."""
        for env, rng in zip(env_ids, rngs, strict=True):
            self.memory["goal"][..., env] = rng.uniform(-self.arena, self.arena, (len(world.fleet), 2))

    def columns(self, world, agent):
        """The position of an agent's own goal, relative to it: two live columns."""
        reach = 2.0 * world.limit
        return [Column(f"goal.{axis}", "m", -reach, reach, row=2 * agent + c) for c, axis in enumerate("xy")]

    def observe(self, world, out):
        """Fill these columns for all agents at once, (2 N, B)."""
        out[...] = (self.memory["goal"] - world.positions()).reshape(out.shape)

    def evaluate(self, world):
        """Rewards, no end before the horizon, and two numbers per agent for the infos."""
        positions = world.positions()  # (N, 2, B)
        to_goal = np.linalg.norm(self.memory["goal"] - positions, axis=1).T  # (B, N)
        gaps = np.linalg.norm(positions[:, None] - positions, axis=2)  # (N, N, B)
        gaps[np.diag_indices(len(gaps))] = np.inf
        close = self.radius > gaps.min(axis=1).T
        reward = -world.control_period * (to_goal + self.penalty * close)
        return Outcome(
            reward, np.zeros(world.num_envs, bool), {"task_error": to_goal, "too_close": close.astype(float)}
        )

    def draw(self, canvas, world):
        """Show the goals in frames and films."""
        for goal in self.memory["goal"][..., 0]:
            canvas.cross(goal, "#666666")


class GoToGoal:
    """A policy for it: every agent moves towards its goal."""

    def reset(self, env, seeds):
        """Find the columns of the goal in each agent's observation."""
        self.goal = {agent: layout.columns("goal") for agent, layout in env.layouts.items()}

    def act(self, observations):
        """Full speed far away, slower near the goal."""
        return {agent: np.clip(seen[..., self.goal[agent]], -1.0, 1.0) for agent, seen in observations.items()}


if __name__ == "__main__":
    env = khop_env.make(KeepApart(radius=0.4), scenario="paper")  # ParallelEnv; make_vec, make_sb3_vec, ... likewise
    observations, _ = env.reset(seed=0)
    policy = GoToGoal()
    policy.reset(describe(env), seeds=[0])
    while env.agents:
        observations, rewards, _, _, infos = env.step(policy.act(observations))
    print({agent: f"{info['task_error']:.2f} m from its goal" for agent, info in infos.items()})

    frame = evaluate(env, {"go to goal": GoToGoal(), "idle": make_policy("zero")}, seeds=range(4))
    print({name: round(rows["return"].mean(), 2) for (name,), rows in frame.group_by("policy", maintain_order=True)})
