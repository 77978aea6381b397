"""Training: Stable-Baselines3 over the vectorised environment, evaluated, saved, and continued after an end."""

from __future__ import annotations

import contextlib
import dataclasses
import importlib.metadata
import json
import platform
import signal
import threading
import time
from collections.abc import Callable, Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback
from stable_baselines3.common.vec_env import VecNormalize

import khop_env
from agents.evaluation import chosen_scenario, play
from agents.learning.checkpoint import CheckpointError, model_state, restore_model, restored, write_checkpoint
from agents.learning.config import TrainingConfig
from agents.learning.config_file import write_config
from agents.learning.environment import TrainingVecEnv, build, training_environment
from agents.learning.fingerprint import differences, fingerprint
from agents.learning.learned import LearnedPolicy, columns_of
from agents.learning.networks import exported, make_model
from agents.learning.run_folder import CHECKPOINT, alone_in, load_checkpoint, write
from agents.policy import EnvDescription, Observations, Policy, describe
from khop_env.env.layout import Float32Array

EVALUATION_SEEDS = range(20_000, 20_032)
"""Of the episodes that decide which policy is the best; others than those that are tuned or reported on."""

_FIRST_SEED = 1_000_000  # training episodes are drawn from generators seeded from here on
_RUNNING = ("mean", "var", "count")  # of discounted rewards, by which training divides them

Told = Callable[[float, "Evaluation | None"], None]
"""Called now and then with the fraction that is done, and the evaluation if there was one."""


@dataclass(frozen=True)
class Evaluation:
    """A point of the learning curve.

    Attributes:
        timesteps: agent-steps so far.
        mean_return: over the evaluation episodes.
        final_task_error: mean at their end over episodes and agents, in the task's unit.
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

    The folder gets config.toml (every setting, as `khop train --config` takes it) and config.json (the same and library
    versions), curve.csv, best.npz and last.npz (policies with their
    observation scales), checkpoint.npz (all that continuing needs) and TensorBoard's logs. A keyboard interrupt saves
    and returns. What is continued goes on as if it had not been interrupted, bit for bit with PPO; SAC begins with an
    empty replay buffer. With more `timesteps` than before, a run goes on beyond its end, with PPO's learning rate at
    what it is that far from the new end.

    Args:
        config: what to train; with `resume` it has to be the one of the folder, but for larger `timesteps`.
        out: folder; None to keep everything in memory.
        resume: continue from the folder's checkpoint.
        told: what to tell of the progress.

    Raises:
        FileNotFoundError: for `resume` without a checkpoint.
        FileExistsError: for a folder with a run in it, without `resume`, or with one that is going on.
        CheckpointError: for a checkpoint that can't be read.
        ValueError: for an unknown environment or scenario, or `resume` with other settings or another environment.
    """
    torch.set_num_threads(1)  # networks this small don't gain from more
    folder = None if out is None else Path(out)
    asked, config = config, dataclasses.replace(config, scenario=chosen_scenario(config.environment, config.scenario))
    if folder is None or not (folder / CHECKPOINT).exists():
        if resume:
            raise FileNotFoundError(f"nothing to resume: there is no {CHECKPOINT} in {folder}")
        if folder is None:
            return _Run(config, None, None, told, asked).learn()
    with alone_in(folder):
        saved = load_checkpoint(folder, config) if resume else None
        if not resume and any((folder / name).exists() for name in (CHECKPOINT, "best.npz")):
            raise FileExistsError(f"{folder} holds a training run; continue it with --resume, or choose another folder")
        return _Run(config, folder, saved, told, asked).learn()


class _StopError(Exception):
    """Ctrl-C came in the middle of an update or an evaluation."""


class _Run(BaseCallback):
    """A run and its bookkeeping, as Stable-Baselines3's callback."""

    def __init__(
        self,
        config: TrainingConfig,
        folder: Path | None,
        saved: Mapping[str, Any] | None,
        told: Told | None,
        asked: TrainingConfig,
    ) -> None:
        super().__init__()
        self.asked = asked  # with the scenario as the user names it
        self.config, self.folder, self.told = config, folder, told
        self.env: VecNormalize = training_environment(config)
        self.learner: TrainingVecEnv = self.env.venv  # type: ignore[assignment]
        self.batched = batched = self.learner.batched
        self.fingerprint = fingerprint(chosen_scenario(config.environment, config.scenario), batched)
        if saved is not None and (said := differences(saved["fingerprint"], self.fingerprint)):
            raise ValueError(
                f"{folder} holds a run in another environment: {said}; resume it with the scenario as it was, or train "
                "in another folder"
            )
        self.judge = build(config, len(EVALUATION_SEEDS))
        self.description = describe(batched)
        self.types = list(dict.fromkeys(model.type for model in batched.fleet.models))
        layout = batched.layouts[0]  # features begin with the observation's columns
        columns = [layout.index(f"own.type.{kind}") for kind in self.types]
        log = None if folder is None else str(folder / "tensorboard")
        self.interrupted, self.resumed = False, saved is not None
        self.algorithm = make_model(config, self.env, columns, log)  # it seeds the environment, too
        self.env.seed((config.seed + 1) * _FIRST_SEED)
        self.curve: list[Evaluation] = []
        self.seconds = 0.0
        if saved is not None:
            self._restore(saved)
        self.best = max((one.mean_return for one in self.curve), default=-np.inf)
        self.policy = self._exported()
        for name in model_state(self.algorithm)["parameters"]:
            if isinstance(optimizer := attrgetter(name)(self.algorithm), torch.optim.Optimizer):
                optimizer.register_step_pre_hook(self._stop_if_interrupted)
        if folder is not None:
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
                self._stop_if_interrupted()
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
        """Let Ctrl-C end the training after the step that it comes in, of an episode, an update or an evaluation.

        A second one is an exception as usual.
        """
        with contextlib.suppress(_StopError):
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

    def _stop_if_interrupted(self, *_: object) -> None:
        if self.interrupted:
            raise _StopError

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
        episodes = play(self.judge, _Stoppable(policy, self), EVALUATION_SEEDS, name=self.config.algorithm)
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
            "environment": self.description.environment,
            "scenario": self.description.scenario,
            "trained": self.algorithm.num_timesteps,
            "versions": _versions(),
        }
        columns = columns_of(self.description)
        environment = self.description.environment
        return exported(self.algorithm, self.config, environment, columns, self.types, self.learner.scaler, about)

    def _save(self) -> None:
        if self.folder is None:
            return
        self._exported().save(self.folder / "last.npz")
        lines = ["timesteps,mean_return,final_task_error,max_normalized_disagreement"]
        lines += [
            f"{one.timesteps},{one.mean_return!r},{one.final_task_error!r},{one.max_normalized_disagreement!r}"
            for one in self.curve
        ]
        write(self.folder / "curve.csv", "\n".join(lines) + "\n")
        write_checkpoint(self.folder / CHECKPOINT, self._checkpoint())

    def _write_config(self, folder: Path) -> None:
        text = {**self.config.as_dict(), "versions": _versions(), "agents": len(self.batched.agents)}
        write(folder / "config.json", json.dumps(text, indent=2) + "\n")
        write(folder / "config.toml", write_config(self.asked, _versions()))

    def _checkpoint(self) -> dict[str, Any]:
        """Everything that the next update depends on."""
        return {
            "config": self.config.as_dict(),
            "fingerprint": self.fingerprint,
            "model": model_state(self.algorithm),
            "environment": self.batched.get_state(),
            "rewards": {name: getattr(self.env.ret_rms, name) for name in _RUNNING} | {"returns": self.env.returns},
            "before": self.learner.before,
            "curve": self.curve,
            "seconds": self.elapsed(),
        }

    def _restore(self, saved: Mapping[str, Any]) -> None:
        """Bring everything into the state that was saved.

        Raises:
            CheckpointError: for what isn't such a state.
        """
        try:
            self.env.reset()
            self.batched.set_state(restored(self.batched.get_state(), saved["environment"], "environment"))
            self.learner.before = restored(self.learner.before, saved["before"], "before")
            rewards, running = saved["rewards"], self.env.ret_rms
            if not all(np.shape(rewards[name]) == () and np.isfinite(rewards[name]) for name in _RUNNING):
                raise ValueError("the running mean of the rewards isn't finite")
            running.mean, running.var, running.count = (rewards[name] for name in _RUNNING)
            self.env.returns = restored(self.env.returns, rewards["returns"], "returns")
            self.curve = [restored(Evaluation(0, 0.0, 0.0, 0.0), point, "curve") for point in saved["curve"]]
            self.seconds = float(saved["seconds"])
            restore_model(self.algorithm, saved["model"])
        except (ValueError, TypeError, KeyError, AttributeError, IndexError, OverflowError, RuntimeError) as error:
            raise CheckpointError(
                f"{self.folder}: its {CHECKPOINT} doesn't hold what continuing needs ({error})"
            ) from error


class _Stoppable:
    """A policy that is interrupted between its actions."""

    def __init__(self, policy: Policy, run: _Run) -> None:
        self._policy, self._run = policy, run

    def reset(self, env: EnvDescription, seeds: Sequence[int]) -> None:
        self._policy.reset(env, seeds)

    def act(self, observations: Observations) -> dict[str, Float32Array]:
        self._run._stop_if_interrupted()
        return self._policy.act(observations)


def _versions() -> dict[str, str]:
    found = {name: importlib.metadata.version(name) for name in ("stable_baselines3", "torch", "numpy", "gymnasium")}
    return {"khop_env": khop_env.__version__, "python": platform.python_version(), **found}
