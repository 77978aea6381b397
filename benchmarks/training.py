"""Training speed: PPO's throughput inside `learn`, and the environment's share of the time."""

from __future__ import annotations

import importlib.util
import statistics
import time
from pathlib import Path
from typing import Any

from benchmarks.comparison import compare, run_peer
from benchmarks.report import Report
from khop_env.extras import how_to_install

TURNS = 3  # repetitions of both sides of the ratio


def training_rate(timesteps: int, backend: str = "torch") -> tuple[float, float]:
    """PPO on `consensus_v0`, `paper`, 64 environments of 8 agents, with the library's settings.

    Args:
        timesteps: agent-steps to train for.
        backend: what computes updates, "torch" or "jax".

    Returns:
        Agent-steps per second inside `learn`, and the environment's share of the wall time: stepping, resetting and
        observing, without the learner's processing of rewards and features.
    """
    import torch

    from agents.learning import TrainingConfig
    from agents.learning.environment import training_environment
    from agents.learning.networks import make_model

    torch.set_num_threads(1)  # as `khop train` and the peer's script
    config = TrainingConfig("consensus_v0", timesteps=timesteps, backend=backend)  # type: ignore[arg-type]
    env: Any = training_environment(config)
    model = make_model(config, env, [], None)
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


def training_rows(report: Report, quick: bool, peers: Path | None) -> None:
    """Measure the throughput, its ratio to the same PPO on MPE2 if that is installed in `peers`/mpe2, and JAX's gain.

    Args:
        report: takes the rows.
        quick: as `benchmark`.
        peers: folder with one virtual environment per peer; None to leave them out.
    """
    timesteps = 8_192 if quick else 200_000
    shares: list[float] = []

    def rate() -> float:
        found, share = training_rate(timesteps)
        shares.append(share)
        return found

    compare(
        report,
        "training",
        "agent-steps/s in learn",
        rate,
        lambda python: run_peer(python, "mpe2_train.py", 8_192 if quick else 40_960),
        (peers, "mpe2"),
        ("x MPE2 simple_spread, SuperSuit, the same PPO", 3.0),
        1 if quick else TURNS,
    )
    report.add("training_environment_share", statistics.median(shares), "of the wall time", most=0.3)
    if importlib.util.find_spec("jax") is None:
        report.skip("training_jax", f"needs jax: {how_to_install('jax')}")
        return
    rates = [
        [training_rate(timesteps, backend)[0] for backend in ("jax", "torch")] for _ in range(1 if quick else TURNS)
    ]
    report.add("training_jax", statistics.median(ours / theirs for ours, theirs in rates), "x torch")
