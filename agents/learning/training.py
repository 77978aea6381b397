"""Training with Stable-Baselines3 on the vectorised environment: evaluation, saving and resuming."""

from __future__ import annotations

import contextlib
import dataclasses
import json
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

from agents.evaluation import chosen_scenario, play
from agents.learning.checkpoint import CheckpointError, model_state, restore_model, restored, write_checkpoint
from agents.learning.config import TrainingConfig
from agents.learning.config_file import write_config
from agents.learning.environment import TrainingVecEnv, build, described, training_environment
from agents.learning.fingerprint import differences, fingerprint
from agents.learning.initial import begin_from
from agents.learning.learned import LearnedPolicy, columns_of
from agents.learning.networks import exported, make_model
from agents.learning.run_folder import CHECKPOINT, alone_in, load_checkpoint, versions, write
from agents.learning.schedule import follow_schedule
from agents.policies import safety_filter
from agents.policy import EnvDescription, Observations, Policy
from khop_env.env.layout import Float32Array

EVALUATION_SEEDS = range(20_000, 20_032)
"""Seeds of the episodes that select the best policy; they differ from the seeds of tuning and reporting."""

_FIRST_SEED = 1_000_000  # training episodes are drawn from generators with seeds from here on
_RUNNING = ("mean", "var", "count")  # statistics of the discounted return, which normalise rewards

OnProgress = Callable[[float, "Evaluation | None"], None]
"""Called with the completed fraction, and with the evaluation if one was made."""


@dataclass(frozen=True)
class Evaluation:
    """One point of the learning curve.

    Attributes:
        timesteps: agent-steps so far.
        mean_return: over the evaluation episodes.
        final_task_error: mean over the agents and episodes at the end, in the task's unit.
        max_normalized_disagreement: largest |xi| / rho in the episodes.
    """

    timesteps: int
    mean_return: float
    final_task_error: float
    max_normalized_disagreement: float


@dataclass(frozen=True)
class Training:
    """Result of a training run.

    Attributes:
        policy: the policy with the best evaluation.
        curve: the evaluations.
        seconds: wall time of training, the time before a resumed checkpoint included.
        finished: False if it was interrupted.
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
    on_progress: OnProgress | None = None,
) -> Training:
    """Train a policy.

    The folder gets config.toml (every setting, as `khop train --config` takes it), config.json (the same and library
    versions), curve.csv, best.npz and last.npz (policies with their observation scales), checkpoint.npz (everything
    needed to resume) and TensorBoard logs. A keyboard interrupt saves and returns. A resumed run continues as if it had
    not been interrupted, bit for bit with PPO; SAC begins with an empty replay buffer. With more `timesteps` than
    before, a run continues beyond its end; PPO's learning rate then follows the schedule of the longer run.

    Args:
        config: settings; with `resume` they must equal those of the folder, except that `timesteps` may be larger.
        out: folder of the run; None to keep everything in memory.
        resume: whether to continue from the folder's checkpoint.
        on_progress: called with the completed fraction, and the evaluation if one was made.

    Raises:
        FileNotFoundError: if `resume` is set and there is no checkpoint.
        FileExistsError: if the folder holds a run and `resume` isn't set, or another training is running there.
        CheckpointError: if the checkpoint can't be read.
        ValueError: if environment or scenario is unknown, or a resumed run had other settings or another environment.
    """
    torch.set_num_threads(1)  # small networks don't gain from more
    folder = None if out is None else Path(out)
    asked, config = config, dataclasses.replace(config, scenario=chosen_scenario(config.environment, config.scenario))
    if folder is None or not (folder / CHECKPOINT).exists():
        if resume:
            raise FileNotFoundError(f"nothing to resume: there is no {CHECKPOINT} in {folder}")
        if folder is None:
            return _Run(config, None, None, on_progress, asked).learn()
    with alone_in(folder):
        saved = load_checkpoint(folder, config) if resume else None
        if not resume and any((folder / name).exists() for name in (CHECKPOINT, "best.npz")):
            raise FileExistsError(f"{folder} holds a training run; continue it with --resume, or choose another folder")
        return _Run(config, folder, saved, on_progress, asked).learn()


class _StopError(Exception):
    """Ctrl-C during an update or an evaluation."""


class _Run(BaseCallback):
    """A training run, as a Stable-Baselines3 callback."""

    def __init__(
        self,
        config: TrainingConfig,
        folder: Path | None,
        saved: Mapping[str, Any] | None,
        on_progress: OnProgress | None,
        asked: TrainingConfig | None = None,
    ) -> None:
        super().__init__()
        self.asked = asked or config  # with the scenario as the user names it
        self.config, self.folder, self.on_progress = config, folder, on_progress
        self.env: VecNormalize = training_environment(config)
        self.learner: TrainingVecEnv = self.env.venv  # type: ignore[assignment]
        self.batched = batched = self.learner.batched
        self.fingerprint = fingerprint(chosen_scenario(config.environment, config.scenario), batched)
        if script := self.learner.script:
            self.fingerprint["script"] = script.name  # shipped tuned parameters may change
        if saved is not None and (text := differences(saved["fingerprint"], self.fingerprint)):
            raise ValueError(
                f"{folder} holds a run in another environment: {text}; resume it with the unchanged scenario, or "
                "train in another folder"
            )
        self.evaluation_env = build(config, len(EVALUATION_SEEDS))
        self.description = described(batched, config)
        self.types = list(dict.fromkeys(model.type for model in batched.fleet.models))
        layout = self.description.layouts[batched.agents[0]]  # the first features are the observation's columns
        columns = [layout.index(f"own.type.{kind}") for kind in self.types]
        self.interrupted, self.resumed = False, saved is not None
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
                optimizer.register_step_pre_hook(self._stop_if_interrupted)
        if folder is not None:
            self._write_config(folder)

    def learn(self) -> Training:
        """Train to the end or until an interrupt."""
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
            self._save()  # so that a run can be resumed after an early interrupt
        if self.learner.script and not self.algorithm.num_timesteps:
            self._evaluate()  # the script, so that the best policy isn't worse
            self._save()

    def _on_step(self) -> bool:
        return not self.interrupted

    @contextmanager
    def _interruptible(self) -> Iterator[None]:
        """Let Ctrl-C end the training after the current step of an episode, an update or an evaluation.

        A second Ctrl-C raises KeyboardInterrupt as usual.
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
        played: Policy = _Stoppable(policy, self)
        if self.config.shield is not None:
            played = safety_filter(str(self.config.shield), played, self.config.bounds)
        episodes = play(self.evaluation_env, played, EVALUATION_SEEDS, name=self.config.algorithm)
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
        env, columns = self.description.environment, columns_of(self.description)
        return exported(self.algorithm, self.config, env, columns, self.types, self.learner.scaler, about)

    def _save(self) -> None:
        if self.folder is None:
            return
        self._exported().save(self.folder / "last.npz")
        lines = ["timesteps,mean_return,final_task_error,max_normalized_disagreement"]
        lines += [
            f"{point.timesteps},{point.mean_return!r},{point.final_task_error!r},{point.max_normalized_disagreement!r}"
            for point in self.curve
        ]
        write(self.folder / "curve.csv", "\n".join(lines) + "\n")
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
            "model": model_state(self.algorithm),
            "environment": self.batched.get_state(),
            "rewards": {name: getattr(self.env.ret_rms, name) for name in _RUNNING} | {"returns": self.env.returns},
            "before": self.learner.before,
            "shield": None if self.learner.shield is None else self.learner.shield.get_state(),
            "script": self.learner.script and self.learner.script.get_state(),
            "curve": self.curve,
            "seconds": self.elapsed(),
        }

    def _restore(self, saved: Mapping[str, Any]) -> None:
        """Restore the saved state of model, environment and learning curve.

        Raises:
            CheckpointError: if `saved` isn't such a state.
        """
        try:
            self.env.reset()
            self.batched.set_state(restored(self.batched.get_state(), saved["environment"], "environment"))
            self.learner.before = restored(self.learner.before, saved["before"], "before")
            if (shield := self.learner.shield) is not None:
                shield.set_state(restored(shield.get_state(), saved["shield"], "shield"))
            if script := self.learner.script:
                script.set_state(restored(script.get_state(), saved["script"], "script"))
            rewards, running = saved["rewards"], self.env.ret_rms
            if not all(np.shape(rewards[name]) == () and np.isfinite(rewards[name]) for name in _RUNNING):
                raise ValueError("the running statistics of the rewards aren't finite")
            running.mean, running.var, running.count = (rewards[name] for name in _RUNNING)
            self.env.returns = restored(self.env.returns, rewards["returns"], "returns")
            self.curve = [restored(Evaluation(0, 0.0, 0.0, 0.0), point, "curve") for point in saved["curve"]]
            self.seconds = float(saved["seconds"])
            restore_model(self.algorithm, saved["model"])
        except (ValueError, TypeError, KeyError, AttributeError, IndexError, OverflowError, RuntimeError) as error:
            raise CheckpointError(f"{self.folder}: its {CHECKPOINT} can't be resumed ({error})") from error


class _Stoppable:
    """A policy that can be interrupted between its actions."""

    def __init__(self, policy: Policy, run: _Run) -> None:
        self._policy, self._run = policy, run

    def reset(self, env: EnvDescription, seeds: Sequence[int]) -> None:
        self._policy.reset(env, seeds)

    def act(self, observations: Observations) -> dict[str, Float32Array]:
        self._run._stop_if_interrupted()
        return self._policy.act(observations)
