"""How fast policies are trained: PPO's throughput inside `learn`, and the environment's share of it."""

from __future__ import annotations

import statistics
import time
from collections.abc import Callable
from pathlib import Path
from typing import Any

from khop_env.bench.environments import run_peer

TURNS = 3  # the two sides of the ratio take turns, so that the machine's mood meets both


def training_rate(timesteps: int) -> tuple[float, float]:
    """PPO on `consensus_v0`, `paper`, 64 environments of 8 agents, with the library's settings.

    Args:
        timesteps: agent-steps to train for.

    Returns:
        Agent-steps per second inside `learn`, and the environment's share of the wall time: stepping, resetting and
        observing, without what the learner does to rewards and features.
    """
    from agents.learning import TrainingConfig
    from agents.learning.environment import training_environment
    from agents.learning.networks import make_model

    env: Any = training_environment(TrainingConfig("consensus_v0", timesteps=timesteps))
    model = make_model(TrainingConfig("consensus_v0", timesteps=timesteps), env, [], None)
    model.learn(1)  # compiles and warms up
    inner = env.venv.venv
    spent, step = 0.0, inner.step_wait

    def timed() -> Any:
        nonlocal spent
        start = time.perf_counter()
        result = step()
        spent += time.perf_counter() - start
        return result

    inner.step_wait = timed
    before, start = model.num_timesteps, time.perf_counter()
    model.learn(timesteps, reset_num_timesteps=False)
    wall = time.perf_counter() - start
    return (model.num_timesteps - before) / wall, spent / wall


def training_rows(add: Callable[..., None], quick: bool, say: Callable[[str], None], peers: Path | None) -> None:
    """Print the throughput, and its ratio to the same PPO on MPE2 if that is installed in `peers`/mpe2.

    Args:
        add: takes a row's name, value, unit and target.
        quick: as `benchmark`.
        say: told what is going on.
        peers: folder with one virtual environment per peer; None to leave them out.
    """
    timesteps = 8_192 if quick else 200_000
    say("training: PPO, 64 environments of 8 agents")
    python = None if peers is None else peers / "mpe2" / "bin" / "python"
    if python is not None and not python.exists():
        python = None
    mine, theirs, shares = [], [], []
    for _ in range(TURNS if python is not None and not quick else 1):
        rate, share = training_rate(timesteps)
        mine.append(rate)
        shares.append(share)
        if python is not None:
            theirs.append(run_peer(python, "mpe2_train.py", 8_192 if quick else 40_960))
    add("training", statistics.median(mine), "agent-steps/s in learn")
    add("training_environment_share", statistics.median(shares), "of the wall time", "at most 0.3")
    if theirs:
        ratio = statistics.median(mine) / statistics.median(theirs)
        add("training_ratio", ratio, "x MPE2 simple_spread, SuperSuit, the same PPO", "at least 3")
