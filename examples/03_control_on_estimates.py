"""Run a controller on estimates: the same law on estimates, on true states, and on neighbours only."""

from pathlib import Path

from agents import make_policy, play
from khop_env import formation_v0
from khop_env.results import error_over_time

errors = {}
print("a ring of 12 integrators on a random network, law tanh, 50 episodes")
for mode in ("oracle", "estimate", "local"):
    env = formation_v0.batched_env("random_geometric:agents=12", num_envs=50, observe=mode)
    episodes = play(env, make_policy("tanh:gain=2"), range(50))
    errors["tanh", mode] = episodes.task_error
    print(
        f"  {mode:9s} return {episodes.returns.mean():7.3f}   error at the end {episodes.final_task_error.mean():.3f} m"
        f"   largest |e| {episodes.max_normalized_disagreement.max():.3f} (below 1: guarantee kept)"
    )

out = Path("runs/examples")
out.mkdir(parents=True, exist_ok=True)
title = "formation_v0: the price of estimation, and of not estimating"
print("figure:", error_over_time(episodes.time, errors, out / "03_control.png", title))
