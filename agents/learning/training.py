"""Training with Stable-Baselines3 on the vectorised environment: evaluation, saving and resuming."""

from __future__ import annotations

import dataclasses
import json
import time
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from operator import attrgetter
from pathlib import Path
from typing import Any

import numpy as np
import torch
from stable_baselines3.common.callbacks import BaseCallback, CallbackList
from stable_baselines3.common.vec_env import VecNormalize

from agents.evaluation import chosen_scenario
from agents.learning.callbacks import EndedError, OwnCallbacks
from agents.learning.checkpoint import CheckpointError, model_state, restored, write_checkpoint
from agents.learning.config import TrainingConfig
from agents.learning.config_file import write_config
from agents.learning.curve import Evaluation, Evaluator, as_csv, record_evaluation
from agents.learning.environment import TrainingVecEnv, described, training_environment
from agents.learning.initial import begin_from
from agents.learning.interrupts import Interrupts, StopError
from agents.learning.learned import LearnedPolicy, columns_of
from agents.learning.networks import exported, make_model, require_installed
from agents.learning.run_folder import (
    CHECKPOINT,
    alone_in,
    environment_fingerprint,
    load_checkpoint,
    require_same_environment,
    versions,
    write,
)
from agents.learning.run_state import FAULTS, restore_run, run_state
from agents.learning.schedule import follow_schedule

_FIRST_SEED = 1_000_000  # training episodes are drawn from generators with seeds from here on

OnProgress = Callable[[float, Evaluation | None], None]
"""Called with the completed fraction, and with the evaluation if one was made."""


@dataclass(frozen=True)
class Training:
    """Result of a training run.

    Attributes:
        policy: the policy with the best evaluation.
        curve: the evaluations.
        seconds: wall time of training, the time before a resumed checkpoint included.
        finished: False if it was interrupted; True where a callback ended it.
    """

    policy: LearnedPolicy
    curve: list[Evaluation]
    seconds: float
    finished: bool


def train(
    config: TrainingConfig,
    out: str | Path | None = None,
    *,
    resume: bool = False,
    callbacks: BaseCallback | Sequence[BaseCallback] = (),
    on_progress: OnProgress | None = None,
) -> Training:
    """Train a policy.

    The folder gets config.toml (every setting, as `khop train --config` takes it), config.json (the same and library
    versions), curve.csv, best.npz and last.npz (policies with their observation scales), checkpoint.npz (everything
    needed to resume) and TensorBoard logs. A keyboard interrupt saves and returns. A resumed run continues as if it had
    not been interrupted, bit for bit. With more `timesteps` than before, a run continues beyond its end; PPO's learning
    rate then follows the schedule of the longer run.

    Args:
        config: settings; with `resume` they must equal those of the folder, except that `timesteps` may be larger.
        out: folder of the run; None to keep everything in memory.
        resume: whether to continue from the folder's checkpoint.
        callbacks: Stable-Baselines3 callbacks, called beside the training's own. If one returns False, the training
            ends after the current update, evaluated and saved. If one raises, the policy is saved as last.npz, and
            the checkpoint of the last evaluation stays. Checkpoints don't hold them.
        on_progress: called with the completed fraction, and the evaluation if one was made.

    Raises:
        TypeError: if a callback isn't one of Stable-Baselines3's.
        FileNotFoundError: if `resume` is set and there is no checkpoint.
        FileExistsError: if the folder holds a run and `resume` isn't set, or another training is running there.
        CheckpointError: if the checkpoint can't be read.
        ModuleNotFoundError: for a recurrent policy without sb3-contrib, or backend "jax" without JAX.
        ValueError: if environment or scenario is unknown, or a resumed run had other settings or another environment.
    """
    torch.set_num_threads(1)  # small networks don't gain from more
    folder = None if out is None else Path(out)
    require_installed(config)
    own = OwnCallbacks(callbacks)
    asked, config = config, dataclasses.replace(config, scenario=chosen_scenario(config.environment, config.scenario))
    if folder is None or not (folder / CHECKPOINT).exists():
        if resume:
            raise FileNotFoundError(f"nothing to resume: there is no {CHECKPOINT} in {folder}")
        if folder is None:
            return _Run(config, None, None, on_progress, asked, own).learn()
    with alone_in(folder):
        saved = load_checkpoint(folder, config) if resume else None
        if not resume and any((folder / name).exists() for name in (CHECKPOINT, "best.npz")):
            raise FileExistsError(f"{folder} holds a training run; continue it with --resume, or choose another folder")
        return _Run(config, folder, saved, on_progress, asked, own).learn()


class _Run(BaseCallback):
    """A training run, as a Stable-Baselines3 callback."""

    def __init__(
        self,
        config: TrainingConfig,
        folder: Path | None,
        saved: Mapping[str, Any] | None,
        on_progress: OnProgress | None,
        asked: TrainingConfig | None = None,
        own: OwnCallbacks | None = None,
    ) -> None:
        super().__init__()
        self.own = own or OwnCallbacks([])
        self.asked = asked or config  # with the scenario as the user names it
        self.config, self.folder, self.on_progress = config, folder, on_progress
        self.env: VecNormalize = training_environment(config)
        self.learner: TrainingVecEnv = self.env.venv  # type: ignore[assignment]
        self.batched = batched = self.learner.batched
        self.fingerprint = environment_fingerprint(config, batched, self.learner.script)
        if saved is not None and folder is not None:
            require_same_environment(folder, saved, self.fingerprint)
        self.evaluator, self.interrupts = Evaluator(config), Interrupts()
        self.description = described(batched, config)
        self.types = list(dict.fromkeys(model.type for model in batched.fleet.models))
        layout = self.description.layouts[batched.agents[0]]  # the first features are the observation's columns
        columns = [layout.index(f"own.type.{kind}") for kind in self.types]
        self.resumed = saved is not None
        log = None if folder is None else str(folder / "tensorboard")
        self.algorithm = make_model(config, self.env, columns, log)  # this seeds the environment as well
        self.env.seed((config.seed + 1) * _FIRST_SEED)
        self.curve: list[Evaluation] = []
        self.seconds = 0.0
        if saved is not None:
            self._restore(saved)
        elif config.initial is not None:
            begin_from(config.initial, self.algorithm, self._exported(), self.description)
        self.best = max((point.mean_return for point in self.curve), default=-np.inf)
        self.policy = self._exported()
        for name in model_state(self.algorithm)["parameters"]:
            if isinstance(optimizer := attrgetter(name)(self.algorithm), torch.optim.Optimizer):
                optimizer.register_step_pre_hook(self.interrupts.check)
        if folder is not None:
            self._write_config(folder)

    def learn(self) -> Training:
        """Train to the end or until an interrupt."""
        done = self.algorithm.num_timesteps
        self.start = time.perf_counter()
        if done < self.config.timesteps:
            try:
                with self.interrupts.caught():
                    self._learn(self.config.timesteps - done)
            except BaseException:
                self._keep()
                raise
        if self.interrupts.interrupted:
            self._keep()
        best = self.policy if self.folder is None else LearnedPolicy.load(self.folder / "best.npz")
        return Training(best, self.curve, self.elapsed(), not self.interrupts.interrupted)

    def _learn(self, timesteps: int) -> None:
        """Train for so many more agent-steps, or until a callback of the user's ends it."""
        callbacks, resumed = CallbackList([self, self.own]), self.resumed
        try:
            try:
                self.algorithm.learn(timesteps, callback=callbacks, reset_num_timesteps=not resumed, tb_log_name="run")
            except EndedError:
                callbacks.on_training_end()
        except StopError:
            self.own.on_training_end()
            raise

    def _keep(self) -> None:
        """Save the policy of a training that doesn't come to its end."""
        if self.folder is None or not (self.folder / CHECKPOINT).exists():  # it hadn't begun
            return
        policy = self._exported()
        policy.save(self.folder / "last.npz")
        if not (self.folder / "best.npz").exists():
            policy.save(self.folder / "best.npz")

    def elapsed(self) -> float:
        """Seconds of training so far."""
        return float(self.seconds + time.perf_counter() - self.start)

    def _on_training_start(self) -> None:
        if not self.resumed:
            self._save()  # so that a run can be resumed after an early interrupt
        if self.learner.script and not self.algorithm.num_timesteps:
            self._evaluate()  # the script, so that the best policy isn't worse
            self._save()

    def _on_training_end(self) -> None:
        """Evaluate and save, before the user's callbacks end."""
        if self.interrupts.interrupted:
            return
        self.algorithm.logger.dump(self.algorithm.num_timesteps)  # what the last update recorded
        self._evaluate()
        self._save()

    def _on_step(self) -> bool:
        return not self.interrupts.interrupted

    def _on_rollout_start(self) -> None:
        """Evaluate and save between updates, where policy and environment are consistent."""
        follow_schedule(self.algorithm, self.env, self.config)
        now, every = self.algorithm.num_timesteps, self.config.timesteps / self.config.evaluations
        if now // every > (self.curve[-1].timesteps // every if self.curve else 0):
            self._evaluate()
            self._save()
        elif self.on_progress is not None:
            self.on_progress(now / self.config.timesteps, None)

    def _evaluate(self) -> None:
        if self.curve and self.curve[-1].timesteps == self.algorithm.num_timesteps:
            return
        policy = self._exported()
        found = self.evaluator(self.interrupts.stoppable(policy), self.algorithm.num_timesteps)
        self.curve.append(found)
        record_evaluation(self.algorithm.logger, found)
        if found.mean_return > self.best:
            self.best, self.policy = found.mean_return, policy
            if self.folder is not None:
                policy.save(self.folder / "best.npz")
        if self.on_progress is not None:
            self.on_progress(min(1.0, found.timesteps / self.config.timesteps), found)

    def _exported(self) -> LearnedPolicy:
        about = {
            **self.config.as_dict(),
            "environment": self.description.environment,
            "scenario": self.description.scenario,
            "trained": self.algorithm.num_timesteps,
            "residual": self.learner.script and self.learner.script.name,
            "versions": versions(),
        }
        env, columns = self.description.environment, columns_of(self.description, self.config.policy == "attention")
        return exported(self.algorithm, self.config, env, columns, self.types, self.learner.scaler, about)

    def _save(self) -> None:
        if self.folder is None:
            return
        self._exported().save(self.folder / "last.npz")
        write(self.folder / "curve.csv", as_csv(self.curve))
        write_checkpoint(self.folder / CHECKPOINT, self._checkpoint())

    def _write_config(self, folder: Path) -> None:
        text = {**self.config.as_dict(), "versions": versions(), "agents": len(self.batched.agents)}
        write(folder / "config.json", json.dumps(text, indent=2) + "\n")
        write(folder / "config.toml", write_config(self.asked, versions()))

    def _checkpoint(self) -> dict[str, Any]:
        """Everything that the next update depends on, for `write_checkpoint`."""
        return {
            "config": self.config.as_dict(),
            "fingerprint": self.fingerprint,
            **run_state(self.algorithm, self.env),
            "curve": self.curve,
            "seconds": self.elapsed(),
            "ended": self.own.ended,
        }

    def _restore(self, saved: Mapping[str, Any]) -> None:
        """Restore the saved state of model, environment and learning curve.

        Raises:
            CheckpointError: if `saved` isn't such a state.
        """
        try:
            self.curve = [restored(Evaluation(0, 0.0, 0.0, 0.0), point, "curve") for point in saved["curve"]]
            self.seconds = float(saved["seconds"])
            restore_run(self.algorithm, self.env, saved)
        except FAULTS as error:
            raise CheckpointError(f"{self.folder}: its {CHECKPOINT} can't be resumed ({error})") from error
