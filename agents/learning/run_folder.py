"""The folder of a training run: locked during training, with files written atomically."""

from __future__ import annotations

import importlib.metadata
import platform
from collections.abc import Iterator, Mapping
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import filelock

import khop_env
from agents.evaluation import chosen_scenario
from agents.learning.checkpoint import CheckpointError, read_checkpoint
from agents.learning.config import NO_LIMIT, TrainingConfig
from agents.learning.fingerprint import differences, fingerprint
from agents.learning.residual import Script
from khop_env.env import BatchedEnv

CHECKPOINT = "checkpoint.npz"


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Create a folder and lock it against other trainings; the lock ends with the process in any case.

    Raises:
        FileExistsError: if another training is running there.
    """
    folder.mkdir(parents=True, exist_ok=True)
    lock = filelock.FileLock(folder / ".lock")
    try:
        lock.acquire(timeout=0)
    except filelock.Timeout:
        raise FileExistsError(
            f"another training is running in {folder}: wait for its end, or choose another folder"
        ) from None
    try:
        yield
    finally:
        lock.release()


def load_checkpoint(folder: Path, config: TrainingConfig) -> dict[str, Any]:
    """The checkpoint of a run with the same settings, except that `timesteps` may have been smaller.

    Raises:
        CheckpointError: if the file isn't a checkpoint.
        ValueError: if the settings differ; the message lists them.
    """
    path, current = folder / CHECKPOINT, config.as_dict()
    saved = read_checkpoint(path)
    stored = saved.get("config")
    if not isinstance(stored, dict) or not isinstance(stored.get("timesteps"), int) or "fingerprint" not in saved:
        raise CheckpointError(f"{path} isn't a checkpoint that khop train wrote (it has no settings)")
    stored = {
        "arguments": {},
        "nearest": False,
        "shield": None,
        "intervention": 0.0,
        "residual": None,
        "initial": None,
        "policy": "mlp",
        "log_std_end": NO_LIMIT,
        "explore": 0.0,
        "reward_memory": 0,
        "evaluate_network": None,
        "critic": "local",
        "backend": "torch",
        **stored,
    }  # of earlier versions
    differs = [key for key in current if stored.get(key) != current[key]]
    if stored["timesteps"] < config.timesteps:
        differs.remove("timesteps")
    if differs:
        text = ", ".join(f"{key} = {stored.get(key)!r} there and {current[key]!r} here" for key in differs)
        raise ValueError(f"{folder} holds a run with other settings: {text}; resume with the same settings")
    return saved


def environment_fingerprint(config: TrainingConfig, batched: BatchedEnv, script: Script | None) -> dict[str, Any]:
    """Everything that the numbers of a training's environment depend on."""
    found = fingerprint(chosen_scenario(config.environment, config.scenario), batched)
    return found if script is None else {**found, "script": script.name}  # shipped tuned parameters may change


def require_same_environment(folder: Path, saved: Mapping[str, Any], current: Mapping[str, Any]) -> None:
    """Refuse to resume a checkpoint in an environment with another fingerprint.

    Raises:
        ValueError: if they differ; the message says where.
    """
    if text := differences(saved["fingerprint"], current):
        raise ValueError(
            f"{folder} holds a run in another environment: {text}; resume it with the unchanged scenario, or "
            "train in another folder"
        )


def write(path: Path, text: str) -> None:
    """Write a text file atomically: a kill never leaves a partial file."""
    partial = path.with_name(f".{path.name}.part")
    partial.write_text(text, encoding="utf-8")
    partial.replace(path)


def versions() -> dict[str, str]:
    """Of what a policy is trained with, by name."""
    found = {name: importlib.metadata.version(name) for name in ("stable_baselines3", "torch", "numpy", "gymnasium")}
    return {"khop_env": khop_env.__version__, "python": platform.python_version(), **found}
