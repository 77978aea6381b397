"""The advantages of examples/learning/train_cleanrl_style.py, against sums written out."""

import runpy
from pathlib import Path

import pytest
import torch

import khop_env

EXAMPLE = Path(__file__).parents[2] / "examples" / "learning" / "train_cleanrl_style.py"


@pytest.mark.parametrize("end", ["truncated", "terminated", "goes on"])
def test_advantages_stop_where_an_episode_ends(end):
    """Five steps of one row; an episode may end after the third, and then the sums of its steps stop there."""
    example = runpy.run_path(str(EXAMPLE))
    gamma, decay = example["GAMMA"], example["GAMMA"] * example["LAMBDA"]
    generator = torch.Generator().manual_seed(0)
    rewards, values, following = torch.randn(3, 5, 1, generator=generator)
    if end == "terminated":
        following[2] = 0.0
    ended = torch.tensor([False, False, end != "goes on", False, False])[:, None]
    found = example["advantages"](rewards, values, following, ended)
    errors = rewards + gamma * following - values
    for step in range(5):
        last = 2 if step <= 2 and end != "goes on" else 4
        expected = sum(decay ** (later - step) * errors[later] for later in range(step, last + 1))
        torch.testing.assert_close(found[step], expected)


def test_the_last_observation_counts_where_the_horizon_truncates():
    """`collect` gives V of the episode's own last observation, not of the next episode's first one."""
    example = runpy.run_path(str(EXAMPLE))
    steps = example["STEPS"]
    envs = khop_env.make_vec("consensus_v0", num_envs=1, max_cycles=steps, autoreset_mode="same_step")
    torch.manual_seed(0)
    agent = example["Agent"](envs.single_observation_space.shape[0], envs.single_action_space.shape[0])
    observations, _ = envs.reset(seed=0)
    _, (_, action, _, value, advantage) = example["collect"](envs, agent, observations)

    envs.reset(seed=0)
    rows = envs.num_envs
    for step in range(steps):
        played = action[step * rows : (step + 1) * rows].numpy().clip(-1, 1)
        _, reward, _, truncated, infos = envs.step(played)
    assert truncated.all()
    last = torch.stack([torch.as_tensor(row) for row in infos["final_obs"]])
    with torch.no_grad():
        expected = torch.as_tensor(reward, dtype=torch.float32) + example["GAMMA"] * agent.critic(last) - value[-rows:]
    torch.testing.assert_close(advantage[-rows:], expected)
