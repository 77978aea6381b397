"""The folder of a training run: one training at a time, and files that are never half written."""

from __future__ import annotations

from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import filelock

from agents.learning.checkpoint import CheckpointError, read_checkpoint
from agents.learning.config import TrainingConfig

CHECKPOINT = "checkpoint.npz"


@contextmanager
def alone_in(folder: Path) -> Iterator[None]:
    """Make a folder, and keep other trainings out of it; the lock ends with the process, however that ends.

    Raises:
        FileExistsError: if a training is going on there.
    """
    folder.mkdir(parents=True, exist_ok=True)
    lock = filelock.FileLock(folder / ".lock")
    try:
        lock.acquire(timeout=0)
    except filelock.Timeout:
        raise FileExistsError(
            f"another training is going on in {folder}: wait for its end, or choose another folder"
        ) from None
    try:
        yield
    finally:
        lock.release()


def load_checkpoint(folder: Path, config: TrainingConfig) -> dict[str, Any]:
    """The checkpoint of a folder, if it is of a run with these settings or with fewer timesteps.

    Raises:
        CheckpointError: if it isn't one.
        ValueError: if it is of a run with other settings.
    """
    path, ours = folder / CHECKPOINT, config.as_dict()
    saved = read_checkpoint(path)
    theirs = saved.get("config")
    if not isinstance(theirs, dict) or not isinstance(theirs.get("timesteps"), int) or "fingerprint" not in saved:
        raise CheckpointError(f"{path} isn't a checkpoint that khop train wrote (it has no settings)")
    theirs = {"arguments": {}, **theirs}  # runs of earlier versions had none
    differs = [key for key in ours if theirs.get(key) != ours[key]]
    if theirs["timesteps"] < config.timesteps:
        differs.remove("timesteps")
    if differs:
        said = ", ".join(f"{key} = {theirs.get(key)!r} there and {ours[key]!r} here" for key in differs)
        raise ValueError(f"{folder} holds a run with other settings: {said}; resume with the same")
    return saved


def write(path: Path, text: str) -> None:
    """Replace a file at once, so that a kill never leaves half of it."""
    partial = path.with_name(f".{path.name}.part")
    partial.write_text(text, encoding="utf-8")
    partial.replace(path)
