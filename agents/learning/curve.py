"""The learning curve: evaluations of a policy during its training, which select the best one."""

from __future__ import annotations

import dataclasses
from collections.abc import Sequence
from dataclasses import astuple, dataclass, fields

from stable_baselines3.common.logger import Logger, TensorBoardOutputFormat

from agents.evaluation import play
from agents.learning.config import TrainingConfig
from agents.learning.environment import build
from agents.policies import safety_filter
from agents.policy import Policy
from khop_env.env import BatchedEnv

EVALUATION_SEEDS = range(20_000, 20_032)
"""Seeds of the episodes that select the best policy; they differ from the seeds of tuning and reporting."""

_LISTED = 3  # columns in an error message


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


class Evaluator:
    """Plays the policy of a training on the evaluation's episodes, inside the training's safety filter if it has one.

    Args:
        config: settings of the training.

    Raises:
        ValueError: as `evaluation_environment`.
    """

    def __init__(self, config: TrainingConfig) -> None:
        self._config, self._env = config, evaluation_environment(config, len(EVALUATION_SEEDS))

    def __call__(self, policy: Policy, timesteps: int) -> Evaluation:
        """The evaluation of a policy, trained for so many agent-steps."""
        config = self._config
        if config.shield is not None:
            policy = safety_filter(str(config.shield), policy, config.bounds)
        episodes = play(self._env, policy, EVALUATION_SEEDS, name=config.algorithm)
        return Evaluation(
            timesteps,
            float(episodes.returns.mean()),
            float(episodes.final_task_error.mean()),
            float(episodes.max_normalized_disagreement.max()),
        )


def evaluation_environment(config: TrainingConfig, num_envs: int) -> BatchedEnv:
    """The environment in which the policy of a training is evaluated: the training's, over `evaluate_network` if set.

    Raises:
        ValueError: if its observations have other columns than those of the training.
    """
    network = config.evaluate_network
    if network is None:
        return build(config, num_envs)
    try:
        env = build(dataclasses.replace(config, arguments={**config.arguments, "network": network}), num_envs)
    except ValueError as error:
        raise ValueError(f"evaluate_network {network!r}: {error}") from error
    ours, theirs = (dict.fromkeys(each.layouts[0].names) for each in (build(config, 1), env))
    for verb, more, fewer in (("lack", ours, theirs), ("also have", theirs, ours)):
        if differ := [name for name in more if name not in fewer]:
            listed = ", ".join(differ[:_LISTED]) + ", ..." * (len(differ) > _LISTED)
            raise ValueError(
                f"evaluate_network {network!r}: its observations {verb} {listed}, other than those that the policy is "
                f"trained on; train and evaluate both over networks, or both without one"
            )
    return env


def record_evaluation(logger: Logger, found: Evaluation) -> None:
    """Write an evaluation to TensorBoard, and leave it in the logger for callbacks.

    The logger itself would write it after the next rollout, as if it had been made then.
    """
    values = {"eval/mean_return": found.mean_return, "eval/final_task_error": found.final_task_error}
    for name, value in values.items():
        logger.record(name, value, exclude="tensorboard")
    for output in logger.output_formats:
        if isinstance(output, TensorBoardOutputFormat):
            output.write(dict(values), dict.fromkeys(values, ()), found.timesteps)


def as_csv(curve: Sequence[Evaluation]) -> str:
    """The text of curve.csv."""
    lines = [",".join(field.name for field in fields(Evaluation))]
    lines += [",".join(repr(value) for value in astuple(point)) for point in curve]
    return "\n".join(lines) + "\n"
