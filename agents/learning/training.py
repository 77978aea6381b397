"""Training: Stable-Baselines3 over the vectorised environment, evaluated, saved, and continued after an end."""

from __future__ import annotations

import importlib.metadata
import io
import json
import pickle
import platform
import random
import signal
import threading
import time
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3 import PPO, SAC
from stable_baselines3.common.base_class import BaseAlgorithm
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecNormalize

import khop_env
from agents.evaluation import play
from agents.learning.config import TrainingConfig
from agents.learning.environment import TrainingVecEnv, build, training_environment
from agents.learning.learned import LearnedPolicy, columns_of
from agents.learning.networks import exported, make_model
from agents.policy import describe

EVALUATION_SEEDS = range(20_000, 20_032)
"""Of the episodes that decide which policy is the best; others than those that are tuned or reported on."""

_FIRST_SEED = 1_000_000  # training episodes are drawn from generators seeded from here on
CHECKPOINT = "checkpoint.pkl"

Told = Callable[[float, "Evaluation | None"], None]
"""Called now and then with the fraction that is done, and the evaluation if there was one."""


@dataclass(frozen=True)
class Evaluation:
    """A point of the learning curve.

    Attributes:
        timesteps: agent-steps so far.
        mean_return: over the evaluation episodes.
        final_task_error: mean at their end, in m.
        max_normalized_disagreement: largest |xi| / rho in them.
    """

    timesteps: int
    mean_return: float
    final_task_error: float
    max_normalized_disagreement: float


@dataclass(frozen=True)
class Training:
    """What a run came to.

    Attributes:
        policy: the best of all evaluations.
        curve: the evaluations.
        seconds: of wall time in `learn`, those before a resumed checkpoint included.
        finished: whether it came to its end, and wasn't interrupted.
    """

    policy: LearnedPolicy
    curve: list[Evaluation]
    seconds: float
    finished: bool


def train(
    config: TrainingConfig, out: str | Path | None = None, *, resume: bool = False, told: Told | None = None
) -> Training:
    """Train a policy.

    The folder gets config.json (settings and library versions), curve.csv, best.npz and last.npz (policies with their
    observation scales), checkpoint.pkl (all that continuing needs) and TensorBoard's logs. A keyboard interrupt saves
    and returns. What is continued goes on as if it had not been interrupted, bit for bit with PPO; SAC begins with an
    empty replay buffer.

    Args:
        config: what to train; with `resume` it has to be the one of the folder.
        out: folder; None to keep everything in memory.
        resume: continue from the folder's checkpoint.
        told: what to tell of the progress.

    Raises:
        FileNotFoundError: for `resume` without a checkpoint.
        FileExistsError: for a folder with a checkpoint, without `resume`.
        ValueError: for an unknown environment or scenario, or `resume` with other settings.
    """
    torch.set_num_threads(1)  # networks this small don't gain from more
    folder = None if out is None else Path(out)
    run = _Run(config, folder, resume, told)
    return run.learn()


class _Run(BaseCallback):
    """A run and its bookkeeping, as Stable-Baselines3's callback."""

    def __init__(self, config: TrainingConfig, folder: Path | None, resume: bool, told: Told | None) -> None:
        super().__init__()
        self.config, self.folder, self.told = config, folder, told
        saved = _load(folder, config) if resume else None
        if not resume and folder is not None and (folder / CHECKPOINT).exists():
            raise FileExistsError(f"{folder} holds a training run; continue it with --resume, or choose another folder")
        self.env: VecNormalize = training_environment(config)
        self.learner: TrainingVecEnv = self.env.venv  # type: ignore[assignment]
        self.batched = batched = self.learner.batched
        self.judge = build(config, len(EVALUATION_SEEDS))
        self.description = describe(batched)
        self.types = list(dict.fromkeys(model.type for model in batched.fleet.models))
        layout = batched.layouts[0]  # features begin with the observation's columns
        columns = [layout.index(f"own.type.{kind}") for kind in self.types]
        log = None if folder is None else str(folder / "tensorboard")
        self.curve: list[Evaluation] = [] if saved is None else saved["curve"]
        self.best = max((one.mean_return for one in self.curve), default=-np.inf)
        self.interrupted, self.resumed = False, saved is not None
        self.seconds = 0.0 if saved is None else saved["seconds"]
        if saved is None:
            self.algorithm = make_model(config, self.env, columns, log)  # it seeds the environment, too
            self.env.seed((config.seed + 1) * _FIRST_SEED)
        else:
            self.algorithm = _restore(saved, self, log)
        self.policy = self._exported()
        if folder is not None:
            folder.mkdir(parents=True, exist_ok=True)
            if saved is None:
                self._write_config(folder)

    def learn(self) -> Training:
        """Train to the end, or to the interrupt."""
        done = self.algorithm.num_timesteps
        self.start = time.perf_counter()
        if done < self.config.timesteps:
            with self._interruptible():
                self.algorithm.learn(
                    self.config.timesteps - done,
                    callback=self,
                    reset_num_timesteps=not self.resumed,
                    tb_log_name="run",
                )
            if not self.interrupted:
                self._evaluate()
                self._save()
        if self.interrupted and self.folder is not None:
            self._exported().save(self.folder / "last.npz")
            if not (self.folder / "best.npz").exists():
                self._exported().save(self.folder / "best.npz")
        best = self.policy if self.folder is None else LearnedPolicy.load(self.folder / "best.npz")
        return Training(best, self.curve, self.elapsed(), not self.interrupted)

    def elapsed(self) -> float:
        """Seconds of training so far."""
        return float(self.seconds + time.perf_counter() - self.start)

    def _on_training_start(self) -> None:
        if not self.resumed:
            self._save()  # so that an early interrupt leaves something to go on from

    def _on_step(self) -> bool:
        return not self.interrupted

    @contextmanager
    def _interruptible(self) -> Iterator[None]:
        """Let Ctrl-C end the training after the step that it comes in; a second one is an exception as usual."""
        if threading.current_thread() is not threading.main_thread():
            yield
            return

        def interrupt(*_: object) -> None:
            self.interrupted = True
            signal.signal(signal.SIGINT, before)

        before = signal.signal(signal.SIGINT, interrupt)
        try:
            yield
        finally:
            signal.signal(signal.SIGINT, before)

    def _on_rollout_start(self) -> None:
        """Between updates: the policy is up to date, and the environment stands still."""
        now, every = self.algorithm.num_timesteps, self.config.timesteps / self.config.evaluations
        if now // every > (self.curve[-1].timesteps // every if self.curve else 0):
            self._evaluate()
            self._save()
        elif self.told is not None:
            self.told(now / self.config.timesteps, None)

    def _evaluate(self) -> None:
        if self.curve and self.curve[-1].timesteps == self.algorithm.num_timesteps:
            return
        policy = self._exported()
        episodes = play(self.judge, policy, EVALUATION_SEEDS, name=self.config.algorithm)
        found = Evaluation(
            self.algorithm.num_timesteps,
            float(episodes.returns.mean()),
            float(episodes.final_task_error.mean()),
            float(episodes.max_normalized_disagreement.max()),
        )
        self.curve.append(found)
        self.algorithm.logger.record("eval/mean_return", found.mean_return)
        self.algorithm.logger.record("eval/final_task_error", found.final_task_error)
        if found.mean_return > self.best:
            self.best, self.policy = found.mean_return, policy
            if self.folder is not None:
                policy.save(self.folder / "best.npz")
        if self.told is not None:
            self.told(min(1.0, found.timesteps / self.config.timesteps), found)

    def _exported(self) -> LearnedPolicy:
        about = {
            **self.config.as_dict(),
            "scenario": self.description.scenario,
            "trained": self.algorithm.num_timesteps,
            "versions": _versions(),
        }
        columns = columns_of(self.description)
        return exported(self.algorithm, self.config, columns, self.types, self.learner.scaler, about)

    def _save(self) -> None:
        if self.folder is None:
            return
        self._exported().save(self.folder / "last.npz")
        lines = ["timesteps,mean_return,final_task_error,max_normalized_disagreement"]
        lines += [
            f"{one.timesteps},{one.mean_return!r},{one.final_task_error!r},{one.max_normalized_disagreement!r}"
            for one in self.curve
        ]
        _write(self.folder / "curve.csv", ("\n".join(lines) + "\n").encode())
        _write(self.folder / CHECKPOINT, pickle.dumps(_checkpoint(self)))

    def _write_config(self, folder: Path) -> None:
        text = {**self.config.as_dict(), "versions": _versions(), "agents": len(self.batched.agents)}
        _write(folder / "config.json", (json.dumps(text, indent=2) + "\n").encode())


def _checkpoint(run: _Run) -> dict[str, Any]:
    """Everything that the next update depends on."""
    model, buffer = run.algorithm, io.BytesIO()
    model.save(buffer)
    return {
        "config": run.config.as_dict(),
        "model": buffer.getvalue(),
        "environment": run.batched.get_state(),
        "normalize": (run.env.ret_rms, run.env.returns),
        "before": run.learner.before,
        "last": (model._last_obs, model._last_episode_starts, model._last_original_obs),
        "random": (torch.get_rng_state(), np.random.get_state(), random.getstate()),  # noqa: NPY002
        "curve": run.curve,
        "seconds": run.elapsed(),
    }


def _restore(saved: dict[str, Any], run: _Run, log: str | None) -> BaseAlgorithm:
    """The model and the environment as they were when the checkpoint was written."""
    config, env = run.config, run.env
    kind = PPO if config.algorithm == "ppo" else SAC
    model: BaseAlgorithm = kind.load(io.BytesIO(saved["model"]), device="cpu")
    env.reset()
    model.set_env(env, force_reset=False)
    model.tensorboard_log = log
    run.batched.set_state(saved["environment"])
    run.learner.before = saved["before"]
    env.ret_rms, env.returns = saved["normalize"]
    model._last_obs, model._last_episode_starts, model._last_original_obs = saved["last"]
    torch_state, numpy_state, python_state = saved["random"]
    torch.set_rng_state(torch_state)
    np.random.set_state(numpy_state)  # noqa: NPY002  # Stable-Baselines3 shuffles with it
    random.setstate(python_state)
    return model


def _load(folder: Path | None, config: TrainingConfig) -> dict[str, Any]:
    """The checkpoint of a folder.

    Raises:
        FileNotFoundError: if there is none.
        ValueError: if it is of a run with other settings.
    """
    path = None if folder is None else folder / CHECKPOINT
    if path is None or not path.exists():
        raise FileNotFoundError(f"nothing to resume: there is no {CHECKPOINT} in {folder}")
    saved: dict[str, Any] = pickle.loads(path.read_bytes())
    ours = config.as_dict()
    differs = [key for key, value in saved["config"].items() if value != ours.get(key)]
    if differs:
        said = ", ".join(f"{key} = {saved['config'][key]!r} there and {ours.get(key)!r} here" for key in differs)
        raise ValueError(f"{folder} holds a run with other settings: {said}; resume with the same")
    return saved


def _write(path: Path, content: bytes) -> None:
    """Replace a file at once, so that a kill never leaves half of it."""
    partial = path.with_name(f".{path.name}.part")
    partial.write_bytes(content)
    partial.replace(path)


def _versions() -> dict[str, str]:
    found = {name: importlib.metadata.version(name) for name in ("stable_baselines3", "torch", "numpy", "gymnasium")}
    return {"khop_env": khop_env.__version__, "python": platform.python_version(), **found}
